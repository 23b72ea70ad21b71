"""Differentiable volume rendering of colour, opacity and flow of one state, with the points that it passed."""

from dataclasses import dataclass

import torch

from slomo.reconstruct.fields import networks, rays, skinning
from slomo.reconstruct.fields.canonical import Rest, density, rest
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.rays import Rays
from slomo.reconstruct.silhouette import project
from slomo.reconstruct.state import State

Tensor = torch.Tensor


@dataclass(frozen=True)
class Rendered:
    """What R rays see; see `rays.Rays`.

    Attributes:
        opacity: (R,). colour: (R, 3), of the body alone times its opacity. depth: (R,) body lengths, mean.
        flow: (R, 2) px to the next fit frame; rows of the last fit frame are meaningless.
        canonical: (R, n, 3) the samples at rest. residual: (R, n) what the network adds to the capsules' distance.
        weight: (R, n), sum to the opacity. delta: mean square of what the delta network adds to the skinning.
        queried: (R, Q, 3) samples with the largest weights, at rest; cycle: (R, Q) squared distance, body lengths,
            between them and where they came from after the way to rest and back; queried_weight: (R, Q).
    """

    rays: Rays
    rest: Rest
    opacity: Tensor
    colour: Tensor
    depth: Tensor
    flow: Tensor
    canonical: Tensor
    residual: Tensor
    weight: Tensor
    delta: Tensor
    queried: Tensor
    queried_weight: Tensor
    cycle: Tensor


def render(s: State, config: FieldsConfig, count: int | None = None) -> Rendered:
    """Render about `count` of the drawn pixels of hypothesis 0 (`config.rays` unless said).

    Args:
        s: its `x` holds the variables of the fields.
    """
    x, kin = dict(s.x), s.kin
    shape = rest(kin, s.shape)
    last = len(s.obs.at) - 1
    pose = (s.q[0, :, 1:] / kin.sigma[1:]).flatten(1)
    bones = skinning.bones(kin, s.body, s.R_root, s.q, torch.cat([s.seen, (s.seen + 1).clamp(max=last)]), shape)
    r = rays.choose(s, config.rays if count is None else count)
    here, there = r.frame, r.frame + len(s.seen)
    own = bones.pick(here)
    beta = x["F.beta"][0].exp().clamp(min=2e-3)
    t = rays.sample(r, own.capsules, beta, s.pixel[r.frame, r.chosen[r.column]], config)
    p = r.origin[:, None] + t[..., None] * r.direction[:, None]

    delta = networks.delta(x, p, pose[s.seen[here]].detach())
    w = skinning.weights(own.quadric, p, delta)
    at_rest = skinning.backward(skinning.blend(w, own.dual), p)
    flat = at_rest.flatten(0, 1)
    residual, features = networks.residual(x, flat, config.frequencies)
    sdf = (shape.capsules.union(flat) + residual).reshape(t.shape)
    # Depth is measured along the optical axis; a stretch of the ray is longer by the direction's length.
    optical = density(sdf, beta) * rays.lengths(t) * r.direction.norm(dim=-1, keepdim=True)
    through = torch.exp(optical - torch.cumsum(optical, 1))
    weight = through * (1 - torch.exp(-optical))
    colour = (weight[..., None] * networks.colour(x, flat, features).reshape(*t.shape, 3)).sum(1)
    opacity = weight.sum(1)

    top, which = torch.topk(weight, config.queried, dim=1)
    pick = lambda y: torch.gather(y, 1, which[..., None].expand(-1, -1, 3))  # noqa: E731
    asked, came_from = pick(at_rest), pick(p)
    still = networks.delta(x, asked, torch.zeros_like(pose[s.seen[here]]))
    w_rest = skinning.weights(skinning.quadric(shape.capsules)[None], asked, still)
    back = skinning.forward(skinning.blend(w_rest, own.dual), asked)
    moved = skinning.forward(skinning.blend(w_rest, bones.dual[there]), asked)
    share = top / top.sum(1, keepdim=True).clamp(min=1e-6)
    u, v = _seen(s, moved, (s.seen[here] + 1).clamp(max=last))
    uv = torch.stack([(share * u).sum(1), (share * v).sum(1)], -1)
    drawn = r.chosen[r.column]
    return Rendered(
        rays=r, rest=shape, opacity=opacity, colour=colour, depth=(weight * t).sum(1) / opacity.clamp(min=1e-6),
        flow=uv - torch.stack([s.u[here, drawn], s.v[here, drawn]], -1), canonical=at_rest,
        residual=residual.reshape(t.shape), weight=weight, delta=mean(delta.square()) + mean(still.square()),
        queried=asked, queried_weight=top, cycle=(back - came_from).square().sum(-1),
    )  # fmt: skip


def mean(x: Tensor) -> Tensor:
    """Its mean; 0 of nothing, where no ray meets the body."""
    return x.mean() if x.numel() else x.sum()


def _seen(s: State, x: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """u, v px (R, Q) of points x (R, Q, 3) of the root's frame in fit frames k (R,)."""
    turn = s.R_cam[0] @ s.R_root[0]
    shift = (s.R_cam[0] @ (s.body.nodes[0, :, 0] - s.centre[0])[..., None])[..., 0]
    X = s.body.length[0] * (x @ turn[k].transpose(-1, -2)) + shift[k][:, None]
    u, v, _ = project(s.obs.K, X)
    return u, v
