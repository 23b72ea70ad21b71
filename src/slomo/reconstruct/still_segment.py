"""Segmenter for a camera that stands still: whatever differs from the picture without it.

The background is each pixel's median over the clip, so the subject has to leave every place for half of the time.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from slomo.reconstruct.background import PATTERN, SHADOW, alike, log_odds, shade_factor
from slomo.reconstruct.colour import learn_colours, to_lab
from slomo.reconstruct.flow import Flow
from slomo.reconstruct.instances import Choice, follow
from slomo.reconstruct.segment import (
    Masks,
    Report,
    blend_over_time,
    box_of,
    component_at,
    frame_certainty,
    grown,
    no_subject,
)

_STILL_PX = 0.15  # median motion of the picture from one frame to the next
_DRIFT_PX = 1.5  # and over the whole clip
_SAMPLES = 48  # frames that the background is taken from
_NOISE = 4.0  # levels of RGB that compression leaves
_SOFT_PX = 0.8  # of the smoothing before frames are compared
_SEEN = 0.6  # of the time, for which the subject may cover a place whose background is known
_LEAST = 0.0015  # of the picture, a subject
_SHADE = -0.1  # log odds of what could be the background in shade: the colours decide, a dark coat looks so too
_SHADOWS = 200  # pixels of that, which tell how dark shadows are
_DEEPER = 0.08  # of the factor, by which shadows may be darker than that tells
_SURELY = 2.0  # log odds, of what belongs to the subject though nothing joins it


def stands_still(flow: Flow) -> bool:
    """Whether most of the picture does not move, neither from frame to frame nor in all."""
    step = np.array([np.median(field.astype(np.float32), axis=(0, 1)) for field in flow.forward])
    course = np.concatenate([np.zeros((1, 2), np.float32), np.cumsum(step, 0)])
    return bool(np.quantile(np.abs(step), 0.9) < _STILL_PX and np.ptp(course, axis=0).max() < _DRIFT_PX)


@dataclass(frozen=True)
class StillSegmenter:
    """Difference from the background, then colour.

    Attributes:
        choice: whom the user means.
        rounds: times that background and colours are learned again from the silhouettes.
    """

    choice: Choice = field(default_factory=Choice)
    rounds: int = 3
    name: str = "still"

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        T = len(frames)
        if not stands_still(flow):
            raise no_subject("the segmenter still is for a camera that stands still, and this one moves")
        sampled = np.linspace(0, T - 1, min(T, _SAMPLES)).round().astype(int)
        covered = np.zeros(frames.shape[:3], bool)
        body: dict[int, np.ndarray] = {}
        for turn in range(self.rounds):
            median, spread = _background(frames, covered, sampled)
            darkest = _darkest_shade(frames, body, median, spread) if body else SHADOW[0]
            if not body:
                pieces = {t: _pieces(_differs(frames[t], median, spread, darkest)) for t in range(T)}
                body = follow(pieces, flow, self.choice)
            seen = {t: b for t, b in body.items() if b.mean() > 0.3 * _LEAST}
            if len(seen) < 0.3 * T or np.median([b.mean() for b in seen.values()]) < _LEAST:
                raise no_subject("nothing large enough differs from the background of a camera that stands still")
            model = learn_colours(frames, {t: seen[t] for t in list(seen)[:: max(1, len(seen) // 40)]})
            for t in range(T):
                if body[t].any():
                    differs = _differs(frames[t], median, spread, darkest)
                    body[t] = _refined(frames[t], differs, body[t], model)
                covered[t] = grown(body[t], 0.1) if body[t].any() else body[t]
                progress((turn + (t + 1) / T) / (self.rounds + 0.2))
        shown = [t for t in range(T) if body[t].any()]
        if not shown or _crowded(body, shown) > 0.3:
            raise no_subject("what differs from the background hardly leaves its place")
        masks, certainty = np.empty(frames.shape[:3], bool), np.zeros(T)
        for t, p in enumerate(blend_over_time(body, flow, lambda f: None, neighbours=1)):
            masks[t] = component_at(p > 0.45, body[t] if body[t].any() else None, reach=_reach(p > 0.5))
            masks[t] = _trimmed(masks[t] | _parts(p > 0.45, body[t]), frames[t], median)
            certainty[t] = frame_certainty(p, masks[t])
        return Masks(masks, certainty, {"chosen": self.choice.how})


def _crowded(body: dict[int, np.ndarray], shown: list[int]) -> float:
    """Part of the silhouettes where the box around them is for so long that the background there is not known: the
    silhouettes themselves have holes then."""
    covered = np.zeros(body[shown[0]].shape, np.float32)
    for t in shown:
        x0, y0, x1, y1 = box_of(body[t])
        covered[y0:y1, x0:x1] += 1 / len(body)
    return float(np.mean([(covered[body[t]] > _SEEN).mean() for t in shown]))


def _soft(frame: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(frame.astype(np.float32), (0, 0), _SOFT_PX)


def _reach(mask: np.ndarray) -> int:
    return round(0.06 * np.sqrt(mask.sum()))


def _background(frames: np.ndarray, covered: np.ndarray, sampled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median (H, W, 3) of the frames `sampled` where nothing covers it, and (H, W) the median distance from it.

    A row of pixels at a time: all samples at once of a large picture would not fit into a small memory.
    """
    H, W = frames.shape[1:3]
    stack = [_soft(frames[t]) for t in sampled]
    median, spread = np.empty((H, W, 3), np.float32), np.empty((H, W), np.float32)
    for y in range(H):
        row = np.stack([s[y] for s in stack])
        hidden = covered[sampled, y]
        hidden &= ~hidden.all(0)
        order = np.sort(np.where(hidden[..., None], np.inf, row), axis=0)
        middle = (len(sampled) - hidden.sum(0) - 1) // 2
        median[y] = np.take_along_axis(order, middle[None, :, None], 0)[0]
        apart = np.sort(np.where(hidden, np.inf, np.abs(row - median[y]).mean(-1)), axis=0)
        spread[y] = np.take_along_axis(apart, middle[None], 0)[0]
    return median, spread


