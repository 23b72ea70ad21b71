"""Terms of the fit that compare the posed body with `Evidence`: the view, key points, parts and the body's surface.

Each maps the evidence and a `State` to one number per hypothesis, of order one when the pose is off by a limb's width.
All are robust and weighed by the confidence of who says it, so that evidence that is wrong in some frames is outvoted
by the frames around, the silhouette and the flow. A frame that nothing is said about adds 0, and the sums are divided
by all the frames: little evidence weighs little.
"""

import math
from collections.abc import Mapping
from functools import partial

import torch

from slomo.prior.labels import BINS
from slomo.reconstruct import silhouette
from slomo.reconstruct.evidence import Evidence
from slomo.reconstruct.state import State, Term

Tensor = torch.Tensor

DOUBT = 0.1  # share of a uniform distribution that the view's is mixed with
CONCENTRATION = 33.0  # of the kernel between azimuth bins: about one bin wide
VIEW_UNIT = 3.0  # nats
VIEW_OFF = 2  # bins of 10 degrees, by which the view of a whole clip may be off
UP_UNIT = 1 - math.cos(math.radians(20.0))
UP_SHARE = 0.2  # of the body's up axis in the view term
PART_PX = 5.0
# Tenths of the subject's size: joints of the skeleton and those that a network has learnt, or a user clicks, are not
# the same points of the body by about this much. Evidence tells the poses apart; within this the silhouette is better.
PRECISE = 0.3


def terms(evidence: Evidence) -> Mapping[str, Term]:
    """The terms that there is any evidence for, as `Problem` takes them."""
    each = dict(view=view, keypoints=keypoints, parts=parts, surface=surface)
    return {name: partial(each[name], evidence) for name in evidence.groups}


def doubtful(view: Tensor) -> Tensor:
    """(..., 36) negative log of azimuth probabilities mixed with a uniform one, 0 at the best bin, in 3 nats."""
    nats = -(DOUBT + (1 - DOUBT) * BINS * view).log()
    return (nats - nats.amin(-1, keepdim=True)) / VIEW_UNIT


def widened(table: Tensor) -> Tensor:
    """(..., 36) the least of a table over azimuth bins within `VIEW_OFF` bins of each: a network misjudges the length
    or the width of one body by the same angle in every frame, and no number of frames outweighs that."""
    return torch.stack([table.roll(n, -1) for n in range(-VIEW_OFF, VIEW_OFF + 1)]).amin(0)


def at_azimuth(table: Tensor, azimuth: Tensor) -> Tensor:
    """(H, F) values of a table (F, 36) over azimuth bins at azimuth (H, F) rad, smooth (von Mises kernel)."""
    centres = torch.arange(BINS) * (2 * math.pi / BINS)
    kernel = (CONCENTRATION * (torch.cos(azimuth[..., None] - centres) - 1)).exp()
    return (kernel * table).sum(-1) / kernel.sum(-1)


def view(e: Evidence, s: State) -> Tensor:
    """The root's azimuth against its distribution, and a little of the body's up axis."""
    to_body = s.body.nodes[:, :, e.trunk].mean(2) - s.centre
    to_camera = -(to_body[..., None, :] @ s.R_root)[..., 0, :]
    azimuth = torch.atan2(to_camera[..., 1], to_camera[..., 0])
    miss = at_azimuth(widened(doubtful(e.view)), azimuth)
    # Into the view frame: the least turn that brings the direction to the body onto the optical axis (Rodrigues).
    z = torch.nn.functional.normalize((s.R_cam @ to_body[..., None])[..., 0], dim=-1)
    up = (s.R_cam @ s.R_root[..., 2:])[..., 0]
    v = torch.stack([z[..., 1], -z[..., 0], torch.zeros_like(z[..., 0])], -1)
    across = torch.linalg.cross(v, up)
    up = up + across + torch.linalg.cross(v, across) / (1 + z[..., 2:]).clamp(min=1e-3)
    tilted = (1 - (up * e.up).sum(-1)) / UP_UNIT
    each = miss + UP_SHARE * tilted / (1 + tilted)
    return (each * e.view_weight).mean(1)


