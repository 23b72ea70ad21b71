"""What of a picture shares the subject's motion against the background: neither a box that it walks past, nor a post in
front of it, nor an animal that goes another way."""

from collections.abc import Mapping

import cv2
import numpy as np

from slomo.reconstruct.flow import Flow, inside, sample
from slomo.reconstruct.instances import components
from slomo.reconstruct.motion_segment import residual_motion
from slomo.reconstruct.segment import box_of, grown

_SIDE = 256  # px, longer side at which motion is looked at
_GAP = 4  # frames over which it is taken, either way
MOVES = 2.0  # px at that size and over that gap, from which on a body as a whole is said to move
_FOREIGN = 0.2  # part of the body's motion, below which a patch does not share it
_LOST = 64.0  # px, a motion that flow cannot have followed
_ASTRAY = 1.5  # px, median motion of the whole picture, from which on the homography has not been found
_BENDS = 1.5  # px of motion that no flat thing has, from which on a body is said to be alive
_CALM = 0.3, 0.45  # px as a whole and of bending, likewise before a camera that stands still, where things have 0.06
ALIKE = 10.0  # levels of RGB, between two frames of a thing that is still the same
_LEG, _LOW = 0.25, 0.2  # of the body's area a leg at most; of its height, within which it ends above the lowest row
_BESIDE = 2  # frames of several, either way, in which is looked for what a body leaves behind
_KEPT = 64  # frames whose motion is remembered
_STILL = 0.3  # px of the median motion, below which the camera stands still and nothing has parallax


