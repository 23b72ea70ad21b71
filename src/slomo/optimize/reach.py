"""Where joints bring a limb's points: half-spaces about places that inverse kinematics did not reach.

The configuration that misses the points x of a limb (all of them, stacked, in the body's frame) least leaves an error
x - x_reached that is normal to what the joints reach. So near there, what they reach lies in the half-space

    normal . x <= most,     normal = (x - x_reached) / |x - x_reached|,

which the augmented Lagrangian holds at that knot and its neighbours. For a foot it bounds place and direction together.
"""

from math import inf
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.optimize import so3
from slomo.optimize.jit import compiled

Array = np.ndarray


class Reach(NamedTuple):
    """M half-spaces for each of N + 1 knots with C points; none with M = 0.

    Attributes:
        normal: (N + 1, M, 3 C), unit, of the points in the body's frame.  most: (N + 1, M) m, inf where there is none.
    """

    normal: Array
    most: Array

    def joined(self, more: Self) -> Self:
        """Both."""
        if not self.most.size:
            return more
        return type(self)(*(np.concatenate(x, axis=1) for x in zip(self, more, strict=True)))


NO_REACH = Reach(np.zeros((0, 0, 0)), np.zeros((0, 0)))


def reach_excess(reach: Reach, qs: Array) -> Array:
    """(N + 1, M) m by which states (N + 1, 7 + 3 C) are beyond the half-spaces, below 0 where they are not."""
    if not reach.most.size:
        return np.zeros((len(qs), 0))
    return np.einsum("kmi,ki->km", reach.normal, in_body(qs)) - reach.most


def in_body(qs: Array) -> Array:
    """(T, 3 C) m, points of states (T, 7 + 3 C) in the body's frame."""
    x = qs[:, 7:].reshape(len(qs), -1, 3) - qs[:, None, :3]
    return np.einsum("kji,kcj->kci", Rotation.from_quat(qs[:, 3:7]).as_matrix(), x).reshape(len(qs), -1)


@compiled
def _in_body(q, R, x):
    """x (3 C,) = the points in the body's frame."""
    for c in range(0, x.shape[0], 3):
        for i in range(3):
            x[c + i] = 0.0
            for n in range(3):
                x[c + i] += R[n, i] * (q[7 + c + n] - q[n])


@compiled
def _beyond(reach, k, m, x):
    """m, by how much points x are beyond half-space m."""
    s = -reach.most[k, m]
    for i in range(x.shape[0]):
        s += reach.normal[k, m, i] * x[i]
    return s


@compiled
def reach_cost(reach, k, q, multiplier, rho):
    """Augmented Lagrangian of the half-spaces of knot k; multiplier: (M,)."""
    J, M = 0.0, multiplier.shape[0]
    if M == 0:
        return J
    R, x = np.empty((3, 3)), np.empty(q.shape[0] - 7)
    so3.matrix(q[3:7], R)
    _in_body(q, R, x)
    for m in range(M):
        if reach.most[k, m] < inf:
            y = multiplier[m]
            J += (max(0.0, y + rho * _beyond(reach, k, m, x)) ** 2 - y * y) / (2 * rho)
    return J


@compiled
def reach_derivative(reach, k, q, multiplier, rho, Lx, Lxx):
    """Adds `reach_cost`'s gradient and Gauss-Newton Hessian to Lx (nx,) and Lxx (nx, nx)."""
    M, nf = multiplier.shape[0], q.shape[0] - 7
    if M == 0:
        return
    R, x, grad = np.empty((3, 3)), np.empty(nf), np.empty(6 + nf)
    so3.matrix(q[3:7], R)
    _in_body(q, R, x)
    for m in range(M):
        force = multiplier[m] + rho * _beyond(reach, k, m, x)
        if not force > 0:
            continue
        for i in range(6):
            grad[i] = 0.0
        for c in range(0, nf, 3):
            a0, a1, a2 = reach.normal[k, m, c], reach.normal[k, m, c + 1], reach.normal[k, m, c + 2]
            # x = R^T (f - p): dx = R^T (df - dp) + [x] w.
            for i in range(3):
                grad[6 + c + i] = R[i, 0] * a0 + R[i, 1] * a1 + R[i, 2] * a2
                grad[i] -= grad[6 + c + i]
            grad[3] += a1 * x[c + 2] - a2 * x[c + 1]
            grad[4] += a2 * x[c] - a0 * x[c + 2]
            grad[5] += a0 * x[c + 1] - a1 * x[c]
        for i in range(6 + nf):
            if grad[i] != 0.0:
                Lx[i] += force * grad[i]
                for j in range(6 + nf):
                    Lxx[i, j] += rho * grad[i] * grad[j]