def keypoints(e: Evidence, s: State) -> Tensor:
    """Nodes of the skeleton against their 2-D key points, in tenths of the subject's size (Cauchy's robust error)."""
    return keypoints_by_frame(e, s).mean(1)


def keypoints_by_frame(e: Evidence, s: State) -> Tensor:
    """(H, F) the same of every fit frame.

    Left and right of a pair are a mixture of the two ways round: a frame that has them wrong costs the right pose no
    more than the logarithm of the odds, and many frames that agree decide.
    """
    X = silhouette.to_camera(s.R_cam, s.centre, s.body.nodes[:, :, e.node])
    total = _distance(e, s, X[:, :, e.alone], e.uv[:, e.alone], e.confidence[:, e.alone]).sum(2)
    (i, j), uv, sure = e.pairs, e.uv, e.confidence
    own = _distance(e, s, X[:, :, i], uv[:, i], sure[:, i]) + _distance(e, s, X[:, :, j], uv[:, j], sure[:, j])
    other = _distance(e, s, X[:, :, i], uv[:, j], sure[:, j]) + _distance(e, s, X[:, :, j], uv[:, i], sure[:, i])
    either = -torch.logaddexp(e.pair_side.log() - own, (1 - e.pair_side).log() - other)
    return (total + either.sum(2)) / len(s.kin.link)


def surface(e: Evidence, s: State) -> Tensor:
    """Where the points of the body that pixels are said to see are seen, likewise."""
    H, F, M = len(s.R_root), *e.capsule.shape
    index = e.capsule[None, :, :, None].expand(H, F, M, 3)
    a, b = torch.gather(s.body.a, 2, index), torch.gather(s.body.b, 2, index)
    r = s.body.radii[:, e.capsule]
    r = r[..., 0] + e.along * (r[..., 1] - r[..., 0])
    frames = torch.arange(F)[:, None]
    R = s.body.R[:, frames, s.kin.c_link[e.capsule]]
    X = a + e.along[..., None] * (b - a) + r[..., None] * (R @ e.normal[..., None])[..., 0]
    return _distance(e, s, silhouette.to_camera(s.R_cam, s.centre, X), e.seen, e.sure).mean((1, 2))


def _distance(e: Evidence, s: State, X: Tensor, uv: Tensor, weight: Tensor) -> Tensor:
    """(H, F, N) weighted robust distances of the pictures of camera-frame points X (H, F, N, 3) from uv (F, N, 2)."""
    u, v, _ = silhouette.project(s.obs.K, X)
    d = torch.sqrt((u - uv[..., 0]) ** 2 + (v - uv[..., 1]) ** 2 + 1e-6) / e.unit[:, None]
    return weight * torch.log1p((d - PRECISE).clamp(min=0) ** 2)


def parts(e: Evidence, s: State) -> Tensor:
    """Pixels of the mask against the body part that they are said to show: how far they are from its capsules."""
    n, S = s.inside, e.part.shape[1]
    x0, y0, side = e.box[s.seen][..., None].unbind(1)
    column = ((s.u[:, :n] + 0.5 - x0) * (S / side)).long().clamp(0, S - 1)
    row = ((s.v[:, :n] + 0.5 - y0) * (S / side)).long().clamp(0, S - 1)
    cell = s.seen[:, None], row, column
    of = e.part_capsules[e.part[cell]]
    near = silhouette.least_of(s.sd[:, :, :n], of.expand(len(s.sd), *of.shape)).clamp(min=0) / PART_PX
    far = (e.chance[cell] * near / (1 + near / 3)).sum(-1)
    return (far.mean(2) * e.parts_weight[s.seen]).mean(1)