class SharedMotion:
    """Motion against the homography that most of the picture follows, frame by frame."""

    def __init__(self, flow: Flow):
        self._flow = flow
        self._factor = _SIDE / max(flow.size)
        self.size = (round(flow.size[0] * self._factor), round(flow.size[1] * self._factor))
        self._known: dict[int, np.ndarray] = {}
        self._drift: dict[int, float] = {}  # px, median motion of the whole picture

    def residual(self, t: int) -> np.ndarray:
        """(h, w, 2) float32 px at `_SIDE` over `_GAP` frames; NaN where something covers or uncovers the pixel, so that
        the flow to neither side leads there and home again."""
        if t not in self._known:
            last = len(self._flow.forward)
            ends = [u for u in (t - _GAP, t + _GAP) if 0 <= u <= last] or [last if t < last / 2 else 0]
            fields, errors, drift = [], [], []
            for u in ends:
                there, back = self.chain(t, u), self.chain(u, t)
                drift.append(float(np.median(np.linalg.norm(there, axis=-1))) * _GAP / abs(u - t))
                fields.append(residual_motion(there) * (_GAP / (u - t)))
                errors.append(np.linalg.norm(there + sample(back, there), axis=-1, keepdims=True))
            best = fields[0] if len(ends) == 1 else np.where(errors[0] < errors[1], *fields)
            size = np.linalg.norm(best, axis=-1, keepdims=True)
            unsure = (np.minimum.reduce(errors) > 1.0 + 0.1 * size) | (size > _LOST)
            if unsure.mean() > 0.6 or np.median(size[~unsure]) > _ASTRAY:
                unsure[:] = True
            while len(self._known) >= _KEPT:
                self._known.pop(next(iter(self._known)))
            self._known[t] = np.where(unsure, np.nan, best).astype(np.float16)
            self._drift[t] = max(drift)
        return self._known[t].astype(np.float32)

    def velocity(self, t: int, mask: np.ndarray) -> np.ndarray:
        """(2,) px at `_SIDE` over `_GAP` frames: the median motion of (H, W) bool in frame t."""
        inside = self._inside(t, mask)
        return np.median(inside, axis=0) if len(inside) > 10 else np.zeros(2, np.float32)

    def liveliness(self, t: int, mask: np.ndarray) -> float:
        """How surely (H, W) bool is alive in frame t; from 1 on it is: it moves fast as a whole, or its liveliest tenth
        moves in a way that no flat thing does (what an affine motion leaves), as parallax cannot make a box do. Before
        a camera that stands still nothing but noise moves a thing, and much less is enough."""
        small = cv2.resize(mask.astype(np.float32), self.size, interpolation=cv2.INTER_AREA) > 0.9
        y, x = np.nonzero(small & np.isfinite(self.residual(t)[..., 0]))
        if len(x) < 20:
            return 0.0
        motion = self.residual(t)[y, x]
        design = np.stack([x, y, np.ones(len(x))], 1).astype(np.float32)
        rest = np.linalg.norm(motion - design @ np.linalg.lstsq(design, motion, rcond=None)[0], axis=-1)
        calm = rest <= np.quantile(rest, 0.7)  # limbs must not bend the motion of the whole
        rest = np.linalg.norm(motion - design @ np.linalg.lstsq(design[calm], motion[calm], rcond=None)[0], axis=-1)
        fast, bends = _CALM if self._drift[t] < _STILL else (2.0 * MOVES, _BENDS)
        return float(max(np.quantile(rest, 0.9) / bends, np.linalg.norm(np.median(motion, axis=0)) / fast))

    def movers(self, t: int) -> list[np.ndarray]:
        """Where (H, W) bool something moves in frame t, at most three places, by how much moves there."""
        size = np.nan_to_num(np.linalg.norm(self.residual(t), axis=-1)).astype(np.float32)
        fast = cv2.morphologyEx((size > 0.5 * MOVES).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        pieces = components(fast > 0, 20)
        pieces.sort(key=lambda piece: -float(size[piece].sum()))
        whole = lambda m: cv2.resize(m.astype(np.uint8), self._flow.size, interpolation=cv2.INTER_NEAREST) > 0  # noqa: E731
        return [whole(piece) for piece in pieces[:3]]

    def calm(self, t: int) -> np.ndarray:
        """(H, W) bool, what is not known to move in frame t."""
        moves = np.nan_to_num(np.linalg.norm(self.residual(t), axis=-1)) > 0.5 * MOVES
        return cv2.resize(moves.astype(np.uint8), self._flow.size, interpolation=cv2.INTER_NEAREST) == 0

    def lasting(self, t: int, patch: np.ndarray, bodies: Mapping[int, np.ndarray]) -> np.ndarray:
        """(H, W) bool, what of a patch (H, W) in frame t lies in the body (H, W) bool of every frame of `bodies`, where
        the flow carries it there."""
        small = cv2.resize(patch.astype(np.uint8), self.size, interpolation=cv2.INTER_NEAREST) > 0
        for k, body in bodies.items():
            if k != t and small.any():
                there = cv2.resize(body.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)
                small &= sample(there, self.chain(t, k)) > 0.5
        return patch & (cv2.resize(small.astype(np.uint8), self._flow.size, interpolation=cv2.INTER_NEAREST) > 0)

    def gone(self, t: int, patch: np.ndarray, frames: np.ndarray, bodies: Mapping[int, np.ndarray]) -> np.ndarray:
        """(H, W) bool, what of a patch (H, W) in frame t is not left behind when the body (H, W) bool has moved on: the
        foot and the leg on which it stood. Where flow leads, and where the ground goes, the frames of `bodies` around
        show something else there. Pieces of which most is covered or out of the picture in all of them are not gone.
        Nor is what cannot be a leg, large or high up: a companion who walks away."""
        small = lambda m: cv2.resize(m.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)  # noqa: E731
        out, at = np.zeros_like(patch), sorted(bodies)
        if not patch.any():
            return out
        here, n = small(frames[t]), at.index(t)
        again, free = np.zeros((2, *here.shape[:2]), bool)
        for k in (*at[max(0, n - _BESIDE) : n], *at[n + 1 : n + 1 + _BESIDE]):
            flow = self.chain(t, k)
            there, body = small(frames[k]), small(grown(bodies[k], 0.05))
            for offset in (flow, flow - residual_motion(flow)):
                clear = inside(offset) & (sample(body, offset) < 0.2)
                free |= clear
                again |= clear & (np.abs(sample(there, offset) - here).mean(-1) < ALIKE)
        _, top, _, bottom = box_of(bodies[t])
        low = bottom - _LOW * (bottom - top)
        for piece in components(patch, 1):
            if piece.sum() > _LEG * bodies[t].sum() or box_of(piece)[3] < low:
                continue
            seen = small(piece) > 0.5
            if (free & seen).sum() > 0.5 * seen.sum() and (again & seen).sum() < 0.5 * (free & seen).sum():
                out |= piece
        return out

    def apart(
        self, t: int, frames: np.ndarray, bodies: Mapping[int, np.ndarray], others: Mapping[int, np.ndarray]
    ) -> np.ndarray:
        """(H, W) bool, what of the body in frame t is no part of it: a box that it touches now. In another frame of
        `bodies` it is seen again, looking the same and where the flow carries it, but as one of two things apart: the
        body there and what stands out beside it, `others`. The less lively of the two is not the body."""
        small = lambda m: cv2.resize(m.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)  # noqa: E731
        here, body = small(frames[t]), small(bodies[t]) > 0.5
        again = np.zeros((2, *body.shape), bool)
        for k in bodies:
            if k != t and others[k].any():
                there = self.chain(t, k)
                alike = np.abs(sample(small(frames[k]), there) - here).mean(-1) < ALIKE
                again |= [alike & (sample(small(m[k]), there) > 0.5) for m in (others, bodies)]
        wide = [wider_than_a_leg(body & seen, body).astype(np.uint8) for seen in again]
        other, own = (bodies[t] & (cv2.resize(w, self._flow.size) > 0) for w in wide)
        if other.any():
            if self.liveliness(t, other) < 0.5 * self.liveliness(t, bodies[t] & ~other):
                return other
            if own.any() and self.liveliness(t, own) < 0.5 * self.liveliness(t, other):
                return own
        return np.zeros_like(bodies[t])

    def _inside(self, t: int, mask: np.ndarray) -> np.ndarray:
        """(n, 2) what of the residual is known and lies in (H, W) bool."""
        small = cv2.resize(mask.astype(np.float32), self.size, interpolation=cv2.INTER_AREA) > 0.9
        inside = self.residual(t)[np.asarray(small)]
        return inside[np.isfinite(inside[:, 0])]

    def share(self, t: int, velocity: np.ndarray) -> np.ndarray | None:
        """(H, W): how much of the `velocity` (2,) of a body each pixel has along the same direction: 1 of a part of it,
        0 of the background, less of what goes the other way, NaN where that cannot be seen. None of a body at rest."""
        speed = float(np.linalg.norm(velocity))
        if speed < MOVES:
            return None
        return cv2.resize(self.residual(t) @ (velocity / speed**2), self._flow.size, interpolation=cv2.INTER_NEAREST)

    def chain(self, source: int, target: int) -> np.ndarray:
        """(h, w, 2) px at `_SIDE` from frame `source` to `target`."""
        total = np.zeros((self.size[1], self.size[0], 2), np.float32)
        direction = 1 if target > source else -1
        for t in range(source, target, direction):
            field = self._flow.forward[t] if direction > 0 else self._flow.backward[t - 1]
            small = cv2.resize(field.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)
            total += sample(self._factor * small, total)
        return total


def foreign(
    found: np.ndarray, subject: np.ndarray, share: np.ndarray | None, *, known: np.ndarray | None = None
) -> np.ndarray:
    """(H, W) bool, patches of `found` that do not share the subject's motion, as `SharedMotion.share` has it.

    Only what is wider than a leg: a leg that stands has the ground's motion too. And nothing most of which is `known`
    to be the subject's: a head may turn as it likes.
    """
    if share is None:
        return np.zeros_like(found)
    calm = found & (share < _FOREIGN)
    patches = calm & wider_than_a_leg(calm, subject)
    if known is not None and patches.any():
        labels = np.asarray(cv2.connectedComponents(patches.astype(np.uint8))[1], int)
        mostly = np.bincount(labels[known], minlength=int(labels.max()) + 1) > 0.5 * np.bincount(labels.ravel())
        patches &= ~mostly[labels]
    return patches


def wider_than_a_leg(patch: np.ndarray, subject: np.ndarray) -> np.ndarray:
    """(H, W) bool, what of a patch is wider than a leg of the subject, and two pixels around it."""
    radius = max(2, round(0.07 * np.sqrt(max(subject.sum(), 1))))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    core = cv2.morphologyEx(patch.astype(np.uint8), cv2.MORPH_OPEN, disc)
    return cv2.dilate(core, np.ones((5, 5), np.uint8)) > 0
