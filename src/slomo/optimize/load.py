"""Joint torques and speeds as limits on forces and velocities: linear in them about a motion of the whole robot.

The whole robot's inverse dynamics along a motion gives the torque of every joint at every step. Nearby, what changes
with the forces u between points and body is -J^T u, with the Jacobian J of the points by the joints; the rest (masses
of the limbs, their accelerations) stays as it is. So each torque over its limit is one linear form,

    |arm . u + rest| <= most,

and so is each joint's speed over its limit in the velocities of body and points, by the inverse of J. Both are
held by the augmented Lagrangian; it is taken anew from each solution, as in sequential linear programming.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from slomo.optimize.jit import compiled

Array = np.ndarray

# Penalty relative to that of the constraints: a hundredth of a joint's limit is as bad as 1 mm.
_PENALTY = 1e-2


class JointLoad(NamedTuple):
    """Torques or speeds over their limits, of J joints at N steps or knots, in n forces or velocities; none with J = 0.

    Attributes:
        arm: (N, J, n).  rest: (N, J).  most: (N, J), inf where one does not count.
    """

    arm: Array
    rest: Array
    most: Array


NO_LOAD = JointLoad(np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))


def load_excess(load: JointLoad, xs: Array) -> Array:
    """(N, J) by which forces or velocities (N, n or more) exceed the limits, below 0 where they do not."""
    if not load.most.size:
        return np.zeros((len(xs), 0))
    return np.abs(np.einsum("kjf,kf->kj", load.arm, xs[:, : load.arm.shape[2]]) + load.rest) - load.most


@compiled
def load_penalty(rho):
    """Penalty of a load (1) where that of the constraints is rho (1/m^2)."""
    return rho * _PENALTY


@compiled
def _value(load, k, j, x):
    s = load.rest[k, j]
    for i in range(load.arm.shape[2]):
        s += load.arm[k, j, i] * x[i]
    return s


@compiled
def load_cost(load, k, x, multiplier, rho):
    """Augmented Lagrangian of the limits at step or knot k on x (n or more,); multiplier: (J,)."""
    J, p = 0.0, rho * _PENALTY
    for j in range(multiplier.shape[0]):
        if load.most[k, j] < inf:
            y = multiplier[j]
            g = abs(_value(load, k, j, x)) - load.most[k, j]
            J += (max(0.0, y + p * g) ** 2 - y * y) / (2 * p)
    return J


@compiled
def load_derivative(load, k, x, multiplier, rho, L, H):
    """Adds `load_cost`'s gradient and Gauss-Newton Hessian to L (n or more,) and H (n or more, n or more)."""
    p = rho * _PENALTY
    nf = load.arm.shape[2]
    for j in range(multiplier.shape[0]):
        if not load.most[k, j] < inf:
            continue
        value = _value(load, k, j, x)
        force = multiplier[j] + p * (abs(value) - load.most[k, j])
        if force > 0:
            sign = 1.0 if value > 0 else -1.0
            for i in range(nf):
                a = load.arm[k, j, i]
                L[i] += sign * force * a
                for n in range(nf):
                    H[i, n] += p * a * load.arm[k, j, n]
