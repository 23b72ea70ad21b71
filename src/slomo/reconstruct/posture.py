"""Terms that need no picture: how bodies are built, carry themselves and move."""

import torch

from slomo.reconstruct.kinematics import SHIFT_SPREAD
from slomo.reconstruct.state import State

Tensor = torch.Tensor

SWING = 5.0  # accelerations of a gait's nodes in units of speed squared over body length
STRAIGHT = 0.015  # s.d. of how far ahead of the other a joint of a person's trunk lies, body lengths
OVER_SOLE = 0.4  # of the way from the ankle to the ball of the foot: where the centre of mass of a person is above


def limits(s: State) -> Tensor:
    """Joint angles within their anatomical ranges, and near rest by their prior; root pitch and roll small."""
    q, kin = s.q[:, :, 1:], s.kin
    over = (q - kin.upper[1:]).clamp(min=0) + (kin.lower[1:] - q).clamp(min=0)
    # Sideways and twisting rotation is what a silhouette cannot deny, hence its larger weight.
    rest = (q / kin.sigma[1:]).square() * torch.tensor([5.0, 1.0, 5.0])
    up = s.R_root[..., 2, 0].square() / 0.15**2 + s.R_root[..., 2, 1].square() / 0.08**2
    up = up / (1 + 0.4 * up)  # who rears is seen to, and by how much is not for this to say
    return 40 * over.square().sum(-1).mean((1, 2)) + 0.3 * rest.mean((1, 2, 3)) + 0.15 * up.mean(1)


def upright(s: State) -> Tensor:
    """People hold trunk and head upright, in units of 0.15 rad, robust, for who bends down is seen to; and their spine,
    neck, head and hips are not built ahead of each other by more than `STRAIGHT`. From the front and the back nothing
    else denies that a body leans."""
    kin = s.kin
    lean = torch.zeros_like(s.R_root[..., 2, 0])
    for a, b in kin.upright:
        line = s.body.nodes[:, :, b] - s.body.nodes[:, :, a]
        e = line[..., :2].square().sum(-1) / line.square().sum(-1) / 0.15**2
        lean = lean + e / (1 + 0.1 * e)
    ahead = s.shape["shift"][:, kin.of_trunk, 0] * SHIFT_SPREAD / STRAIGHT
    return lean.mean(1) + 0.25 * ahead.square().sum(1)


def crossed(s: State) -> Tensor:
    """Legs do not cross, which is what they do for long where left is taken for right."""
    e = (s.kin.crossing(s.body, s.R_root) / 0.1).square()
    return (e / (1 + 0.1 * e)).sum(2).mean(1) / max(len(s.kin.pairs), 1)


def forward(s: State) -> Tensor:
    """Animals and people mostly move the way they face: sideways and backward speed, half body lengths / s, robust."""
    p, L = s.body.nodes[:, :, 0, :2], s.body.length[:, None, None]
    v = (p[:, 1:] - p[:, :-1]) / L / s.obs.dt[:, None]
    ahead = s.R_root[:, :-1, :2, 0]
    along = (v * ahead).sum(-1)
    across = v[..., 1] * ahead[..., 0] - v[..., 0] * ahead[..., 1]
    e = (across.square() + 0.5 * along.clamp(max=0).square()) / 0.25
    return (e / (1 + 0.3 * e)).mean(1)


def facing(s: State) -> Tensor:
    """People are filmed from the front when nothing else tells: 1 for a back seen square on, 0 for a front or side."""
    to_camera = torch.nn.functional.normalize((s.centre - s.body.nodes[:, :, 0])[..., :2], dim=-1)
    ahead = torch.nn.functional.normalize(s.R_root[..., :2, 0], dim=-1)
    return (-(to_camera * ahead).sum(-1)).clamp(min=0).mean(1)


def smooth(s: State) -> Tensor:
    """Accelerations of all nodes, and of the root twice, in units of 15 body lengths / s^2.

    A body that travels at v swings its legs with accelerations of the order of v^2 / body length (to gravity they are
    as Froude's number), so the unit grows with that: a gallop is not smoothed into a walk.
    """
    x, length = s.body.nodes, s.body.length[:, None, None, None]
    if x.shape[1] < 3:
        return x.new_zeros(len(x))
    dt = s.obs.dt
    v = (x[:, 1:] - x[:, :-1]) / dt[:, None, None] / length
    a = (v[:, 1:] - v[:, :-1]) / (0.5 * (dt[1:] + dt[:-1]))[:, None, None]
    travel = v[:, :, 0, :2].norm(dim=-1).mean(1).detach()
    a = a / torch.sqrt(15**2 + (SWING * travel**2) ** 2)[:, None, None, None]
    return (a.square().sum(-1).mean(2) + (15 / 8) ** 2 * a[:, :, 0].square().sum(-1)).mean(1)


def balance(s: State) -> Tensor:
    """Over the clip a body is above its feet, not beside them: its centre of mass against the middle of the feet,
    across the way it faces, in units of 0.03 body lengths. A camera at the side sees none of it: all of it is depth.
    People have no feet in front and behind, so theirs is over the sole that way, too, as far before the ankles as in
    quiet standing, about 5 cm (Winter, Human balance and posture control, 1995).
    """
    body = s.body
    with torch.no_grad():
        r = body.radii.mean(-1)[:, None]
        volume = r.square() * ((body.b - body.a).norm(dim=-1) + 4 / 3 * r)
        volume = (volume / volume.sum(-1, keepdim=True))[..., None]
    feet = body.nodes[:, :, s.kin.contacts]
    if s.kin.skeleton.kind == "human":  # the key point lies in the ball of the foot, its link begins at the ankle
        feet = feet + (1 - OVER_SOLE) * (body.nodes[:, :, s.kin.link[s.kin.contacts]] - feet)
    off = ((body.a + body.b) / 2 * volume).sum(2) - feet.mean(2)
    ahead = torch.nn.functional.normalize(s.R_root[..., :2, 0], dim=-1)
    across = (off[..., 1] * ahead[..., 0] - off[..., 0] * ahead[..., 1]).mean(1) / body.length
    e = (across / 0.03).square()
    if s.kin.skeleton.kind == "human":
        e = e + ((off[..., :2] * ahead).sum(-1).mean(1) / body.length / 0.03).square()
    return e / (1 + 0.1 * e)


def short(s: State) -> Tensor:
    """Arms are no longer for their legs than the skeleton's: mean log of what their bones are too long by.

    An arm that is fitted too long looks as long as it is seen once it is turned in depth, and one that is too short
    never does: errors of the picture of either sign make free limbs longer, and the longer one works on it, the more.
    (Of all directions of a bone of length L the share that looks l long is l / (L sqrt(L^2 - l^2)) dl.) Legs stand on
    a ground that is seen, and are told by that.
    """
    kin = s.kin
    length, own = kin.offsets(s.shape).norm(dim=-1), kin.offset.norm(dim=-1).clamp(min=1e-6)
    legs, arms = kin.of_legs, kin.of_arms
    if not len(arms):
        return length.new_zeros(len(length))
    stature = (length[:, legs].sum(1) / own[legs].sum()).detach()
    return (length[:, arms] / own[arms] / stature[:, None]).clamp(min=1).log().mean(1)


def prior(s: State) -> Tensor:
    """Shape and camera tilt near what is known before."""
    z = [v.reshape(len(v), -1) for k, v in s.shape.items() if k != "log_length"]
    return torch.cat([*z, s.tilt * 3], 1).square().sum(1) / 40
