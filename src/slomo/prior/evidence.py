"""What the sources say about a clip: the networks, a model of the user's, the user's own points; sides decided."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slomo.prior import sides
from slomo.prior.clip import CENTRES, independent, up_over_clip, view_over_clip
from slomo.prior.crop import Box, from_crop, network_input
from slomo.prior.external import ExternalModel
from slomo.prior.frames import Motion
from slomo.prior.inference import Prior, peaks
from slomo.prior.labels import Labels, rotation_of
from slomo.prior.user_keypoints import UserKeypoints
from slomo.skeleton import Skeleton

Array = np.ndarray

GRID = 64  # side of the dense arrays that are kept
SIDE = 0.75  # share of the joints of a pair whose sides a network has right in a clip it has not learnt from
NO_SIDE = 0.5
MODEL_SIDE = 0.75  # of a model of the user's, likewise
_REACH = 0.012  # of the box's side: flow is averaged over this around a key point


@dataclass(frozen=True)
class Shots:
    """The F frames that are looked at.

    Attributes:
        index: (F,) decoded frame. t: (F,) s. box: (F, 3) px. quality: (F,) of the masks, in [0, 1].
        frames: (T, H, W, 3) uint8 of the whole clip. masks: (T, H, W) bool. motion: of the whole clip.
        travel: (F, 36) probability of the view's bins by the way that the subject goes.
    """

    index: Array
    t: Array
    box: Array
    quality: Array
    frames: Array
    masks: Array
    motion: Motion
    travel: Array

    def crop(self, f: int, size: int) -> Array:
        """(6, size, size) float32: what a network is shown of the f-th frame."""
        frame = int(self.index[f])
        motion = self.motion.at(frame)
        return network_input(self.frames[frame], self.masks[frame], motion, Box(*self.box[f]), size)

    def carried(self, places: Array) -> Array:
        """(F-1, ..., 2) px: places (F, ..., 2) px of each frame, carried to the next."""
        out = np.empty((len(places) - 1, *places.shape[1:]))
        for f in range(len(out)):
            flat = places[f].reshape(-1, 2)
            a, b = int(self.index[f]), int(self.index[f + 1])
            out[f] = self.motion.carry(flat, a, b, _REACH * self.box[f, 2]).reshape(places[f].shape)
        return out


@dataclass(frozen=True)
class Columns:
    """Key points of one source: n `names`, `places` (F, n, 2) px of the decoded frames, `confidence` (F, n); `side`:
    the probability that left and right of a pair are not exchanged in a frame."""

    names: tuple[str, ...]
    places: Array
    confidence: Array
    side: float


@dataclass(frozen=True)
class Dense:
    """What only slomo's own networks say: `arrays` by their names in the artifact, see `stage.run`; the body's `axes`,
    and the `length` (F,) px of a body length."""

    arrays: dict[str, Array]
    axes: sides.Axes
    length: Array


Say = Callable[[float], None]


def from_network(
    prior: Prior, skeleton: Skeleton, labels: Labels, shots: Shots, say: Say
) -> tuple[Columns, Dense, dict[str, Any]]:
    """Everything that slomo's network says, with the view and the sides of the clip; and a report."""
    crops = np.empty((len(shots.index), 6, prior.size, prior.size), np.float32)
    for f in range(len(crops)):
        crops[f] = shots.crop(f, prior.size)
        say(0.3 * f / len(crops))
    seen = prior(crops)
    say(0.8)

    view, path = view_over_clip(seen.view, shots.travel, t=shots.t)
    up = up_over_clip(seen.up, seen.view, path, shots.t)
    places, mass = peaks(seen.heat, seen.size)
    sure = mass * seen.seen
    axes = sides.axes(view, up)
    length = _body_length(labels, places, sure, view, up, seen.size) * shots.box[:, 2] / seen.size
    parts, surface = seen.parts.copy(), seen.surface.copy()

    decided = {}
    for pair in sides.limb_pairs(skeleton, labels):
        both = np.stack([pair.left, pair.right])
        at, own, other, two = sides.assign(seen.heat[:, pair.left], seen.heat[:, pair.right], seen.size)
        visible = seen.seen[:, both]
        odd = sides.from_visibility(visible, axes)
        sides.exchange(visible, odd < -0.5 * sides.NATS)
        alone = sides.preference(own, other) + 0.5 * sides.from_parts(parts, at, pair, seen.size) + odd
        px, there = from_crop(at, shots.box[:, None, None], seen.size), np.minimum(own + other, 1)
        decision, settled = _settle(pair, skeleton, px, there, alone, axes, length, shots)
        decided[pair.name] = _summary(decision)
        single = places[:, both]
        for x in (at, there, single):
            sides.exchange(x, decision.swapped)
        at = np.where(two[:, None, :, None], at, single)  # the ends of a blob tell sides, not places
        places[:, both], sure[:, both] = at, there * visible * settled[:, None]
        sides.swap_parts(parts, surface, at, there, pair, seen.size)
    say(0.95)

    apart = np.abs(np.mod(CENTRES - path[:, None] + np.pi, 2 * np.pi) - np.pi)
    report = {
        "left_right": decided,
        "view_certainty": float(np.where(apart < np.radians(25), view, 0).sum(1).mean()),
        "view_repaired_frames": int((np.where(apart < np.radians(45), seen.view, 0).sum(1) < 0.5).sum()),
    }
    # People are as often seen from behind as from the front by a network that errs for a whole clip: of their view's
    # mirror image and of their sides as much is made as the way of travel says.
    told = travelled(shots.travel)[:, None] if labels.kind == "human" else np.ones((len(view), 1))
    side = NO_SIDE + (SIDE - NO_SIDE) * float(told.mean())
    arrays = {
        "part_side": np.float32(side),
        "view": told * view + (1 - told) * 0.5 * (view + front_to_back(view)),
        "view_up": up,
        "view_path": path,
        "parts": np.rint(255 * _grid(parts)).astype(np.uint8),
        "surface": _grid(surface).astype(np.float16),
        "surface_scale": _grid(seen.surface_scale[:, None])[:, 0].astype(np.float16),
    }
    confidence = (sure * shots.quality[:, None]).astype(np.float32)
    px = from_crop(places, shots.box[:, None], seen.size).astype(np.float32)
    return Columns(labels.keypoints, px, confidence, side), Dense(arrays, axes, length), report


