"""The cost of one knot: squares of residuals, each with its Gauss-Newton derivative.

    position, points, velocities     w (x - x_ref)^2
    orientation                      w |log(R_ref^T R)|^2
    inputs                           w |u - u_ref|^2
    acceleration                     w |sum_c u_c / m + g|^2 and w |(w_next - w) / h|^2 of the body
    slip                             w |s(gamma) v_next_t|^2 of each point, s = gamma / (gamma + slip_load)
    constraints                      augmented Lagrangian of `constraints`, of the friction cone of points that stick,
                                     and of the end state of a cyclic motion; `load` and `reach` add theirs

The cost is (1/2) sum h w r^2 over the steps of length h, so that weights mean the same at any dt.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from slomo.optimize import constraints, so3
from slomo.optimize.contact import tangents
from slomo.optimize.jit import compiled
from slomo.optimize.linear_body import NONLINEAR, LinearBody
from slomo.optimize.load import NO_LOAD, JointLoad
from slomo.optimize.reach import NO_REACH, Reach

Array = np.ndarray

# Penalty of a friction cone relative to that of the constraints: 1 N is as bad as 1 mm.
_CONE = 1e-6
# Share of the cone that points that stick may use, so that what the multipliers leave stays inside it.
_INSIDE = 0.995


class Task(NamedTuple):
    """What is wanted over N steps (N + 1 knots), with nu = 3 C inputs, or one more where step lengths are unknown.

    Attributes:
        h: (N + 1,) s, step lengths (nominal ones, where they are unknown); the last is the weight of the end state.
        ground: (N + 1, C, 4) plane under each point: unit normal n and offset d (m), gap n . f - d.
        stick: (N, C) bool, points that may not slide during a step (see `contact`).
        q_ref, v_ref, u_ref: (N + 1, 7 + 3 C), (N + 1, 6 + 3 C), (N, nu).
        w_x: (N + 1, 12 + 6 C) weights in tangent order.  w_u: (N, nu).
        u_low, u_high: (N, nu) limits of the inputs, N (and s).
        w_acceleration, w_spin, w_slip: weights; w_spin is that of the body's angular acceleration.
        slip_load: N, normal force from which slip counts half.
        cyclic: whether the end state must be the first one, turned about z and moved by `shift`.
        shift: (4,) m, m, m, rad: p_end = R_z(shift[3]) p_first + shift[:3].
        linear: the body's dynamics about the reference, or `NONLINEAR`.
        load, speed: limits of the whole robot's joints, on forces (N steps) and velocities (N + 1 knots), or `NO_LOAD`.
        reach: where they bring the points, or `NO_REACH`.
    """

    h: Array
    ground: Array
    stick: Array
    q_ref: Array
    v_ref: Array
    u_ref: Array
    w_x: Array
    w_u: Array
    u_low: Array
    u_high: Array
    w_acceleration: float
    w_spin: float
    w_slip: float
    slip_load: float
    cyclic: bool
    shift: Array
    linear: LinearBody = NONLINEAR
    load: JointLoad = NO_LOAD
    speed: JointLoad = NO_LOAD
    reach: Reach = NO_REACH


@compiled
def state_cost(body, task, k, q, v, multiplier, rho):
    """Cost of a state. multiplier: (M,) of its constraints.  rho: their penalty."""
    nv = v.shape[0]
    e, g = np.empty(3), np.empty(multiplier.shape[0])
    J = 0.0
    for i in range(3):
        J += task.w_x[k, i] * (q[i] - task.q_ref[k, i]) ** 2
    so3.minus(q[3:7], task.q_ref[k, 3:7], e)
    for i in range(3):
        J += task.w_x[k, 3 + i] * e[i] * e[i]
    for i in range(6, nv):
        J += task.w_x[k, i] * (q[i + 1] - task.q_ref[k, i + 1]) ** 2
    for i in range(nv):
        J += task.w_x[k, nv + i] * (v[i] - task.v_ref[k, i]) ** 2
    J *= 0.5 * task.h[k]
    constraints.values(body, q, g)
    for n in range(g.shape[0]):
        y = multiplier[n]
        if constraints.is_equality(body, n):
            J += (y + 0.5 * rho * g[n]) * g[n]
        elif g[n] > -inf:
            J += (max(0.0, y + rho * g[n]) ** 2 - y * y) / (2 * rho)
    return J


@compiled
def state_derivative(body, task, k, q, v, multiplier, rho, Lx, Lxx):
    """Adds gradient and Gauss-Newton Hessian of `state_cost` to Lx (nx,) and Lxx (nx, nx)."""
    nv = v.shape[0]
    e, R, J = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    h = task.h[k]
    for i in range(nv):
        w = h * task.w_x[k, nv + i]
        Lx[nv + i] += w * (v[i] - task.v_ref[k, i])
        Lxx[nv + i, nv + i] += w
        if i < 3 or i >= 6:
            j = i if i < 3 else i + 1
            w = h * task.w_x[k, i]
            Lx[i] += w * (q[j] - task.q_ref[k, j])
            Lxx[i, i] += w
    so3.minus(q[3:7], task.q_ref[k, 3:7], e)
    so3.right_jacobian_inverse(e, J)
    for n in range(3):
        w = h * task.w_x[k, 3 + n]
        for i in range(3):
            Lx[3 + i] += w * e[n] * J[n, i]
            for j in range(3):
                Lxx[3 + i, 3 + j] += w * J[n, i] * J[n, j]
    so3.matrix(q[3:7], R)
    g = np.empty(multiplier.shape[0])
    grad, index = np.empty(9), np.empty(9, np.int64)
    constraints.values(body, q, g)
    for n in range(g.shape[0]):
        force = multiplier[n] + rho * g[n]
        if not force > 0 and not constraints.is_equality(body, n):
            continue
        count = constraints.gradient(body, q, R, n, index, grad)
        for i in range(count):
            Lx[index[i]] += force * grad[i]
            for j in range(count):
                Lxx[index[i], index[j]] += rho * grad[i] * grad[j]
        constraints.add_curvature(body, q, R, n, force, Lxx)


@compiled
def input_cost(body, task, k, v, u, v1, lam, multiplier, rho):
    """Cost of an input in a state of velocity v.

    v1 (6 + 3 C,) and lam (C, 3) are what the step gives; multiplier (C,) is of the friction cones.
    """
    C = body.hips.shape[0]
    h = u[3 * C] if u.shape[0] > 3 * C else task.h[k]
    J = 0.0
    for i in range(u.shape[0]):
        J += task.w_u[k, i] * (u[i] - task.u_ref[k, i]) ** 2
    for i in range(3):
        a = -body.g if i == 2 else 0.0
        for c in range(C):
            a += u[3 * c + i] / body.mass
        J += task.w_acceleration * a * a
        J += task.w_spin * ((v1[3 + i] - v[3 + i]) / h) ** 2
    for c in range(C):
        n = task.ground[k + 1, c]
        gamma = slide = 0.0
        for i in range(3):
            gamma += n[i] * lam[c, i]
            slide += n[i] * v1[6 + 3 * c + i]
        s = gamma / (gamma + task.slip_load)
        speed2 = -slide * slide
        for i in range(3):
            speed2 += v1[6 + 3 * c + i] ** 2
        J += task.w_slip * s * s * max(speed2, 0.0)
    J *= 0.5 * task.h[k]
    for c in range(C):
        if task.stick[k, c]:
            y = multiplier[c]
            J += (max(0.0, y + rho * _CONE * cone(body, task.ground[k + 1, c], lam[c])) ** 2 - y * y) / (
                2 * rho * _CONE
            )
    return J


@compiled
def cone(body, plane, lam):
    """N, by how much a contact force lam (3,) exceeds the share of the friction cone of points that stick."""
    gamma = square = 0.0
    for i in range(3):
        gamma += plane[i] * lam[i]
        square += lam[i] * lam[i]
    return np.sqrt(max(square - gamma * gamma, 0.0)) - _INSIDE * body.mu * gamma


@compiled
def cone_penalty(rho):
    """Penalty of a friction cone (1/N^2) where that of the constraints is rho (1/m^2)."""
    return rho * _CONE


@compiled
def input_derivative(body, task, k, v, u, v1, lam, multiplier, rho, A, B, D, Lx, Lu, Lxx, Luu, Lux):
    """Adds gradient and Gauss-Newton Hessian of `input_cost`; A, B, D as from `dynamics.linearize`."""
    C, nu = body.hips.shape[0], u.shape[0]
    nv = 6 + 3 * C
    h = task.h[k]
    for i in range(nu):
        w = h * task.w_u[k, i]
        Lu[i] += w * (u[i] - task.u_ref[k, i])
        Luu[i, i] += w
    w = h * task.w_acceleration
    for i in range(3):
        a = -body.g if i == 2 else 0.0
        for c in range(C):
            a += u[3 * c + i] / body.mass
        for c in range(C):
            Lu[3 * c + i] += w * a / body.mass
            for n in range(C):
                Luu[3 * c + i, 3 * n + i] += w / body.mass**2
    _add_spin(h * task.w_spin, u[3 * C] if nu > 3 * C else h, v, v1, A, B, C, Lx, Lu, Lxx, Luu, Lux)
    # Residuals of one point depend on its position, velocity, its input, and on h where that is unknown.
    many = 10 if nu > 3 * C else 9
    J = np.empty(10)
    for c in range(C):
        plane = task.ground[k + 1, c]
        gamma = 0.0
        for i in range(3):
            gamma += plane[i] * lam[c, i]
        load = gamma + task.slip_load
        s = gamma / load
        ds = task.slip_load / (load * load)
        for t in tangents(plane[0], plane[1], plane[2]):
            vt = 0.0
            for i in range(3):
                vt += t[i] * v1[6 + 3 * c + i]
            for n in range(many):
                J[n] = 0.0
                for i in range(3):
                    row = nv + 6 + 3 * c + i
                    dv = B[row, 3 * C] if n == 9 else B[row, 3 * c + n - 6] if n >= 6 else 0.0
                    if n < 6:
                        dv = A[row, 6 + 3 * c + n if n < 3 else nv + 3 + 3 * c + n]
                    J[n] += s * t[i] * dv + ds * vt * plane[i] * D[c, i, n]
            _add_point(h * task.w_slip, h * task.w_slip * s * vt, J, many, c, C, nv, Lx, Lu, Lxx, Luu, Lux)
        if task.stick[k, c]:
            force = multiplier[c] + rho * _CONE * cone(body, plane, lam[c])
            if force > 0:
                square = 0.0
                for i in range(3):
                    square += (lam[c, i] - gamma * plane[i]) ** 2
                size = max(np.sqrt(square), 1e-9)
                for n in range(many):
                    J[n] = 0.0
                    for i in range(3):
                        along = (lam[c, i] - gamma * plane[i]) / size - _INSIDE * body.mu * plane[i]
                        J[n] += along * D[c, i, n]
                _add_point(rho * _CONE, force, J, many, c, C, nv, Lx, Lu, Lxx, Luu, Lux)


@compiled
def _add_spin(weight, h, v, v1, A, B, C, Lx, Lu, Lxx, Luu, Lux):
    """Adds the square of the body's angular acceleration a = (w_next - w) / h, which forces and not h decide."""
    nx, nf = A.shape[0], 3 * C
    nv = nx // 2
    if weight == 0.0:
        return
    for i in range(3):
        row = nv + 3 + i
        a = (v1[3 + i] - v[3 + i]) / h
        w = weight / (h * h)
        for n in range(nx):
            x = A[row, n] - (1.0 if n == row else 0.0)
            if x == 0.0:
                continue
            Lx[n] += weight * a / h * x
            for m in range(nx):
                Lxx[n, m] += w * x * (A[row, m] - (1.0 if m == row else 0.0))
        for n in range(nf):
            u = B[row, n]
            Lu[n] += weight * a / h * u
            for m in range(nf):
                Luu[n, m] += w * u * B[row, m]
            for m in range(nx):
                Lux[n, m] += w * u * (A[row, m] - (1.0 if m == row else 0.0))


@compiled
def _add_point(weight, force, J, many, c, C, nv, Lx, Lu, Lxx, Luu, Lux):
    """Adds a residual with derivative J (point 3, velocity 3, input 3, step length): force * J and weight * J J^T."""
    for n in range(many):
        a = 6 + 3 * c + n if n < 3 else nv + 3 + 3 * c + n if n < 6 else 3 * c + n - 6 if n < 9 else 3 * C
        if n < 6:
            Lx[a] += force * J[n]
        else:
            Lu[a] += force * J[n]
        for m in range(many):
            b = 6 + 3 * c + m if m < 3 else nv + 3 + 3 * c + m if m < 6 else 3 * c + m - 6 if m < 9 else 3 * C
            value = weight * J[n] * J[m]
            if n < 6 and m < 6:
                Lxx[a, b] += value
            elif n >= 6 and m >= 6:
                Luu[a, b] += value
            elif n >= 6:
                Lux[a, b] += value
