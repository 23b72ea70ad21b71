"""From raw key points to smooth ones on a uniform grid: jumps, spikes, gaps."""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter

from slomo.motion import KeypointMotion

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
    return KeypointMotion(
        t=t,
        positions=blend(motion.positions),
        names=motion.names,
        confidence=exact + between,
        contact=None if motion.contact is None else blend(motion.contact),
        contact_names=motion.contact_names,
    )


def smooth(x: np.ndarray, weight: np.ndarray, *, dt: float, cutoff: float) -> np.ndarray:
    """Weighted, robust Whittaker smoother: argmin sum w (y - x)^2 + lambda |second difference of y|^2.

    Args:
        x: (T, D).  weight: (T,) >= 0; a zero is a gap that the penalty bridges.
        dt: s.  cutoff: Hz, where a sine loses half its amplitude.

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
        sigma = 1.4826 * np.median(r[weight > 0])
        w = weight * np.minimum(1.0, _HUBER * sigma / np.maximum(r, 1e-12)) ** 2
    return y


def despike(motion: KeypointMotion, *, size: float, window: float) -> KeypointMotion:
    """Confidence 0 for samples further than `size` from the running median over `window` s."""
    n = max(3, round(window / (motion.t[1] - motion.t[0])) | 1)
    away = np.linalg.norm(motion.positions - median_filter(motion.positions, (n, 1, 1), mode="nearest"), axis=2)
    return KeypointMotion(
        t=motion.t,
        positions=motion.positions,
        names=motion.names,
        confidence=np.where(away > size, 0.0, motion.confidence),
        contact=motion.contact,
        contact_names=motion.contact_names,
    )


def longest_run(good: np.ndarray) -> slice:
    """The longest run of True in `good` (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    starts, ends = edges[::2], edges[1::2]
    if not len(starts):
        return slice(0, 0)
    k = int(np.argmax(ends - starts))
    return slice(int(starts[k]), int(ends[k]))


def cut(motion: KeypointMotion, keep: slice) -> KeypointMotion:
    """The frames in `keep`, times unchanged."""
    return KeypointMotion(
        t=motion.t[keep],
        positions=motion.positions[keep],
        names=motion.names,
        confidence=motion.confidence[keep],
        contact=None if motion.contact is None else motion.contact[keep],
        contact_names=motion.contact_names,
    )
