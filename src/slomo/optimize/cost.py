"""The cost of one knot: squares of residuals, each with its Gauss-Newton derivative.

    position, points, velocities     w (x - x_ref)^2
    orientation                      w |log(R_ref^T R)|^2
    inputs                           w |u - u_ref|^2
    acceleration                     w |sum_c u_c / m + g|^2 of the body
    slip                             w |s(gamma) v_next_xy|^2 of each point, s = gamma / (gamma + slip_load)
    leg length                       augmented Lagrangian of leg_min <= |p + R hip - f| <= leg_max

The cost is (1/2) sum h w r^2 over the steps of length h, so that weights mean the same at any dt.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from slomo.optimize import so3
from slomo.optimize.jit import compiled

Array = np.ndarray


class Task(NamedTuple):
    """What is wanted over N steps (N + 1 knots).

    Attributes:
        h: (N + 1,) s, step lengths; the last is the weight of the end state.
        heights: (N + 1, C) m, ground under each point.
        q_ref, v_ref, u_ref: (N + 1, 7 + 3 C), (N + 1, 6 + 3 C), (N, 3 C).
        w_x: (N + 1, 12 + 6 C) weights in tangent order.  w_u: (N, 3 C).
        w_acceleration, w_slip: weights.
        slip_load: N, normal force from which slip counts half.
    """

    h: Array
    heights: Array
    q_ref: Array
    v_ref: Array
    u_ref: Array
    w_x: Array
    w_u: Array
    w_acceleration: float
    w_slip: float
    slip_load: float


@compiled
def _leg(body, q, R, c, d):
    """Vector d (3,) from foot to hip and its length."""
    for i in range(3):
        d[i] = q[i] - q[7 + 3 * c + i]
        for k in range(3):
            d[i] += R[i, k] * body.hips[c, k]
    return max(sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9)


@compiled
def leg_violation(body, q, out):
    """out (C, 2): leg_min - length and length - leg_max, m; positive is a violation."""
    R, d = np.empty((3, 3)), np.empty(3)
    so3.matrix(q[3:7], R)
    for c in range(body.hips.shape[0]):
        length = _leg(body, q, R, c, d)
        out[c, 0] = body.leg_min[c] - length
        out[c, 1] = length - body.leg_max[c]


@compiled
def state_cost(body, task, k, q, v, multiplier, rho):
    """Cost of a state. multiplier: (C, 2) of the leg limits.  rho: their penalty."""
    nv = v.shape[0]
    e, R, d = np.empty(3), np.empty((3, 3)), np.empty(3)
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
    so3.matrix(q[3:7], R)
    for c in range(body.hips.shape[0]):
        length = _leg(body, q, R, c, d)
        for side in range(2):
            g = body.leg_min[c] - length if side == 0 else length - body.leg_max[c]
            y = multiplier[c, side]
            J += (max(0.0, y + rho * g) ** 2 - y * y) / (2 * rho)
    return J


@compiled
def state_derivative(body, task, k, q, v, multiplier, rho, Lx, Lxx):
    """Adds gradient and Gauss-Newton Hessian of `state_cost` to Lx (nx,) and Lxx (nx, nx)."""
    nv = v.shape[0]
    e, R, d, J = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
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
    g9, index = np.empty(9), np.empty(9, np.int64)
    for c in range(body.hips.shape[0]):
        length = _leg(body, q, R, c, d)
        for side in range(2):
            g = body.leg_min[c] - length if side == 0 else length - body.leg_max[c]
            force = multiplier[c, side] + rho * g
            if force <= 0:
                continue
            sign = (-1.0 if side == 0 else 1.0) / length
            # d = p + R hip - f: dp, d(R exp(w) hip) = R [w] hip = -R [hip] w, -df.
            b0 = sign * (R[0, 0] * d[0] + R[1, 0] * d[1] + R[2, 0] * d[2])
            b1 = sign * (R[0, 1] * d[0] + R[1, 1] * d[1] + R[2, 1] * d[2])
            b2 = sign * (R[0, 2] * d[0] + R[1, 2] * d[1] + R[2, 2] * d[2])
            p = body.hips[c]
            g9[3], g9[4], g9[5] = p[1] * b2 - p[2] * b1, p[2] * b0 - p[0] * b2, p[0] * b1 - p[1] * b0
            for i in range(3):
                g9[i], g9[6 + i] = sign * d[i], -sign * d[i]
                index[i], index[3 + i], index[6 + i] = i, 3 + i, 6 + 3 * c + i
            for i in range(9):
                Lx[index[i]] += force * g9[i]
                for j in range(9):
                    Lxx[index[i], index[j]] += rho * g9[i] * g9[j]


@compiled
def input_cost(body, task, k, u, v1, lam):
    """Cost of an input: v1 (6 + 3 C,) and lam (C, 3) are what the step gives."""
    C = body.hips.shape[0]
    J = 0.0
    for i in range(3 * C):
        J += task.w_u[k, i] * (u[i] - task.u_ref[k, i]) ** 2
    for i in range(3):
        a = -body.g if i == 2 else 0.0
        for c in range(C):
            a += u[3 * c + i] / body.mass
        J += task.w_acceleration * a * a
    for c in range(C):
        s = lam[c, 2] / (lam[c, 2] + task.slip_load)
        J += task.w_slip * s * s * (v1[6 + 3 * c] ** 2 + v1[7 + 3 * c] ** 2)
    return 0.5 * task.h[k] * J


@compiled
def input_derivative(body, task, k, u, v1, lam, A, B, D, Lx, Lu, Lxx, Luu, Lux):
    """Adds gradient and Gauss-Newton Hessian of `input_cost`; A, B, D as from `dynamics.linearize`."""
    C = body.hips.shape[0]
    nv = 6 + 3 * C
    h = task.h[k]
    for i in range(3 * C):
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
    w = h * task.w_slip
    J7 = np.empty(7)  # with respect to the point's height, velocity (3) and input (3)
    ix = np.empty(4, np.int64)
    for c in range(C):
        load = lam[c, 2] + task.slip_load
        s = lam[c, 2] / load
        ds = task.slip_load / (load * load)
        ix[0] = 8 + 3 * c
        for n in range(3):
            ix[1 + n] = nv + 6 + 3 * c + n
        for i in range(2):
            row = nv + 6 + 3 * c + i
            vi = v1[6 + 3 * c + i]
            for n in range(4):
                J7[n] = s * A[row, ix[n]] + ds * D[c, 2, n] * vi
            for n in range(3):
                J7[4 + n] = s * B[row, 3 * c + n] + ds * D[c, 2, 4 + n] * vi
            r = w * s * vi
            for n in range(4):
                Lx[ix[n]] += r * J7[n]
                for m in range(4):
                    Lxx[ix[n], ix[m]] += w * J7[n] * J7[m]
            for n in range(3):
                Lu[3 * c + n] += r * J7[4 + n]
                for m in range(3):
                    Luu[3 * c + n, 3 * c + m] += w * J7[4 + n] * J7[4 + m]
                for m in range(4):
                    Lux[3 * c + n, ix[m]] += w * J7[4 + n] * J7[m]
