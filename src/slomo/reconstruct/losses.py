"""Evidence: what the posed body is compared with, as a list of terms with one signature.

A term maps a `State` (the posed body, its projection, the draw of pixels) to one number per hypothesis, dimensionless
and of order one when the pose is off by a limb's width. A learned prior, a neural field, physics: each is another term.
"""

import torch

from slomo.reconstruct import silhouette
from slomo.reconstruct.posture import balance, crossed, facing, forward, limits, prior, short, smooth, upright
from slomo.reconstruct.silhouette import Outline
from slomo.reconstruct.state import State, Term

Tensor = torch.Tensor

SOFT_PX = 0.7  # width of the silhouette's edge and of the smooth minimum over capsules, working pixels
LOW = 0.095  # leg lengths above its stance height at which a foot is as likely up as down
SLOW = 0.476  # leg lengths / s, likewise, of a body at rest
TRAVEL = 0.2  # what is added to it of the body's own speed, for its path may be wrong
SLIDE = 0.75  # body lengths / s of a standing foot: the unit of its drift
# Masks lose tails in some frames and find them in others. A tail that was pushed out of all the background where it is
# missed would hide behind the body for good; these are what it costs there, against any other part.
TAIL_COVERS, TAIL_OUTSIDE = 0.3, 0.1
FLOW_PX = 0.25  # flow errors below this are noise, working pixels


def _frame_mean(s: State, x: Tensor, weight: Tensor) -> Tensor:
    """(H,) mean over drawn frames and pixels of x (H, S, P) with weight (S, P) or (H, S, P), by mask quality."""
    w = weight * s.obs.quality[s.seen][:, None]
    return (x * w).sum((1, 2)) / (w.sum((-1, -2)) + 1e-6)


def mask(s: State) -> Tensor:
    """Soft occupancy against the mask, mask and background weighted alike, over the whole frame."""
    empty = torch.sigmoid(s.near / SOFT_PX)
    n = s.inside
    one = torch.ones_like(s.u)
    miss = _frame_mean(s, empty[:, :, :n], one[:, :n])
    owed = torch.where(s.kin.c_tail, TAIL_COVERS, 1.0)[s.nearest[:, :, n:]]
    extra = _frame_mean(s, owed * (1 - empty[:, :, n:]), one[:, n:])
    return miss + extra


def reach(s: State) -> Tensor:
    """How far mask pixels are from the body, and bones from the mask: gradients from afar, in units of 5 px."""
    n = s.inside
    near = s.least[:, :, :n].clamp(min=0) / 5.0
    # Far pieces of a mask that swallowed something else pull less and less.
    far = (torch.sqrt(near**2 + 0.01) - 0.1) / (1 + near / 6)
    unexplained = _frame_mean(s, far, torch.ones_like(s.u[:, :n]))
    o, K = s.out, s.obs.K
    u = torch.cat([o.ua, o.ub, (o.ua + o.ub) / 2], -1)
    v = torch.cat([o.va, o.vb, (o.va + o.vb) / 2], -1)
    r = torch.cat([o.ra, o.rb, (o.ra + o.rb) / 2], -1)
    away = silhouette.sampled(s.obs.edge, s.seen, u, v)
    # A bone's axis lies its radius inside; outside the picture nothing is known.
    shown = ((u > 0) & (u < K.width - 1) & (v > 0) & (v < K.height - 1)).float() * s.obs.quality[s.seen][:, None]
    shown = shown * torch.where(s.kin.c_tail, TAIL_OUTSIDE, 1.0).repeat(3)
    over = (away + 0.6 * r).clamp(min=0) / 5.0
    outside = ((torch.sqrt(over**2 + 0.01) - 0.1) * shown).sum((1, 2)) / (shown.sum((1, 2)) + 1e-6)
    return unexplained + outside


def misfit(s: State) -> Tensor:
    """(H, S) of each drawn frame: its mask's pixels missed, background covered, and mask pixels far from any bone."""
    empty, n = torch.sigmoid(s.near / SOFT_PX), s.inside
    far = s.least[:, :, :n].clamp(min=0) / 5.0
    return empty[:, :, :n].mean(-1) + (1 - empty[:, :, n:]).mean(-1) + 0.5 * (far / (1 + far / 6)).mean(-1)


def flow(s: State) -> Tensor:
    """Optical flow: the surface point that a mask pixel sees moves with its link to the next fit frame."""
    obs, K = s.obs, s.obs.K
    # Frames are drawn in order, so that the last of the clip, which has no next one, can only be the last here.
    m, n = int((s.seen < len(obs.at) - 1).sum()), s.inside
    k, u, v, pixel = s.seen[:m], s.u[:m, :n], s.v[:m, :n], s.pixel[:m, :n]
    sub = Outline(**{f: getattr(s.out, f)[:, :m] for f in Outline.__dataclass_fields__})
    c, meets = silhouette.visible(K, sub, s.sd[:, :m, :n], s.h[:, :m, :n])
    X = silhouette.surface(K, sub, c, u, v)
    predicted = carry(s, k, c, X) - torch.stack([u, v], -1)
    where = k[:, None] * obs.flow.shape[1] + pixel
    observed, fine = obs.flow.flatten(0, 1)[where], obs.flow_ok.flatten()[where].float()
    error = torch.sqrt(((predicted - observed) ** 2).sum(-1) + FLOW_PX**2) - FLOW_PX
    # Robust: wrong flow at occlusions must not pull; saturates at about the flow's own size.
    size = 2.0 + obs.flow_size
    w = fine * meets.float() * obs.quality[k][:, None]
    e = size * (1 - torch.exp((-error / size).clamp(min=-60)))  # exp() is slow where it underflows
    return (e * w).sum((1, 2)) / (w.sum((1, 2)) + 0.2 * w[0].numel() / 4) / (1.0 + 0.25 * obs.flow_size)


