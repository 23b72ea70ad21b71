"""The soft silhouette of capsules, and the surface point that each pixel sees.

A capsule projects to a tapered segment: its signed distance in the image, in pixels, is the distance to the projected
axis minus the projected radius there. Occupancy is a sigmoid of the smooth minimum over capsules.
"""

from dataclasses import dataclass

import torch

from slomo.pinhole import Intrinsics

Tensor = torch.Tensor

NEAR = 1e-2  # world units: nothing closer to the camera is projected


def to_camera(R_cam_world: Tensor, centre: Tensor, X: Tensor) -> Tensor:
    """World points X (H, T, N, 3) in the camera frame. R_cam_world (H, T, 3, 3), centre (H, T, 3)."""
    return (X - centre[:, :, None]) @ R_cam_world.transpose(-1, -2)


def project(K: Intrinsics, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """u, v px and depth of camera-frame points X (..., 3)."""
    z = X[..., 2].clamp(min=NEAR)
    return K.fx * X[..., 0] / z + K.cx, K.fy * X[..., 1] / z + K.cy, z


@dataclass(frozen=True)
class Outline:
    """Projected capsules (H, T, C): ends in px, depths, radii in px."""

    ua: Tensor
    va: Tensor
    za: Tensor
    ub: Tensor
    vb: Tensor
    zb: Tensor
    ra: Tensor
    rb: Tensor


def outline(K: Intrinsics, a: Tensor, b: Tensor, radii: Tensor) -> Outline:
    """Capsules with ends a, b (H, T, C, 3) in the camera frame and world radii (H, C, 2)."""
    ua, va, za = project(K, a)
    ub, vb, zb = project(K, b)
    return Outline(ua, va, za, ub, vb, zb, K.fx * radii[:, None, :, 0] / za, K.fx * radii[:, None, :, 1] / zb)


class _Distance(torch.autograd.Function):
    """Signed distance px and place along the axis, with the gradient written out (autograd would keep twenty arrays).

    The place h on the axis is the closest one, so its own change does not change the distance to the axis (envelope
    theorem); that it changes the radius of a tapered capsule a little is left out of the gradient.
    """

    @staticmethod
    def forward(ctx, ua, va, ub, vb, ra, rb, u, v):  # type: ignore[override]
        bu, bv = (ub - ua)[:, :, None], (vb - va)[:, :, None]
        pu, pv = u[None, :, :, None] - ua[:, :, None], v[None, :, :, None] - va[:, :, None]
        h = (pu * bu).addcmul_(pv, bv).div_(bu * bu + bv * bv + 1e-6).clamp_(0, 1)
        pu.addcmul_(h, bu, value=-1)
        pv.addcmul_(h, bv, value=-1)
        d = (pu * pu).addcmul_(pv, pv).add_(1e-6).sqrt_()
        pu.div_(d)
        pv.div_(d)
        ctx.save_for_backward(pu, pv, h)
        sd = d.sub_(ra[:, :, None]).addcmul_(h, (rb - ra)[:, :, None], value=-1)
        ctx.mark_non_differentiable(h)
        return sd, h

    @staticmethod
    def backward(ctx, g, _):  # type: ignore[override]
        nu, nv, h = ctx.saved_tensors
        gb = g * h
        ga = g - gb
        sums = [-(ga * nu).sum(2), -(ga * nv).sum(2), -(gb * nu).sum(2), -(gb * nv).sum(2), -ga.sum(2), -gb.sum(2)]
        return *sums, None, None


def distances(o: Outline, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance px and place along the axis in [0, 1], (H, T, P, C), of pixels u, v (T, P)."""
    return _Distance.apply(o.ua, o.va, o.ub, o.vb, o.ra, o.rb, u, v)  # type: ignore[return-value]


def soft_min(sd: Tensor, temperature: float) -> Tensor:
    """Smooth minimum over the last axis, in the unit of sd."""
    return -temperature * torch.logsumexp(sd / -temperature, -1)


def visible(K: Intrinsics, o: Outline, sd: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """The capsule that each pixel sees, (H, T, P), and whether it sees one: the nearest front of those it meets."""
    with torch.no_grad():
        radius = o.ra[:, :, None] + h * (o.rb - o.ra)[:, :, None]
        z = o.za[:, :, None] + h * (o.zb - o.za)[:, :, None]
        bulge = (1 - ((sd + radius) / radius).clamp(0, 1) ** 2).sqrt()
        front = z * (1 - bulge * radius / K.fx)
        return torch.where(sd < 0.5, front, 1e4 + sd).argmin(-1), (sd < 0.5).any(-1)


def surface(K: Intrinsics, o: Outline, c: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """(H, T, P, 3) camera-frame point that pixels u, v (T, P) see on their capsules c (H, T, P); differentiable."""
    g = {k: torch.gather(getattr(o, k), 2, c) for k in ("ua", "va", "ub", "vb", "za", "zb", "ra", "rb")}
    bu, bv, pu, pv = g["ub"] - g["ua"], g["vb"] - g["va"], u - g["ua"], v - g["va"]
    h = ((pu * bu + pv * bv) / (bu * bu + bv * bv + 1e-6)).clamp(0, 1)
    r = g["ra"] + h * (g["rb"] - g["ra"])
    d2 = (pu - h * bu) ** 2 + (pv - h * bv) ** 2
    bulge = (1 - d2 / r**2).clamp(min=0.02).sqrt()
    z = (g["za"] + h * (g["zb"] - g["za"])) * (1 - bulge * r / K.fx)
    return torch.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], -1)
