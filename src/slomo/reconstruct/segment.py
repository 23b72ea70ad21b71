"""What every segmenter takes and returns, and the steps that they share."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np

from slomo.errors import InvalidData
from slomo.reconstruct.flow import Flow, inside, sample

Report = Callable[[float], None]


@dataclass(frozen=True)
class Masks:
    """The subject's silhouette over time.

    Attributes:
        masks: (T, H, W) bool.
        certainty: (T,) in [0, 1], overlap of each mask with its own probability, where the segmenter has one.
        report: what the segmenter says of itself, for `report.json`.
    """

    masks: np.ndarray
    certainty: np.ndarray | None = None
    report: dict[str, Any] = field(default_factory=dict)


class Segmenter(Protocol):
    """Finds the subject of a clip."""

    name: str

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        """Silhouettes of the subject in (T, H, W, 3) uint8 RGB frames. Raises `InvalidData` when there is none."""
        ...


def no_subject(why: str) -> InvalidData:
    """The error of every segmenter that finds nothing."""
    return InvalidData(
        f"no subject found: {why}",
        where="masks",
        todo="give the subject's masks yourself with --masks DIR, or a clip that shows one animal or person whole",
    )


def box_of(mask: np.ndarray, *, margin: float = 0.0) -> tuple[int, int, int, int]:
    """Bounding box (x0, y0, x1, y1) px, ends exclusive, of a non-empty mask, grown by `margin` of its longer side."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    grow = round(margin * max(xs[-1] - xs[0] + 1, ys[-1] - ys[0] + 1))
    h, w = mask.shape
    return max(0, xs[0] - grow), max(0, ys[0] - grow), min(w, xs[-1] + 1 + grow), min(h, ys[-1] + 1 + grow)


def component_at(mask: np.ndarray, hint: np.ndarray | None = None, *, reach: int = 0) -> np.ndarray:
    """The connected component of `mask` that shares most pixels with `hint`; without a hint, the largest.

    With `reach` (px) components that come as close to it as that, and have a hundredth of its area, belong to it: limbs
    that something hides in part. All False when nothing is found.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask, dtype=bool)
    score = stats[:, cv2.CC_STAT_AREA].astype(float)
    if hint is not None:
        score = np.bincount(labels[hint & mask], minlength=count).astype(float)
    score[0] = 0.0
    best = int(score.argmax())
    if score[best] == 0:
        return np.zeros_like(mask, dtype=bool)
    out = labels == best
    if reach:
        ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        close = np.bincount(labels[cv2.dilate(out.astype(np.uint8), ellipse) > 0], minlength=count) > 0
        close &= stats[:, cv2.CC_STAT_AREA] > 0.01 * stats[best, cv2.CC_STAT_AREA]
        close[0] = False
        out = close[labels]
    return out


def grown(mask: np.ndarray, reach: float) -> np.ndarray:
    """The mask grown by `reach` times the root of its area."""
    side = 2 * round(reach * np.sqrt(max(mask.sum(), 1))) + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def blend_over_time(
    layers: dict[int, np.ndarray], flow: Flow, progress: Report, *, neighbours: int = 2
) -> Iterator[np.ndarray]:
    """Probability (H, W) float32 of each frame in turn, from those of some frames.

    Each frame takes its nearest `neighbours` layers on either side (and its own), carries them along the flow, and
    averages them with weights falling with distance in time: this both fills the frames between and removes flicker.
    """
    T = len(flow.forward) + 1
    keys = np.array(sorted(layers))
    shape = flow.size[::-1]
    spacing = max(1.0, float(np.median(np.diff(keys)))) if len(keys) > 1 else 1.0
    for t in range(T):
        order = keys[np.argsort(abs(keys - t), kind="stable")]
        used = [*order[order <= t][:neighbours], *order[order > t][:neighbours]]
        total, weight = np.zeros(shape, np.float32), np.full(shape, 1e-6, np.float32)
        for k in used:
            offset = flow.chain(t, int(k))
            w = np.exp(-0.5 * ((t - k) / spacing) ** 2) * (0.05 + inside(offset)).astype(np.float32)
            total += w * sample(layers[int(k)].astype(np.float32), offset)
            weight += w
        yield total / weight
        progress((t + 1) / T)


def frame_certainty(probability: np.ndarray, mask: np.ndarray) -> float:
    """In [0, 1], the overlap (soft intersection over union) of `mask` (H, W) bool with its own probability."""
    union = np.maximum(probability, mask)[(probability > 0.05) | mask].sum()
    return float(probability[mask].sum() / union) if mask.any() else 0.0


def frame_quality(masks: np.ndarray, flow: Flow, certainty: np.ndarray | None = None) -> np.ndarray:
    """(T,) in [0, 1], what overlap with the truth to expect.

    Agreement with the neighbours carried along the flow, lessened by jumps of the area against the clip's course and by
    how much of the silhouette's outline lies on the picture's border. Where the segmenter knows its `certainty` (T,),
    that counts most; and a mask that is smaller than those of the second around it is missing something. The exponents
    are those that follow the IoU best on rendered clips (rank correlation .85 over all frames).
    """
    agreement = _agreement(masks, flow)
    if certainty is None:
        return agreement
    area = masks.sum((1, 2)).astype(float)
    usual = np.array([np.quantile(area[max(0, t - 15) : t + 16], 0.75) for t in range(len(area))])
    whole = np.minimum(area / np.maximum(usual, 1.0), 1.0)
    return np.sqrt(certainty) * (agreement * whole) ** 0.125


def _agreement(masks: np.ndarray, flow: Flow) -> np.ndarray:
    T = len(masks)
    area = masks.sum((1, 2)).astype(float)
    quality = np.zeros(T)
    for t in range(T):
        if area[t] == 0:
            continue
        agreement = []
        for other in (t - 1, t + 1):
            if 0 <= other < T:
                carried = sample(masks[other].astype(np.float32), flow.step(t, other)) > 0.5
                agreement.append((carried & masks[t]).sum() / max(1, (carried | masks[t]).sum()))
        usual = np.median(area[max(0, t - 7) : t + 8])
        jump = min(area[t], usual) / max(area[t], usual, 1.0)
        frame = masks[t]
        edge = frame[0].sum() + frame[-1].sum() + frame[:, 0].sum() + frame[:, -1].sum()
        inner = cv2.erode(frame.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1)
        outline = (frame & (inner == 0)).sum()
        quality[t] = np.clip(np.mean(agreement) * jump * (1.0 - edge / max(1, edge + outline)), 0.0, 1.0)
    return quality
