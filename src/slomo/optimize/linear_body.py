"""The body's dynamics linearised about a reference, with the contact of its points left as it is: a time-varying LCP.

Near a reference motion x_k, u_k the body moves by matrices that can be made beforehand,

    d_{k+1} = A_k d_k + B_k (u - u_k) + c_k,     d = tangent vector from the reference to the state (x, y),

while each point keeps its complementarity, 0 <= gap _|_ normal force >= 0, and its friction cone. The points' own
dynamics, and their gaps to the planes under the reference, are linear as they are; so with these matrices all but
contact is. This is the form in which Le Cleac'h et al., "Fast contact-implicit model predictive control" (T-RO 2024),
track a reference. The complementarity is relaxed as in `contact`, whose closed form per point takes the place of their
interior-point steps.
"""

from typing import NamedTuple, Self

import numpy as np

from slomo.optimize import dynamics, so3
from slomo.optimize.dynamics import linearize_body, linearize_points, minus, step, step_points
from slomo.optimize.jit import compiled

Array = np.ndarray


class LinearBody(NamedTuple):
    """Matrices along N steps of a reference, or none (N = 0): the nonlinear body.

    Attributes:
        A: (N, 12, nx), B: (N, 12, nu), c: (N, 12); rows: position, rotation, velocity, angular velocity.
        q: (N + 1, 7 + 3 C), v: (N + 1, 6 + 3 C), u: (N, nu) the reference.
    """

    A: Array
    B: Array
    c: Array
    q: Array
    v: Array
    u: Array

    @classmethod
    def zeros(cls, N: int, C: int) -> Self:
        """Room for N steps with C points."""
        z, nv = np.zeros, 6 + 3 * C
        q = np.zeros((N + 1, 1 + nv))
        q[:, 6] = 1.0
        return cls(z((N, 12, 2 * nv)), z((N, 12, 3 * C)), z((N, 12)), q, z((N + 1, nv)), z((N, 3 * C)))


NONLINEAR = LinearBody.zeros(0, 0)


@compiled
def _turn_rotation(J, M):
    """Rows 3 to 5 of M become J (3, 3) times them."""
    for j in range(M.shape[1]):
        a, b, c = M[3, j], M[4, j], M[5, j]
        for i in range(3):
            M[3 + i, j] = J[i, 0] * a + J[i, 1] * b + J[i, 2] * c


@compiled
def linearize_reference(body, h, linear, first, last):
    """Fill the matrices of steps first to last - 1, of lengths h (N,), about the states and inputs in `linear`."""
    nu = linear.u.shape[1]
    nv = linear.v.shape[1]
    nx = 2 * nv
    A, B = np.zeros((nx, nx)), np.zeros((nx, nu))
    q1, v1, d, J = np.empty(nv + 1), np.empty(nv), np.empty(nx), np.empty((3, 3))
    for k in range(first, last):
        linearize_body(body, h[k], linear.q[k], linear.v[k], linear.u[k], q1, v1, A, B)
        for i in range(nv - 6):  # only the body's rows count
            q1[7 + i], v1[6 + i] = linear.q[k + 1, 7 + i], linear.v[k + 1, 6 + i]
        minus(q1, v1, linear.q[k + 1], linear.v[k + 1], d)
        # From the tangent space of the rotation that the step gives into that of the reference's.
        so3.right_jacobian_inverse(d[3:6], J)
        _turn_rotation(J, A)
        _turn_rotation(J, B)
        for i in range(12):
            row = i if i < 6 else nv - 6 + i
            linear.c[k, i] = d[row]
            for j in range(nx):
                linear.A[k, i, j] = A[row, j]
            for j in range(nu):
                linear.B[k, i, j] = B[row, j]


@compiled
def _linear_step(linear, k, q, v, u, d, d1, q1, v1):
    """The body's next state into q1[:7], v1[:6]; d (nx,) and d1 (12,) are the deviations before and after."""
    minus(q, v, linear.q[k], linear.v[k], d)
    for i in range(12):
        s = linear.c[k, i]
        for j in range(d.shape[0]):
            s += linear.A[k, i, j] * d[j]
        for j in range(u.shape[0]):
            s += linear.B[k, i, j] * (u[j] - linear.u[k, j])
        d1[i] = s
    for i in range(3):
        q1[i] = linear.q[k + 1, i] + d1[i]
    so3.plus(linear.q[k + 1, 3:7], d1[3], d1[4], d1[5], q1[3:7])
    for i in range(6):
        v1[i] = linear.v[k + 1, i] + d1[6 + i]


@compiled
def task_step(body, task, kappa, k, h, q, v, u, q1, v1, lam):
    """Step k of a task: `dynamics.step`, or with the task's linearised body."""
    ground, stick = task.ground[k + 1], task.stick[k]
    if task.linear.c.shape[0] == 0:
        step(body, h, kappa, ground, stick, q, v, u, q1, v1, lam)
        return
    d, d1 = np.empty(2 * v.shape[0]), np.empty(12)
    _linear_step(task.linear, k, q, v, u, d, d1, q1, v1)
    step_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam)


@compiled
def task_linearize(body, task, kappa, k, h, q, v, u, q1, v1, lam, A, B, D):
    """`task_step` with its derivative, as `dynamics.linearize` has it."""
    ground, stick = task.ground[k + 1], task.stick[k]
    if task.linear.c.shape[0] == 0:
        dynamics.linearize(body, h, kappa, ground, stick, q, v, u, q1, v1, lam, A, B, D)
        return
    linear = task.linear
    nv = v.shape[0]
    nx = 2 * nv
    d, d1 = np.empty(nx), np.empty(12)
    _linear_step(linear, k, q, v, u, d, d1, q1, v1)
    linearize_points(body, h, kappa, ground, stick, q, v, u, q1, v1, lam, A, B, D)
    # Rotations are turned from the reference's tangent space into those of q and q1: Jr(d1) A Jr(d)^-1.
    before, after = np.empty((3, 3)), np.empty((3, 3))
    so3.right_jacobian_inverse(d[3:6], before)
    so3.right_jacobian(d1[3:6], after)
    for i in range(12):
        row = i if i < 6 else nv - 6 + i
        for j in range(nx):
            A[row, j] = linear.A[k, i, j]
        for j in range(u.shape[0]):
            B[row, j] = linear.B[k, i, j]
        for j in range(3):
            s = 0.0
            for m in range(3):
                s += linear.A[k, i, 3 + m] * before[m, j]
            A[row, 3 + j] = s
    _turn_rotation(after, A)
    _turn_rotation(after, B)