def _differs(frame: np.ndarray, median: np.ndarray, spread: np.ndarray, darkest: float) -> np.ndarray:
    return log_odds(_soft(frame), median, spread, _NOISE, shade=_SHADE, darkest=darkest)


def _darkest_shade(frames: np.ndarray, body: dict[int, np.ndarray], median: np.ndarray, spread: np.ndarray) -> float:
    """The factor that cast shadows of this clip are not darker than.

    One light makes shadows of one depth, and they keep the pattern of what they fall on, which a coat does not. A dark
    coat may look like any shade; what is darker than the darkest shadow is the coat.
    """
    found = []
    for t in list(body)[:: max(1, len(body) // _SAMPLES)]:
        now = _soft(frames[t])
        open_ = np.abs(_differs(frames[t], median, spread, SHADOW[0]) - _SHADE) < 1e-6
        pattern = open_ & grown(body[t], 0.3) & (alike(now.mean(-1), median.mean(-1)) > PATTERN)
        found.append(shade_factor(now, median)[pattern])
    factors = np.concatenate(found)
    return max(SHADOW[0], float(np.quantile(factors, 0.1)) - _DEEPER) if len(factors) > _SHADOWS else SHADOW[0]


def _trimmed(mask: np.ndarray, frame: np.ndarray, median: np.ndarray) -> np.ndarray:
    """The mask without pixels of its outermost ring that differ from the background by less than half of what the body
    next to them does: those show more background than body, by the camera's blur and the compression's."""
    size = np.linalg.norm(frame.astype(np.float32) - median, axis=-1)
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    total, count = (cv2.boxFilter(x, -1, (5, 5), normalize=False) for x in (size * core, core))
    return mask & ((core > 0) | (size * count >= 0.5 * total))


def _pieces(differs: np.ndarray) -> np.ndarray:
    """(H, W) bool of what surely differs; pieces that are near each other are one."""
    sure = cv2.morphologyEx((differs > 0.5).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.morphologyEx(sure, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0


def _refined(frame: np.ndarray, differs: np.ndarray, body: np.ndarray, model) -> np.ndarray:
    """Silhouette (H, W) bool near where it was, from the difference and the colours."""
    near = grown(body, 0.3)
    colour = cv2.GaussianBlur(model(to_lab(frame)), (0, 0), 0.8)
    logit = 1.5 * differs + 0.5 * np.clip(colour, -2.5, 2.5) - 0.3
    probability = np.where(near, 1 / (1 + np.exp(-logit)), 0.0)
    whole = component_at(probability > 0.5, body, reach=_reach(body))
    # A dark leg on dark ground leaves the foot alone: what surely differs, nearer than a leg is long, belongs to it.
    sure = _parts(differs > _SURELY, near)
    return whole | sure if whole.any() else whole


def _parts(mask: np.ndarray, body: np.ndarray) -> np.ndarray:
    """The components of `mask` of which more than half lies in `body`, and that are neither specks beside it nor as
    large as another animal."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    keep = np.bincount(labels[body & mask], minlength=count) > 0.5 * area
    keep &= (area > max(4, 0.002 * body.sum())) & (area < 0.15 * body.sum())
    keep[0] = False
    return np.isin(labels, np.flatnonzero(keep))
