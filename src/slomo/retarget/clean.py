"""From raw key points to smooth ones on a uniform grid: jumps, spikes, gaps."""

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter

from slomo.motion import KeypointMotion
from slomo.runs import runs

_HUBER = 1.5  # residuals beyond this many robust standard deviations lose weight


def resample(motion: KeypointMotion, rate: float) -> KeypointMotion:
    """Linear interpolation onto a uniform grid of `rate` (Hz); a gap keeps the lower of its ends' confidence."""
    count = round((motion.t[-1] - motion.t[0]) * rate) + 1
    t = motion.t[0] + np.arange(count) / rate
    after = np.clip(np.searchsorted(motion.t, t), 1, len(motion.t) - 1)
    w = np.clip((t - motion.t[after - 1]) / (motion.t[after] - motion.t[after - 1]), 0, 1)

    def blend(x: np.ndarray) -> np.ndarray:
        ww = w.reshape(-1, *(1,) * (x.ndim - 1))
        return (1 - ww) * x[after - 1] + ww * x[after]

    c = motion.confidence
    exact = (w == 0)[:, None] * c[after - 1] + (w == 1)[:, None] * c[after]
    between = ((w > 0) & (w < 1))[:, None] * np.minimum(c[after - 1], c[after])
    return replace(
        motion,
        t=t,
        positions=blend(motion.positions),
        confidence=exact + between,
        contact=None if motion.contact is None else blend(motion.contact),
    )


def smooth(x: np.ndarray, weight: np.ndarray, *, dt: float, cutoff: float, least: float = 0.0) -> np.ndarray:
    """Weighted, robust Whittaker smoother: argmin sum w (y - x)^2 + lambda |second difference of y|^2.

    Args:
        x: (T, D).  weight: (T,) >= 0; a zero is a gap that the penalty bridges.
        dt: s.  cutoff: Hz, where a sine loses half its amplitude.
        least: residuals that count as noise in any case: else a jump would be the outlier of a long stand.

    Returns:
        (T, D). Huber weights, re-estimated three times, take spikes out.
    """
    T = len(x)
    if T < 4 or not np.any(weight > 0):
        return x.copy()
    lam = (2 * np.sin(np.pi * min(cutoff * dt, 0.5))) ** -4.0
    # Second-difference penalty D'D in the upper banded form of solveh_banded.
    d0, d1, d2 = np.full(T, 6.0), np.full(T - 1, -4.0), np.ones(T - 2)
    d0[[0, -1]], d0[[1, -2]] = 1.0, 5.0
    d1[[0, -1]] = -2.0
    band = np.zeros((3, T))
    band[0, 2:], band[1, 1:], band[2] = lam * d2, lam * d1, lam * d0
    w = weight.copy()
    y = x
    for _ in range(4):
        a = band.copy()
        a[2] += w + 1e-9
        y = solveh_banded(a, w[:, None] * x)
        r = np.linalg.norm(y - x, axis=1)
        sigma = max(1.4826 * float(np.median(r[weight > 0.5 * weight.max()])), least)
        w = weight * np.minimum(1.0, _HUBER * sigma / np.maximum(r, 1e-12)) ** 2
    return y


def bridge(motion: KeypointMotion) -> KeypointMotion:
    """Positions of missing samples (confidence 0) interpolated between the seen ones of the same key point.

    What stands in the file there is arbitrary. A key point that was never seen goes to the middle of the others.
    """
    positions = motion.positions.copy()
    unseen = []
    for i, c in enumerate(motion.confidence.T):
        known = np.flatnonzero(c > 0)
        if not len(known):
            unseen.append(i)
        elif len(known) < len(c):
            for k in range(3):
                positions[:, i, k] = np.interp(motion.t, motion.t[known], positions[known, i, k])
    if unseen and len(unseen) < len(motion.names):
        others = np.setdiff1d(np.arange(len(motion.names)), unseen)
        positions[:, unseen] = positions[:, others].mean(axis=1, keepdims=True)
    return replace(motion, positions=positions)


def thin(motion: KeypointMotion, rate: float) -> KeypointMotion:
    """Averages over 1/rate s, weighted by confidence, of a motion that is sampled at twice `rate` (Hz) or more.

    Without it, interpolation onto the slower grid would throw samples away instead of averaging their noise.
    """
    n = round((len(motion.t) - 1) / float(motion.t[-1] - motion.t[0]) / rate)
    if n < 2:
        return motion
    starts = np.arange(0, len(motion.t), n)
    count = np.diff(np.append(starts, len(motion.t)))

    def mean(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x, starts, axis=0) / count.reshape(-1, *(1,) * (x.ndim - 1))

    w = motion.confidence + 1e-9
    return replace(
        motion,
        t=mean(motion.t),
        positions=mean(w[..., None] * motion.positions) / mean(w)[..., None],
        confidence=mean(motion.confidence),
        contact=None if motion.contact is None else mean(motion.contact),
    )


def despike(motion: KeypointMotion, *, size: float, window: float) -> KeypointMotion:
    """Confidence 0 for samples further than `size` from the running median over `window` s of the seen samples.

    Samples next to a gap are judged by those beyond it: a bridge would repeat a spike at its end until it looks usual.
    """
    n = max(3, round(window / float(np.median(np.diff(motion.t)))) | 1)
    confidence = motion.confidence.copy()
    for i, c in enumerate(motion.confidence.T):
        known = np.flatnonzero(c > 0)
        if len(known):
            x = motion.positions[known, i]
            away = np.linalg.norm(x - median_filter(x, (n, 1), mode="reflect"), axis=1)
            confidence[known[away > size], i] = 0.0
    return replace(motion, confidence=confidence)


def longest_run(good: np.ndarray) -> slice:
    """The longest run of True in `good` (T,)."""
    return slice(*max(runs(good), key=lambda r: r[1] - r[0], default=(0, 0)))


def cut(motion: KeypointMotion, keep: slice) -> KeypointMotion:
    """The frames in `keep`, times unchanged."""
    return replace(
        motion,
        t=motion.t[keep],
        positions=motion.positions[keep],
        confidence=motion.confidence[keep],
        contact=None if motion.contact is None else motion.contact[keep],
    )
