"""The soft silhouette of capsules, and the surface point that each pixel sees.

A capsule projects to a tapered segment: its signed distance in the image, in pixels, is the distance to the projected
axis minus the projected radius there. Occupancy is a sigmoid of the smooth minimum over capsules.
"""

from dataclasses import dataclass

import numpy as np
import torch

from slomo.pinhole import Intrinsics
from slomo.reconstruct import capsule_kernels

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
    """Signed distance px and place along the axis.

    The place h on the axis is the closest one, so its own change does not change the distance to the axis (envelope
    theorem); that it changes the radius of a tapered capsule a little is left out of the gradient.
    """

    @staticmethod
    def forward(ctx, ua, va, ub, vb, ra, rb, u, v):  # type: ignore[override]
        H, T, C = ua.shape
        outline = torch.stack([ua, va, ub, vb, ra, rb]).reshape(6, H * T, C).cpu().numpy()
        pixels = torch.stack([u, v])[:, None].expand(2, H, *u.shape).reshape(2, H * T, -1).cpu().numpy()
        sd, h = (torch.empty(H * T, u.shape[1], C, dtype=ua.dtype) for _ in range(2))
        capsule_kernels.distances(outline, pixels, sd.numpy(), h.numpy())
        ctx.kept, ctx.shape = (outline, pixels, h.numpy()), ua.shape
        h = h.view(H, T, -1, C).to(ua.device)
        ctx.mark_non_differentiable(h)
        return sd.view(H, T, -1, C).to(ua.device), h

    @staticmethod
    def backward(ctx, g, _):  # type: ignore[override]
        outline, pixels, h = ctx.kept
        out = torch.empty(outline.shape, dtype=g.dtype)
        capsule_kernels.distances_back(outline, pixels, h, _rows(g).reshape(h.shape), out.numpy())
        return *out.view(6, *ctx.shape).to(g.device).unbind(0), None, None


def distances(o: Outline, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance px and place along the axis in [0, 1], (H, T, P, C), of pixels u, v (T, P)."""
    return _Distance.apply(o.ua, o.va, o.ub, o.vb, o.ra, o.rb, u, v)  # type: ignore[return-value]


def sampled(pictures: Tensor, which: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """(H, S, N) bilinear values of pictures (F, 1, h, w), the ones `which` (S,), at u, v (H, S, N) px; outside a
    picture those on its border."""
    height, width = pictures.shape[-2:]
    u, v = u.clamp(0, width - 1), v.clamp(0, height - 1)
    # A pose that is not a number samples anywhere, and stays what it is by the weights.
    left, top = (x.detach().nan_to_num().floor().clamp(max=n - 2) for x, n in ((u, width), (v, height)))
    first = (which * (height * width))[:, None] + (top * width + left).long()
    flat, a, b = pictures.flatten(), u - left, v - top
    above = flat[first] * (1 - a) + flat[first + 1] * a
    return above * (1 - b) + (flat[first + width] * (1 - a) + flat[first + width + 1] * a) * b


class _Nearest(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sd, temperature):  # type: ignore[override]
        rows, shape = _rows(sd), sd.shape[:-1]
        soft, least = torch.empty(2, len(rows), dtype=sd.dtype)
        which = torch.empty(len(rows), dtype=torch.long)
        capsule_kernels.nearest(rows, temperature, soft.numpy(), least.numpy(), which.numpy())
        ctx.rows, ctx.temperature, ctx.soft, ctx.which = rows, temperature, soft.numpy(), which.numpy()
        which = which.view(shape).to(sd.device)
        ctx.mark_non_differentiable(which)
        return soft.view(shape).to(sd.device), least.view(shape).to(sd.device), which

    @staticmethod
    def backward(ctx, g_soft, g_least, _):  # type: ignore[override]
        out = torch.empty(*g_soft.shape, ctx.rows.shape[1], dtype=g_soft.dtype)
        soft, least = (_rows(x).ravel() for x in (g_soft, g_least))
        rows = out.numpy().reshape(ctx.rows.shape)
        capsule_kernels.nearest_back(ctx.rows, ctx.temperature, ctx.soft, ctx.which, soft, least, rows)
        return out.to(g_soft.device), None


def nearest(sd: Tensor, temperature: float) -> tuple[Tensor, Tensor, Tensor]:
    """Smooth minimum over the last axis in the unit of sd, the minimum, and where that is."""
    return _Nearest.apply(sd, temperature)  # type: ignore[return-value]


class _LeastOf(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sd, of):  # type: ignore[override]
        M, K = of[..., 0].numel() // of.shape[-2], of.shape[-2]
        least, which = torch.empty(M, K, dtype=sd.dtype), torch.empty(M, K, dtype=torch.long)
        capsule_kernels.least_of(_rows(sd), _rows(of).reshape(M, K, -1), least.numpy(), which.numpy())
        ctx.shape, ctx.which = sd.shape, which.numpy()
        return least.view(of.shape[:-1]).to(sd.device)

    @staticmethod
    def backward(ctx, g):  # type: ignore[override]
        out = torch.zeros(ctx.shape, dtype=g.dtype)
        rows = out.numpy().reshape(-1, ctx.shape[-1])
        capsule_kernels.least_of_back(ctx.which, _rows(g).reshape(ctx.which.shape), rows)
        return out.to(g.device), None


def least_of(sd: Tensor, of: Tensor) -> Tensor:
    """(..., K) minimum of sd (..., C) over some of its last axis, `of` (..., K, S)."""
    return _LeastOf.apply(sd, of)  # type: ignore[return-value]


def _rows(x: Tensor) -> np.ndarray:
    """(M, C) of (..., C), outside the graph, where the compiled loops can read it."""
    return x.detach().reshape(-1, x.shape[-1]).cpu().contiguous().numpy()


def visible(K: Intrinsics, o: Outline, sd: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """The capsule that each pixel sees, (H, T, P), and whether it sees one: the nearest front of those it meets."""
    which, meets = (torch.empty(sd.shape[:-1], dtype=kind) for kind in (torch.long, torch.bool))
    N, C = o.za.shape[0] * o.za.shape[1], o.za.shape[2]
    ends = _rows(torch.stack([o.za, o.zb, o.ra, o.rb])).reshape(4, N, C)
    d, t = (_rows(x).reshape(N, -1, C) for x in (sd, h))
    capsule_kernels.visible(ends, K.fx, d, t, which.numpy().reshape(N, -1), meets.numpy().reshape(N, -1))
    return which.to(sd.device), meets.to(sd.device)


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
