"""Colour of the subject against that of its surroundings, learned over the whole clip."""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.reconstruct.segment import box_of, grown

_BINS = 24


@dataclass(frozen=True)
class ColourModel:
    """log p(colour | subject) - log p(colour | surroundings) on a grid of Lab colours (24, 24, 24)."""

    log_ratio: np.ndarray

    @classmethod
    def learn(cls, subject: np.ndarray, surroundings: np.ndarray) -> "ColourModel":
        """From how many pixels of each colour are the subject's and the surroundings' (`count_colours`)."""
        density = []
        for counts in (subject, surroundings):
            counts = counts.reshape((_BINS,) * 3)
            for axis in range(3):
                counts = _blur(counts, axis)
            density.append(counts / max(counts.sum(), 1e-9) + 1e-6)
        return cls(np.log(density[0] / density[1]).astype(np.float32))

    def __call__(self, lab: np.ndarray) -> np.ndarray:
        """Log ratio (H, W) of a Lab picture (H, W, 3) uint8."""
        return self.log_ratio[tuple(np.moveaxis(lab.astype(int) * _BINS // 256, -1, 0))]


def count_colours(lab: np.ndarray) -> np.ndarray:
    """(24^3,) how many of the Lab pixels (P, 3) uint8 fall into each cell of the grid of colours."""
    cells = tuple((lab.astype(np.int32) * _BINS // 256).T)
    return np.bincount(np.ravel_multi_index(cells, (_BINS,) * 3), minlength=_BINS**3).astype(float)


def _blur(x: np.ndarray, axis: int) -> np.ndarray:
    padded = np.pad(x, [(1, 1) if a == axis else (0, 0) for a in range(x.ndim)])
    middle = np.take(padded, range(1, x.shape[axis] + 1), axis)
    before, after = np.take(padded, range(x.shape[axis]), axis), np.take(padded, range(2, x.shape[axis] + 2), axis)
    return 0.5 * middle + 0.25 * (before + after)


def to_lab(frame: np.ndarray) -> np.ndarray:
    """Lab (H, W, 3) uint8 of RGB."""
    return cv2.cvtColor(frame, cv2.COLOR_RGB2LAB)


def learn_colours(frames: np.ndarray, body: dict[int, np.ndarray], *, reach: float = 0.5) -> ColourModel:
    """Colours inside the silhouettes against those around them up to `reach` roots of their area, over the clip."""
    counts = np.zeros((2, _BINS**3))
    for k, mask in body.items():
        near = grown(mask, reach)
        core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        ring = near & ~grown(mask, 0.03)
        lab = to_lab(frames[k])[::2, ::2]
        counts += [count_colours(lab[where[::2, ::2]]) for where in (core, ring)]
    return ColourModel.learn(*counts)


def cut(frame: np.ndarray, probability: np.ndarray, *, iterations: int = 2, margin: float = 0.15) -> np.ndarray:
    """Silhouette (H, W) bool by GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004) started from a probability.

    Pixels surer than 0.95 or less likely than 0.02 are held; the cut sees the neighbourhood of the others only.
    """
    start = probability > 0.5
    if start.sum() < 20:
        return start
    x0, y0, x1, y1 = box_of(start, margin=margin)
    p = probability[y0:y1, x0:x1]
    labels = np.where(p > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[p > 0.95], labels[p < 0.02] = cv2.GC_FGD, cv2.GC_BGD
    if not (p < 0.5).any():
        return start
    cv2.setRNGSeed(0)
    crop = np.ascontiguousarray(frame[y0:y1, x0:x1])
    cv2.grabCut(crop, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), iterations, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    out = np.zeros_like(start)
    out[y0:y1, x0:x1] = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    return out
