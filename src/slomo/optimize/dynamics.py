"""One semi-implicit step of the point-foot model, and its derivative in the tangent space.

    v_next = v + h a(q, v, u, lam),  q_next = q + h v_next  (orientation: R exp(h w_next)).

Tangent vectors dx (12 + 6 C) are ordered position, rotation (right), points, velocity, angular velocity, point
velocities. The ground under point c during step k is the plane ground[k + 1, c]: unit normal n and offset d, with the
gap n . f - d. Where h is an unknown, it is the input after the forces.
"""

from typing import NamedTuple

import numpy as np

from slomo.optimize import so3
from slomo.optimize.contact import contact_derivative, contact_force
from slomo.optimize.jit import compiled
from slomo.pointfoot import PointFootModel
from slomo.robot_workspace import directions

Array = np.ndarray


class Body(NamedTuple):
    """`PointFootModel` as compiled code takes it (attributes as there)."""

    mass: float
    inertia: Array
    inertia_inv: Array
    hips: Array
    leg_min: Array
    leg_max: Array
    foot_mass: Array
    pairs: Array
    pair_length: Array
    clearance: Array
    directions: Array
    workspace: Array
    mu: float
    g: float

    @classmethod
    def of(cls, model: PointFootModel) -> "Body":
        return cls(
            float(model.mass),
            model.inertia,
            np.ascontiguousarray(np.linalg.inv(model.inertia)),
            model.leg_roots,
            model.leg_min,
            model.leg_max,
            model.foot_mass,
            model.pairs,
            model.pair_length,
            model.clearance,
            directions(),
            model.workspace,
            float(model.mu),
            float(model.g),
        )


@compiled
def _body_velocity(body, h, q, v, u, R, torque, v1):
    """v1[:6]; R (3, 3) and the torque in the body frame are returned too."""
    C = body.hips.shape[0]
    so3.matrix(q[3:7], R)
    fx = fy = fz = tx = ty = tz = 0.0
    for c in range(C):
        rx, ry, rz = q[7 + 3 * c] - q[0], q[8 + 3 * c] - q[1], q[9 + 3 * c] - q[2]
        ux, uy, uz = u[3 * c], u[3 * c + 1], u[3 * c + 2]
        fx, fy, fz = fx + ux, fy + uy, fz + uz
        tx, ty, tz = tx + ry * uz - rz * uy, ty + rz * ux - rx * uz, tz + rx * uy - ry * ux
    v1[0] = v[0] + h * fx / body.mass
    v1[1] = v[1] + h * fy / body.mass
    v1[2] = v[2] + h * (fz / body.mass - body.g)
    I = body.inertia  # noqa: E741
    lx = I[0, 0] * v[3] + I[0, 1] * v[4] + I[0, 2] * v[5]
    ly = I[1, 0] * v[3] + I[1, 1] * v[4] + I[1, 2] * v[5]
    lz = I[2, 0] * v[3] + I[2, 1] * v[4] + I[2, 2] * v[5]
    for i in range(3):
        torque[i] = R[0, i] * tx + R[1, i] * ty + R[2, i] * tz
    ex = torque[0] - (v[4] * lz - v[5] * ly)
    ey = torque[1] - (v[5] * lx - v[3] * lz)
    ez = torque[2] - (v[3] * ly - v[4] * lx)
    for i in range(3):
        J = body.inertia_inv
        v1[3 + i] = v[3 + i] + h * (J[i, 0] * ex + J[i, 1] * ey + J[i, 2] * ez)


@compiled
def _integrate_body(h, q, v1, q1):
    for i in range(3):
        q1[i] = q[i] + h * v1[i]
    so3.plus(q[3:7], h * v1[3], h * v1[4], h * v1[5], q1[3:7])


@compiled
def step_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam):
    """The part of `step` below the body's: points and their contact forces."""
    for c in range(body.hips.shape[0]):
        i, j, m = 3 * c, 6 + 3 * c, body.foot_mass[c]
        f, vf, uf = q[7 + i : 10 + i], v[j : j + 3], u[i : i + 3]
        contact_force(ground[c], f, vf, uf, m, h, body.mu, body.g, kappa, stick[c], lam[c])
        for k in range(3):
            v1[j + k] = v[j + k] + h * (lam[c, k] - u[i + k]) / m
        v1[j + 2] -= h * body.g
        for k in range(3):
            q1[7 + i + k] = q[7 + i + k] + h * v1[j + k]


