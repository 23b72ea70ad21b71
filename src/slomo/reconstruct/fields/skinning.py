"""Neural blend skinning: from the posed body to rest (backward) and back (forward), by Gaussian bones (BANMo, Yang et
al. 2022, section 3.2) and dual quaternions (Kavan et al. 2008).

A point belongs to the capsules by a softmax over minus half its squared Mahalanobis distances to one Gaussian per
capsule, plus what the delta network adds. The capsules' rigid motions are blended as dual quaternions and normalised,
so the blend is rigid at every point and its inverse is exact: backward and forward differ by their weights alone.
"""

from dataclasses import dataclass

import torch

from slomo.reconstruct.fields.canonical import Capsules, Rest
from slomo.reconstruct.kinematics import Kinematics, Posed

Tensor = torch.Tensor

SPREAD = 0.5  # s.d. of a Gaussian bone over its capsule's reach: the surface lies two s.d. from the centre


@dataclass(frozen=True)
class Bones:
    """C posed capsules at N times, in the root's frame and in body lengths.

    Attributes:
        capsules: posed, (N, C, ...).
        quadric: (N, 10, C), the squared Mahalanobis distances as polynomials of the point.
        dual: (N, C, 8) dual quaternions, rest to posed, scalar first.
    """

    capsules: Capsules
    quadric: Tensor
    dual: Tensor

    def pick(self, which: Tensor) -> "Bones":
        """The bones of some of the times."""
        c = self.capsules
        return Bones(Capsules(c.a[which], c.b[which], c.radii), self.quadric[which], self.dual[which])


def quadric(c: Capsules) -> Tensor:
    """(..., 10, C) coefficients of the squared Mahalanobis distance to every capsule's Gaussian.

    The Gaussian has the capsule's centre and axis; s.d. `SPREAD` times its half length with the caps along the axis,
    `SPREAD` times the mean radius across it. For monomials as in `_monomials`.
    """
    m = (c.a + c.b) / 2
    d = c.b - c.a
    length = (d.square().sum(-1) + 1e-9).sqrt()
    e = d / length[..., None]
    r = c.radii.mean(-1).expand(length.shape)
    across = (SPREAD * r) ** -2
    axial = (SPREAD * (length / 2 + r)) ** -2
    # (x - m)^T P (x - m), P = across I + (axial - across) e e^T
    P = across[..., None, None] * torch.eye(3, device=m.device)
    P = P + (axial - across)[..., None, None] * e[..., :, None] * e[..., None, :]
    Pm = (P @ m[..., None])[..., 0]
    square = torch.stack([P[..., 0, 0], P[..., 1, 1], P[..., 2, 2]], -1)
    mixed = 2 * torch.stack([P[..., 0, 1], P[..., 0, 2], P[..., 1, 2]], -1)
    return torch.cat([square, mixed, -2 * Pm, (m * Pm).sum(-1, keepdim=True)], -1).transpose(-1, -2)


def _monomials(x: Tensor) -> Tensor:
    mixed = torch.stack([x[..., 0] * x[..., 1], x[..., 0] * x[..., 2], x[..., 1] * x[..., 2]], -1)
    return torch.cat([x * x, mixed, x, torch.ones_like(x[..., :1])], -1)


def weights(quadric: Tensor, x: Tensor, delta: Tensor | None = None) -> Tensor:
    """(..., n, C) skinning weights of points x (..., n, 3), with what the delta network says of them."""
    logits = -0.5 * (_monomials(x) @ quadric)
    return torch.softmax(logits if delta is None else logits + delta, -1)


def blend(w: Tensor, dual: Tensor) -> Tensor:
    """(..., n, 8) unit dual quaternions: weights (..., n, C) of dual quaternions (..., C, 8)."""
    y = w @ dual
    return y / (y[..., :4].square().sum(-1, keepdim=True) + 1e-12).sqrt()


def forward(dual: Tensor, x: Tensor) -> Tensor:
    """Points x (..., 3) moved by unit dual quaternions (..., 8), whose dual part need not be orthogonal to the real."""
    return turn(dual[..., :4], x) + _translation(dual)


def backward(dual: Tensor, y: Tensor) -> Tensor:
    """The inverse of `forward`."""
    conjugate = dual[..., :4] * dual.new_tensor([1.0, -1.0, -1.0, -1.0])
    return turn(conjugate, y - _translation(dual))


def _translation(dual: Tensor) -> Tensor:
    """Vector part of 2 dual times the conjugate of the real part."""
    w, v = dual[..., :1], dual[..., 1:4]
    wd, vd = dual[..., 4:5], dual[..., 5:]
    return 2 * (w * vd - wd * v + torch.linalg.cross(v, vd))


def turn(q: Tensor, x: Tensor) -> Tensor:
    """Points x (..., 3) rotated by unit quaternions (..., 4), scalar first."""
    v = q[..., 1:]
    t = 2 * torch.linalg.cross(v, x)
    return x + q[..., :1] * t + torch.linalg.cross(v, t)


def product(p: Tensor, q: Tensor) -> Tensor:
    """Product of quaternions (..., 4)."""
    a, b, c, d = p.unbind(-1)
    w, x, y, z = q.unbind(-1)
    return torch.stack(
        [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
         a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], -1
    )  # fmt: skip


def rotations(kin: Kinematics, q: Tensor) -> Tensor:
    """(N, B, 4) quaternions of the links against the root for joint angles q (N, B, 3).

    Multiplied down the tree from half angles, not read off matrices: a sign that flips from one link to the next would
    make a blend turn the long way round.
    """
    (cx, cy, cz), (sx, sy, sz) = torch.cos(q / 2).unbind(-1), torch.sin(q / 2).unbind(-1)
    # Ry Rx Rz, as `kinematics.joint_rotation`.
    local = torch.stack(
        [cy * cx * cz + sy * sx * sz, cy * sx * cz + sy * cx * sz,
         sy * cx * cz - cy * sx * sz, cy * cx * sz - sy * sx * cz], -1
    )  # fmt: skip
    out = [torch.tensor([1.0, 0.0, 0.0, 0.0], device=q.device).expand(len(q), 1, 4)]
    for own, parent in kin.levels:
        out.append(product(out[-1][:, parent], local[:, own]))
    return torch.cat(out, 1)[:, kin.place]


def bones(kin: Kinematics, body: Posed, R_root: Tensor, q: Tensor, at: Tensor, rest: Rest) -> Bones:
    """The bones of hypothesis 0 at fit frames `at` (N,)."""
    L = body.length[0]
    R, p = R_root[0, at], body.nodes[0, at, 0]
    local = lambda x: ((x[0, at] - p[:, None]) @ R) / L  # noqa: E731
    capsules = Capsules(local(body.a), local(body.b), rest.capsules.radii)
    still = rotations(kin, rest.q[None]) * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    real = product(rotations(kin, q[0, at]), still)
    shift = local(body.nodes[:, :, : kin.B]) - turn(real, rest.origins.expand(len(at), -1, -1))
    dual = 0.5 * product(torch.cat([torch.zeros_like(shift[..., :1]), shift], -1), real)
    return Bones(capsules, quadric(capsules), torch.cat([real, dual], -1)[:, kin.c_link])
