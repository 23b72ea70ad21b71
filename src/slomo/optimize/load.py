"""Joint torques as limits on the forces: linear in them about a motion whose torques are known.

The whole robot's inverse dynamics along a motion gives the torque of every joint at every step. Nearby, what changes
with the forces u between points and body is -J^T u, with the Jacobian J of the points by the joints; the rest (masses
of the limbs, their accelerations) stays as it is. So each torque over its limit is one linear form,

    |arm . u + rest| <= most,

held by the augmented Lagrangian; it is taken anew from each solution, as in sequential linear programming.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from slomo.optimize.jit import compiled

Array = np.ndarray

# Penalty relative to that of the constraints: a hundredth of a joint's effort is as bad as 1 mm.
_PENALTY = 1e-2


class JointLoad(NamedTuple):
    """Torques over their limits, for J joints and nf forces; none with J = 0.

    Attributes:
        arm: (N, J, nf) 1/N.  rest: (N, J).  most: (N, J), inf where a torque does not count.
    """

    arm: Array
    rest: Array
    most: Array


NO_LOAD = JointLoad(np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))


def load_excess(load: JointLoad, us: Array) -> Array:
    """(N, J) by which inputs (N, nu) exceed the loads, below 0 where they do not."""
    if not load.most.size:
        return np.zeros((len(us), 0))
    torque = np.einsum("kjf,kf->kj", load.arm, us[:, : load.arm.shape[2]]) + load.rest
    return np.abs(torque) - load.most


@compiled
def load_penalty(rho):
    """Penalty of a load (1) where that of the constraints is rho (1/m^2)."""
    return rho * _PENALTY


@compiled
def _torque(load, k, j, u):
    s = load.rest[k, j]
    for i in range(load.arm.shape[2]):
        s += load.arm[k, j, i] * u[i]
    return s


@compiled
def load_cost(load, k, u, multiplier, rho):
    """Augmented Lagrangian of the loads in step k; multiplier: (J,)."""
    J, p = 0.0, rho * _PENALTY
    for j in range(multiplier.shape[0]):
        if load.most[k, j] < inf:
            y = multiplier[j]
            g = abs(_torque(load, k, j, u)) - load.most[k, j]
            J += (max(0.0, y + p * g) ** 2 - y * y) / (2 * p)
    return J


@compiled
def load_derivative(load, k, u, multiplier, rho, Lu, Luu):
    """Adds `load_cost`'s gradient and Gauss-Newton Hessian to Lu (nu,) and Luu (nu, nu)."""
    p = rho * _PENALTY
    nf = load.arm.shape[2]
    for j in range(multiplier.shape[0]):
        if not load.most[k, j] < inf:
            continue
        torque = _torque(load, k, j, u)
        force = multiplier[j] + p * (abs(torque) - load.most[k, j])
        if force > 0:
            sign = 1.0 if torque > 0 else -1.0
            for i in range(nf):
                a = load.arm[k, j, i]
                Lu[i] += sign * force * a
                for n in range(nf):
                    Luu[i, n] += p * a * load.arm[k, j, n]