def travelled(travel: Array) -> Array:
    """(F,) how much the way of travel says, of (F, 36) probabilities of the view: 0 where all are alike."""
    return 1 - travel.shape[1] * travel.min(1)


def front_to_back(view: Array) -> Array:
    """(F, 36) the view of a body of the same outline that looks the other way: azimuth a becomes pi - a."""
    return np.roll(view[:, ::-1], 1 + view.shape[1] // 2, 1)


def from_model(
    model: ExternalModel, skeleton: Skeleton, labels: Labels, shots: Shots, dense: Dense | None, say: Say
) -> tuple[Columns, dict[str, Any]]:
    """What a model of the user's says, its sides decided for the clip."""
    names = model.mapping.names
    where = [labels.keypoints.index(n) for n in names]
    F = len(shots.index)
    places, sure = np.zeros((F, len(labels.keypoints), 2)), np.zeros((F, len(labels.keypoints)))
    for f, frame in enumerate(shots.index):
        places[f, where], sure[f, where] = model(shots.frames[frame], Box(*shots.box[f]))
        say(f / F)
    unknown = sides.Axes(np.zeros((F, 3)), np.zeros((F, 2, 2)))
    axes, length = (dense.axes, dense.length) if dense else (unknown, 0.5 * shots.box[:, 2])
    decided = {}
    for pair in sides.limb_pairs(skeleton, labels):
        both = np.stack([pair.left, pair.right])
        if not np.isin(both, where).all(0).any():
            continue
        at, there = places[:, both], sure[:, both]  # what is not mapped has no confidence and stays at the origin
        alone = sides.NATS * there.min(1)  # it is more often right than not
        decision, _ = _settle(pair, skeleton, at, there, alone, axes, length, shots)
        decided[pair.name] = _summary(decision)
        mapped = np.isin(both, where).all(0)
        for x in (at, there):
            sides.exchange(x, decision.swapped & mapped)
        places[:, both], sure[:, both] = at, there
    columns = Columns(names, places[:, where].astype(np.float32), sure[:, where].astype(np.float32), MODEL_SIDE)
    return columns, {"left_right": decided}


def from_user(user: UserKeypoints, frame: Array, places: Array, shots: Shots) -> tuple[Columns, dict[str, Any]]:
    """The user's points at the frames that are looked at; those of frames between are carried along the flow.

    Args:
        frame: (n,) fractional decoded frames of the points. places: (n, N, 2) px of the decoded frames.
    """
    F, N = len(shots.index), len(user.names)
    out, confidence, unused = np.zeros((F, N, 2), np.float32), np.zeros((F, N), np.float32), 0
    step = int(np.median(np.diff(shots.index))) if F > 1 else 1
    nearest = np.abs(shots.index[:, None] - frame).argmin(0)
    gap = np.abs(shots.index[nearest] - frame)
    for i in np.argsort(-gap, kind="stable"):  # the nearest last: it stays
        f = int(nearest[i])
        if gap[i] > 0.5 * step + 0.5:
            unused += 1
            continue
        said = user.points[i, :, 2] > 0
        source = int(np.clip(round(float(frame[i])), 0, len(shots.masks) - 1))
        reach = _REACH * shots.box[f, 2]
        out[f, said] = shots.motion.carry(places[i, said], source, int(shots.index[f]), reach)
        confidence[f, said] = user.points[i, said, 2]
    report = {"frames_given": len(frame), "frames_unused": unused, "points": int((confidence > 0).sum())}
    return Columns(user.names, out, confidence, 1.0), report


def _settle(
    pair: sides.Pair, skeleton: Skeleton, at: Array, there: Array, alone: Array, axes: sides.Axes, length: Array,
    shots: Shots,
) -> tuple[sides.Decision, Array]:  # fmt: skip
    """Which joints of a pair are to be exchanged, and what the doubt leaves of their confidence, (F, n).

    Args:
        at: (F, 2, n, 2) px, left and right. there: (F, 2, n) in [0, 1], whether there is one of the two.
        alone: (F, n) nats that the source itself says of each frame. length: (F,) px.
    """
    rest = skeleton.rest()
    weight = there.min(1)
    apart = (at[:, 0] - at[:, 1]) / length[:, None, None]
    width = rest[pair.left, 1] - rest[pair.right, 1]
    bone = np.linalg.norm(rest[pair.left] - rest[pair.left[pair.parent]], axis=-1)
    alone = (alone + weight * sides.from_view(apart, axes, width)) * independent(shots.t)[:, None]
    along = np.minimum(weight, weight[:, pair.parent]) * sides.hanging_together(apart, bone, pair.parent)
    together = sides.from_motion(at, shots.carried(at), there, shots.box[:, 2], shots.t)
    decision = sides.decide(alone, along, together, pair.parent)
    return decision, sides.identity(decision, at[:, 0] - at[:, 1], shots.box[:, 2])


def _summary(decision: sides.Decision) -> dict[str, Any]:
    return {
        "swapped": float(decision.swapped.mean()),
        "margin": decision.margin,
        "certainty": float(decision.sure.mean()),
    }


def _body_length(labels: Labels, places: Array, sure: Array, view: Array, up: Array, size: int) -> Array:
    """(F,) px of the crop that a body length takes: how large the trunk is seen, of the size it has from that side."""
    x = places[:, labels.trunk]
    weight = sure[:, labels.trunk] + 1e-3
    weight /= weight.sum(1, keepdims=True)
    R = rotation_of(CENTRES[view.argmax(1)], up)
    model = labels.trunk_rest @ np.swapaxes(R, -1, -2)[..., :2]
    spread = []
    for y in (x, model):
        y = y - (weight[..., None] * y).sum(1, keepdims=True)
        spread.append(np.sqrt((weight * (y**2).sum(-1)).sum(1)))
    return np.clip(spread[0] / np.maximum(spread[1], 1e-6), 0.3 * size, 0.9 * size)


def _grid(x: Array) -> Array:
    """(F, C, 64, 64) of (F, C, h, w)."""
    if x.shape[-1] == GRID:
        return x
    last = [np.ascontiguousarray(p.transpose(1, 2, 0)) for p in x]
    small = [cv2.resize(p, (GRID, GRID), interpolation=cv2.INTER_AREA) for p in last]
    return np.stack([p.reshape(GRID, GRID, -1).transpose(2, 0, 1) for p in small])