def carry(s: State, k: Tensor, c: Tensor, X: Tensor) -> Tensor:
    """(H, S, P, 2) px where camera-frame points X of frames k, fixed to capsules c, are seen in frames k + 1."""
    kin, body = s.kin, s.body
    H, S, P = c.shape
    # Camera of frame k -> link -> camera of frame k + 1, composed per capsule before it is gathered per pixel.
    R0 = s.R_cam[:, k][:, :, None] @ body.R[:, k][:, :, kin.c_link]
    R1 = s.R_cam[:, k + 1][:, :, None] @ body.R[:, k + 1][:, :, kin.c_link]
    R = R1 @ R0.transpose(-1, -2)
    a0, a1 = s.ends[0][:, k], s.ends[0][:, k + 1]
    p = a1 - (R @ a0[..., None])[..., 0]
    Rg = torch.gather(R.reshape(H, S, -1, 9), 2, c[..., None].expand(H, S, P, 9)).reshape(H, S, P, 3, 3)
    pg = torch.gather(p, 2, c[..., None].expand(H, S, P, 3))
    Y = (Rg @ X[..., None])[..., 0] + pg
    u, v, _ = silhouette.project(s.obs.K, Y)
    return torch.stack([u, v], -1)


def feet(s: State) -> tuple[Tensor, Tensor, Tensor]:
    """Height above stance height (H, F, L), velocity to the next fit frame (H, F-1, L, 3), in body lengths (and s),
    and place (H, F, L, 3) in the world."""
    L = s.body.length[:, None, None]
    x = s.body.nodes[:, :, s.kin.contacts]
    height = x[..., 2] / L - s.kin.skeleton.sole
    return height, (x[:, 1:] - x[:, :-1]) / L[..., None] / s.obs.dt[:, None, None], x


def contact_weight(s: State) -> Tensor:
    """(H, F-1, L) how surely a foot stands from one fit frame to the next; not differentiated.

    From its height and speed in the present fit, from whether its pixels move with the ground, and from the gait
    hypothesis as long as that has weight.
    """
    with torch.no_grad():
        height, velocity, x = feet(s)
        leg = s.kin.leg
        low = torch.sigmoid((LOW * leg - torch.maximum(height[:, 1:], height[:, :-1])) / (LOW * leg / 3.5))
        L = s.body.length[:, None]
        root = s.body.nodes[:, :, 0]
        travel = (root[:, 1:] - root[:, :-1]).norm(dim=-1) / L / s.obs.dt
        limit = SLOW * leg + TRAVEL * travel[..., None]
        slow = torch.sigmoid((limit - velocity[..., :2].norm(dim=-1)) / (0.25 * limit))
        X = silhouette.to_camera(s.R_cam, s.centre, x)
        K = s.obs.K
        u, v, _ = silhouette.project(K, X)
        u, v = u[:, :-1], v[:, :-1]
        seen = (u > -1) & (u < K.width) & (v > -1) & (v < K.height)
        still = silhouette.sampled(s.obs.static, torch.arange(len(s.obs.dt)), u, v) * seen
        own = low * slow * (0.4 + 0.6 * still)
        return torch.where(s.stance < 0, own, torch.maximum(own, s.stance))


def stance(s: State) -> Tensor:
    """A foot that stands stays where it is, on the ground."""
    height, velocity, _ = feet(s)
    w = contact_weight(s)
    drift = (velocity[..., :2] / SLIDE).square().sum(-1)
    lift = ((height[:, 1:] / 0.04).square() + (height[:, :-1] / 0.04).square()) / 2
    both = drift / (1 + drift).detach().sqrt() + lift / (1 + lift).detach().sqrt()
    return (w * both).sum((1, 2)) / both[0].numel()


def ground(s: State) -> Tensor:
    """Nothing is below the ground, and the lowest foot is near it."""
    height, _, _ = feet(s)
    below = (-height).clamp(min=0) / 0.03
    z = s.body.nodes[..., 2] / s.body.length[:, None, None]
    sunk = (0.02 - z).clamp(min=0) / 0.03
    lowest = soft_lowest(height) / 0.06
    return below.square().mean((1, 2)) + sunk.square().mean((1, 2)) + 0.3 * (torch.sqrt(lowest**2 + 1) - 1).mean(1)


def soft_lowest(height: Tensor) -> Tensor:
    """(H, F) smooth minimum over the feet."""
    return -0.02 * torch.logsumexp(height / -0.02, -1)


TERMS: dict[str, Term] = {
    "mask": mask, "reach": reach, "flow": flow, "stance": stance, "ground": ground, "limits": limits, "smooth": smooth,
    "forward": forward, "balance": balance, "prior": prior, "facing": facing, "crossed": crossed, "upright": upright,
    "short": short,
}  # fmt: skip