@compiled
def step(body, h, kappa, ground, stick, q, v, u, q1, v1, lam):
    """The next state into q1, v1 and the contact forces into lam (C, 3). ground: (C, 4). stick: (C,). u: (3 C,) N."""
    R, torque = np.empty((3, 3)), np.empty(3)
    _body_velocity(body, h, q, v, u, R, torque, v1)
    _integrate_body(h, q, v1, q1)
    step_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam)


@compiled
def linearize_body(body, h, q, v, u, q1, v1, A, B):
    """The body's part of `linearize`: its next state, and the first six rows of A and B of positions and velocities."""
    C = body.hips.shape[0]
    nv = 6 + 3 * C
    R, torque = np.empty((3, 3)), np.empty(3)
    _body_velocity(body, h, q, v, u, R, torque, v1)
    Jinv, I = body.inertia_inv, body.inertia  # noqa: E741
    w0, w1, w2 = v[3], v[4], v[5]
    L = np.empty(3)
    for i in range(3):
        L[i] = I[i, 0] * w0 + I[i, 1] * w1 + I[i, 2] * w2
        A[i, i] = 1.0
        A[nv + i, nv + i] = 1.0
        A[i, nv + i] = h
        for c in range(C):
            B[nv + i, 3 * c + i] = h / body.mass
            B[i, 3 * c + i] = h * h / body.mass

    # Angular velocity: h I^-1 times the derivative of the torque in the body frame.
    W = np.empty((3, 3))  # h I^-1 R^T
    for i in range(3):
        for k in range(3):
            W[i, k] = h * (Jinv[i, 0] * R[k, 0] + Jinv[i, 1] * R[k, 1] + Jinv[i, 2] * R[k, 2])
    r = nv + 3
    sx = sy = sz = 0.0
    for c in range(C):
        ux, uy, uz = u[3 * c], u[3 * c + 1], u[3 * c + 2]
        rx, ry, rz = q[7 + 3 * c] - q[0], q[8 + 3 * c] - q[1], q[9 + 3 * c] - q[2]
        sx, sy, sz = sx + ux, sy + uy, sz + uz
        for i in range(3):
            a, b, d = W[i, 0], W[i, 1], W[i, 2]
            # W [r]x for u, and W (-[u]x) for the point.
            B[r + i, 3 * c] = b * rz - d * ry
            B[r + i, 3 * c + 1] = d * rx - a * rz
            B[r + i, 3 * c + 2] = a * ry - b * rx
            A[r + i, 6 + 3 * c] = -(b * uz - d * uy)
            A[r + i, 7 + 3 * c] = -(d * ux - a * uz)
            A[r + i, 8 + 3 * c] = -(a * uy - b * ux)
    for i in range(3):
        a, b, d = W[i, 0], W[i, 1], W[i, 2]
        A[r + i, 0], A[r + i, 1], A[r + i, 2] = b * sz - d * sy, d * sx - a * sz, a * sy - b * sx
        a, b, d = h * Jinv[i, 0], h * Jinv[i, 1], h * Jinv[i, 2]
        A[r + i, 3] = b * torque[2] - d * torque[1]
        A[r + i, 4] = d * torque[0] - a * torque[2]
        A[r + i, 5] = a * torque[1] - b * torque[0]
        # d(-w x I w)/dw = [I w]x - [w]x I
        for k in range(3):
            A[r + i, r + k] = -(
                a * (w1 * I[2, k] - w2 * I[1, k])
                + b * (w2 * I[0, k] - w0 * I[2, k])
                + d * (w0 * I[1, k] - w1 * I[0, k])
            )
        A[r + i, r] += b * L[2] - d * L[1]
        A[r + i, r + 1] += d * L[0] - a * L[2]
        A[r + i, r + 2] += a * L[1] - b * L[0]
        A[r + i, r + i] += 1.0
    _integrate_body(h, q, v1, q1)

    if B.shape[1] > 3 * C:
        for i in range(6):
            B[nv + i, 3 * C] = (v1[i] - v[i]) / h
            B[i, 3 * C] = v1[i] + h * B[nv + i, 3 * C]

    # Rotation: exp(h w1)^T d + h Jr(h w1) dw1.
    hw, E, J = h * v1[3:6], np.empty((3, 3)), np.empty((3, 3))
    so3.exp_matrix(hw, E)
    so3.right_jacobian(hw, J)
    for i in range(3):
        for k in range(2 * nv):
            A[3 + i, k] = h * (J[i, 0] * A[r, k] + J[i, 1] * A[r + 1, k] + J[i, 2] * A[r + 2, k])
        for k in range(3 * C):
            B[3 + i, k] = h * (J[i, 0] * B[r, k] + J[i, 1] * B[r + 1, k] + J[i, 2] * B[r + 2, k])
        for k in range(3):
            A[3 + i, 3 + k] += E[k, i]
        if B.shape[1] > 3 * C:
            k = 3 * C
            B[3 + i, k] = 0.0
            for n in range(3):
                B[3 + i, k] += J[i, n] * (v1[3 + n] + h * B[r + n, k])


