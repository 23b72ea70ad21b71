"""A cyclic motion: its end state is its first one, turned about z and moved; held by an augmented Lagrangian."""

import numpy as np

from slomo.optimize import so3
from slomo.optimize.jit import compiled


@compiled
def end_gap(task, q0, v0, q1, v1, e):
    """e (nx,): tangent vector from where a cyclic motion should end, given its start (q0, v0), to its end (q1, v1)."""
    nv = v0.shape[0]
    c, s = np.cos(task.shift[3]), np.sin(task.shift[3])
    quat, half = np.empty(4), 0.5 * task.shift[3]
    # (0, 0, sin, cos) times q0.
    zs, zc = np.sin(half), np.cos(half)
    quat[0], quat[1] = zc * q0[3] - zs * q0[4], zc * q0[4] + zs * q0[3]
    quat[2], quat[3] = zc * q0[5] + zs * q0[6], zc * q0[6] - zs * q0[5]
    so3.minus(q1[3:7], quat, e[3:6])
    for j in range(0, nv, 3):
        if j != 3:
            i = j if j < 3 else j + 1
            e[j] = q1[i] - (c * q0[i] - s * q0[i + 1] + task.shift[0])
            e[j + 1] = q1[i + 1] - (s * q0[i] + c * q0[i + 1] + task.shift[1])
            e[j + 2] = q1[i + 2] - (q0[i + 2] + task.shift[2])
            e[nv + j] = v1[j] - (c * v0[j] - s * v0[j + 1])
            e[nv + j + 1] = v1[j + 1] - (s * v0[j] + c * v0[j + 1])
            e[nv + j + 2] = v1[j + 2] - v0[j + 2]
        else:
            for i in range(3):
                e[nv + 3 + i] = v1[3 + i] - v0[3 + i]


@compiled
def end_cost(e, multiplier, rho):
    """Augmented Lagrangian of `end_gap` e = 0; multiplier: (nx,)."""
    J, nv = 0.0, e.shape[0] // 2
    for i in range(e.shape[0]):
        J += (multiplier[i] + 0.5 * end_penalty(rho, i, nv) * e[i]) * e[i]
    return J


@compiled
def end_penalty(rho, i, nv):
    """Penalty of entry i of the end gap: velocities count a third of positions."""
    return rho if i < nv else 0.1 * rho


@compiled
def end_derivative(task, e, multiplier, rho, Vx, Vxx, Vt, Vxt, Vtt):
    """Adds `end_cost`'s gradient and Gauss-Newton Hessian with respect to the end state (x) and the first one (t)."""
    nx = e.shape[0]
    nv = nx // 2
    Jx, Jt = np.zeros((nx, nx)), np.zeros((nx, nx))
    c, s = np.cos(task.shift[3]), np.sin(task.shift[3])
    J, back = np.empty((3, 3)), np.empty(3)
    for i in range(nx):
        Jx[i, i] = 1.0
        Jt[i, i] = -1.0
    for j in range(0, nx, 3):
        if j != 3 and j != nv + 3:
            Jt[j, j], Jt[j, j + 1], Jt[j + 1, j], Jt[j + 1, j + 1] = -c, s, -s, -c
    so3.right_jacobian_inverse(e[3:6], J)
    for i in range(3):
        back[i] = -e[3 + i]
        for k in range(3):
            Jx[3 + i, 3 + k] = J[i, k]
    so3.right_jacobian_inverse(back, J)
    for i in range(3):
        for k in range(3):
            Jt[3 + i, 3 + k] = -J[i, k]
    for n in range(nx):
        w = end_penalty(rho, n, nv)
        force = multiplier[n] + w * e[n]
        for i in range(nx):
            Vx[i] += force * Jx[n, i]
            Vt[i] += force * Jt[n, i]
            if Jx[n, i] != 0.0 or Jt[n, i] != 0.0:
                for k in range(nx):
                    Vxx[i, k] += w * Jx[n, i] * Jx[n, k]
                    Vxt[i, k] += w * Jx[n, i] * Jt[n, k]
                    Vtt[i, k] += w * Jt[n, i] * Jt[n, k]
