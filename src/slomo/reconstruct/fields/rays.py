"""Which drawn pixels are rendered, and where along their rays the samples lie: near the posed capsules' surfaces."""

from dataclasses import dataclass

import torch

from slomo.reconstruct.fields.canonical import Capsules, density
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.state import State

Tensor = torch.Tensor

MARGIN = 3.0  # working pixels: rays farther from every capsule see none of the body


@dataclass(frozen=True)
class Rays:
    """R rays of the drawn pixels that pass near the body, in the root's frame and body lengths.

    Attributes:
        chosen: (J,) columns of the state's drawn pixels that take part, near the body or not; the first `inside` of
            them lie in the mask.
        frame: (R,) row of `state.seen`; column: (R,) position in `chosen`.
        origin, direction: (R, 3); the direction has a depth of 1, so places along it are depths.
        near, far: (R,) depths between which the capsules lie.
    """

    chosen: Tensor
    inside: int
    frame: Tensor
    column: Tensor
    origin: Tensor
    direction: Tensor
    near: Tensor
    far: Tensor


def choose(s: State, count: int) -> Rays:
    """About `count` of the drawn pixels, half of them in the mask; they are random already, so the first are taken."""
    S, P = s.u.shape
    own, other = s.inside, P - s.inside
    half = max(1, round(count / 2 / S))
    n_in, n_out = min(own, half), min(other, max(half, round(count / S) - own))
    chosen = torch.cat([torch.arange(n_in), s.inside + torch.arange(n_out)]).to(s.u.device)
    L = s.body.length[0]
    with torch.no_grad():
        sd = s.sd[0][:, chosen]
        close = sd < MARGIN
        frame, column = torch.nonzero(close.any(-1), as_tuple=True)
        close = close[frame, column]
        za, zb, r = s.out.za[0][frame], s.out.zb[0][frame], s.body.radii[0].amax(-1)
        near = torch.where(close, torch.minimum(za, zb) - r, torch.inf).amin(-1) / L
        far = torch.where(close, torch.maximum(za, zb) + r, -torch.inf).amax(-1) / L
    K, k = s.obs.K, s.seen
    u, v = s.u[frame, chosen[column]], s.v[frame, chosen[column]]
    ray = torch.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, torch.ones_like(u)], -1)
    # Rows times R: the inverse rotation. Camera -> world -> root.
    turn = s.R_cam[0, k] @ s.R_root[0, k]
    origin = ((s.centre[0, k] - s.body.nodes[0, k, 0])[:, None] @ s.R_root[0, k])[:, 0] / L
    direction = (ray[:, None] @ turn[frame])[:, 0]
    return Rays(chosen, n_in, frame, column, origin[frame], direction, near.clamp(min=1e-3), far)


def jitter(pixel: Tensor, frame: Tensor, samples: int) -> Tensor:
    """(R, samples) in [0, 1), fixed by pixel and frame: one draw always renders alike (additive recurrences)."""
    i = torch.arange(samples, device=pixel.device, dtype=torch.float64)
    x = pixel.double()[:, None] * 0.6180339887 + frame.double()[:, None] * 0.7548776662 + i * 0.5698402910
    return (x % 1).float()


def sample(rays: Rays, posed: Capsules, beta: Tensor, pixel: Tensor, config: FieldsConfig) -> Tensor:
    """(R, n) ascending depths where the field is evaluated: by the weight that the posed capsules alone would have
    (hierarchical sampling, Mildenhall et al. 2020, section 5.2), with a twentieth spread evenly."""
    with torch.no_grad():
        step = (rays.far - rays.near) / config.coarse
        edge = torch.arange(config.coarse + 1, device=step.device) * step[:, None] + rays.near[:, None]
        t = (edge[:, 1:] + edge[:, :-1]) / 2
        x = rays.origin[:, None] + t[..., None] * rays.direction[:, None]
        # A density narrower than the steps would fall between them.
        wide = torch.maximum(beta.expand_as(step), 0.7 * step)[:, None]
        depth = density(posed.distances(x).amin(-1), wide) * step[:, None]
        through = torch.exp(depth - torch.cumsum(depth, 1))
        w = through * (1 - torch.exp(-depth)) + 1e-4
        padded = torch.nn.functional.pad(w, (1, 1))
        w = torch.maximum(torch.maximum(padded[:, :-2], padded[:, 2:]), w)
        w = w / w.sum(1, keepdim=True) + 0.05 / config.coarse
        total = torch.cumsum(w, 1)
        total = torch.nn.functional.pad(total / total[:, -1:], (1, 0))
        n = config.samples
        p = (torch.arange(n, device=t.device) + jitter(pixel, rays.frame, n)) / n
        i = torch.searchsorted(total.contiguous(), p.contiguous(), right=True).clamp(1, config.coarse) - 1
        low, high = torch.gather(total, 1, i), torch.gather(total, 1, i + 1)
        return torch.gather(edge, 1, i) + (p - low) / (high - low).clamp(min=1e-9) * step[:, None]


def lengths(t: Tensor) -> Tensor:
    """(R, n) the stretch of the ray that each of the depths t (R, n) stands for: half way to its neighbours."""
    gap = t[:, 1:] - t[:, :-1]
    return torch.cat([gap[:, :1], (gap[:, 1:] + gap[:, :-1]) / 2, gap[:, -1:]], 1)