@compiled
def linearize_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam, A, B, D):
    """The points' part of `linearize`."""
    C = body.hips.shape[0]
    nv = 6 + 3 * C
    for c in range(C):
        i, j, m = 3 * c, 6 + 3 * c, body.foot_mass[c]
        f, vf, uf = q[7 + i : 10 + i], v[j : j + 3], u[i : i + 3]
        contact_derivative(ground[c], f, vf, uf, m, h, body.mu, body.g, kappa, stick[c], lam[c], D[c])
        s = h / m
        for k in range(3):
            v1[j + k] = v[j + k] + h * (lam[c, k] - u[i + k]) / m
            row = nv + j + k
            for n in range(3):
                A[row, j + n] = s * D[c, k, n]
                A[row, nv + j + n] = s * D[c, k, 3 + n]
                B[row, i + n] = s * D[c, k, 6 + n]
            A[row, nv + j + k] += 1.0
            B[row, i + k] -= s
            for n in range(3):
                A[j + k, j + n] = h * A[row, j + n]
                A[j + k, nv + j + n] = h * A[row, nv + j + n]
                B[j + k, i + n] = h * B[row, i + n]
            A[j + k, j + k] += 1.0
        v1[j + 2] -= h * body.g
        for k in range(3):
            q1[7 + i + k] = q[7 + i + k] + h * v1[j + k]
            if B.shape[1] > 3 * C:
                row = nv + j + k
                B[row, 3 * C] = (v1[j + k] - v[j + k]) / h + h / m * D[c, k, 9]
                B[j + k, 3 * C] = v1[j + k] + h * B[row, 3 * C]


@compiled
def linearize(body, h, kappa, ground, stick, q, v, u, q1, v1, lam, A, B, D):
    """`step` with A (nx, nx), B (nx, nu), its derivative, and D (C, 3, 10) of the contact forces.

    A and B must come zeroed or from an earlier call: only entries that can differ from zero are written. With one more
    column than forces, B's last one is the derivative with respect to h.
    """
    linearize_body(body, h, q, v, u, q1, v1, A, B)
    linearize_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam, A, B, D)


@compiled
def minus(qb, vb, qa, va, out):
    """out (nx,) = the tangent vector that leads from state a to state b."""
    nv = va.shape[0]
    for i in range(3):
        out[i] = qb[i] - qa[i]
    so3.minus(qb[3:7], qa[3:7], out[3:6])
    for i in range(6, nv):
        out[i] = qb[i + 1] - qa[i + 1]
    for i in range(nv):
        out[nv + i] = vb[i] - va[i]


@compiled
def plus(q, v, dx, alpha, q1, v1):
    """q1, v1 = the state (q, v) moved along alpha dx."""
    nv = v.shape[0]
    for i in range(3):
        q1[i] = q[i] + alpha * dx[i]
    so3.plus(q[3:7], alpha * dx[3], alpha * dx[4], alpha * dx[5], q1[3:7])
    for i in range(6, nv):
        q1[i + 1] = q[i + 1] + alpha * dx[i]
    for i in range(nv):
        v1[i] = v[i] + alpha * dx[nv + i]
