"""The body at rest: the union of the skeleton's capsules with its present shape, and the density of a surface.

Lengths are body lengths, the origin is the root, x forward, y left, z up. Rest here is the skeleton's with its limbs
swung outwards: limbs that touch would be one piece of surface and tear when they part.
"""

from dataclasses import dataclass

import numpy as np
import torch

from slomo.reconstruct.kinematics import Kinematics
from slomo.skeleton import Skeleton

Tensor = torch.Tensor

APART = 0.8  # rad at most by which limbs are swung outwards at rest
BLEND = 0.01  # body lengths over which capsules flow into each other


@dataclass(frozen=True)
class Capsules:
    """C rounded cones: ends a, b (..., C, 3) and radii (..., C, 2) there."""

    a: Tensor
    b: Tensor
    radii: Tensor

    def distances(self, x: Tensor) -> Tensor:
        """(..., n, C) signed distance of points x (..., n, 3), negative inside.

        Distance to the nearest place of the axis less the radius there: exact for equal radii, off by the square of
        the taper's angle for others. Written as products of matrices: an array (n, C, 3) would cost more than all else.
        """
        d = self.b - self.a
        dd = (d * d).sum(-1)
        along = x @ d.transpose(-1, -2) - (self.a * d).sum(-1)[..., None, :]
        h = (along / (dd + 1e-9)[..., None, :]).clamp(0, 1)
        to_a = (x * x).sum(-1, keepdim=True) - 2 * (x @ self.a.transpose(-1, -2))
        to_a = to_a + (self.a * self.a).sum(-1)[..., None, :]
        square = to_a + h * (h * dd[..., None, :] - 2 * along)
        r0, r1 = self.radii[..., None, :, 0], self.radii[..., None, :, 1]
        return (square.clamp(min=0) + 1e-8).sqrt() - (r0 + h * (r1 - r0))

    def union(self, x: Tensor) -> Tensor:
        """(..., n) smooth minimum of `distances`."""
        return -BLEND * torch.logsumexp(self.distances(x) / -BLEND, -1)


@dataclass(frozen=True)
class Rest:
    """The rest pose of a shape: its capsules, the links' origins (B, 3), and all joints' angles q (B, 3) rad."""

    capsules: Capsules
    origins: Tensor
    q: Tensor


def apart(skeleton: Skeleton) -> np.ndarray:
    """(B, 3) rad: the skeleton's rest pose with each limb swung outwards by half its range, `APART` at most."""
    q = np.zeros((skeleton.link_count, 3))
    for j in range(1, skeleton.link_count):
        parent = skeleton.link[j]
        if skeleton.mirror[j] != j and skeleton.mirror[parent] == parent:
            side = np.sign(skeleton.offset[j, 1])
            reach = skeleton.upper[j, 0] if side > 0 else -skeleton.lower[j, 0]
            q[j, 0] = side * min(APART, reach / 2)
    return q


def rest(kin: Kinematics, shape: dict[str, Tensor]) -> Rest:
    """The skeleton at rest with the shape of one hypothesis, differentiable in it."""
    zero = next(iter(shape.values())).new_zeros
    eye = torch.eye(3, dtype=torch.float32, device=zero(1).device).expand(1, 1, 3, 3)
    q = torch.as_tensor(apart(kin.skeleton), dtype=torch.float32, device=eye.device)
    body = kin.pose(shape, zero(1, 1, 3), eye, q[None, None])
    L = body.length[0]
    return Rest(Capsules(body.a[0, 0] / L, body.b[0, 0] / L, body.radii[0] / L), body.nodes[0, 0, : kin.B] / L, q)


def density(sdf: Tensor, beta: Tensor) -> Tensor:
    """Volume density, 1 / body length: the cumulative Laplace distribution of -sdf with scale beta, over beta
    (VolSDF, Yariv et al. 2021, eq. 2 and 3 with alpha = 1 / beta)."""
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta
