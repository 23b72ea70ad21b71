"""Feet that stand still while they stand: ground drift, stance detection, leg odometry, anchoring."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter, minimum_filter1d

from slomo.runs import runs

_HELD = 0.3  # of the legs' length: a foot whose floor is this much higher than the other one's of its pair never stands
_JUMP = 0.16  # s, flight of a jump of three centimetres
_SLOW = 0.35  # of a foot's swing speed
_REARED = 0.5  # the same for a pair whose floor is higher than the other pair's, which a tilted camera also gives


@dataclass(frozen=True)
class Lifts:
    """Feet over the ground.

    Attributes:
        lift: (T, F) m, >= 0.
        ground: (T,) m, the mean ground's height in the input's frame.
        held: (F,) bool, feet that are in the air throughout.
    """

    lift: np.ndarray
    ground: np.ndarray
    held: np.ndarray


def lifts(
    height: np.ndarray,
    known: np.ndarray,
    pairs: tuple[tuple[int, ...], ...],
    *,
    dt: float,
    window: float,
    leg: float,
    most: float = 0.3,
) -> Lifts:
    """Height of each foot over the ground, while the ground itself seems to rise and sink.

    Each foot has a floor of its own (its 15th percentile: key points sit at different heights in different paws),
    unless that is so high over the others' that the foot is held up throughout. With one camera the ground also drifts
    and tilts over the clip: some foot of each pair stands within any `window`, so the lower envelope of a pair is the
    ground there, unless that is higher over the other pair's than drift can be (front feet of a creature that rears).

    Args:
        height: (T, F) m.  known: (F,) bool, feet that were seen.  pairs: columns that stand in turn.
        dt: s.  window: s, longer than any flight phase.
        leg: m, height of the body over the feet.  most: of `leg`, greatest drift of one pair alone.
    """
    floor = np.percentile(height, 15, axis=0)
    held = _held(floor, known, pairs, leg=leg)
    floor = np.where(held, floor[known & ~held].min(), floor)
    over = height - floor
    n = max(1, round(window / dt)) | 1
    stands = {pair: [f for f in pair if known[f] and not held[f]] for pair in pairs}
    low = {p: minimum_filter1d(over[:, on].min(axis=1), n, mode="nearest") for p, on in stands.items() if on}
    # However high, the lowest of all feet is on the ground; a pair is so only as far as that can be drift.
    lowest = np.min(list(low.values()), axis=0)
    ground = np.empty_like(over)
    for pair in pairs:
        more = low.get(pair, lowest) - lowest
        more = gaussian_filter1d(lowest + np.where(more > most * leg, 0.0, more), window / dt / 2, mode="nearest")
        ground[:, list(pair)] = more[:, None]
    over = over - ground
    rest = np.where(held, 0.0, np.percentile(over, 15, axis=0))
    level = float(np.median((floor + rest)[known & ~held]))
    return Lifts(np.maximum(over - rest, 0), ground.mean(axis=1) + level, held)


def _held(floor: np.ndarray, known: np.ndarray, pairs: tuple[tuple[int, ...], ...], *, leg: float) -> np.ndarray:
    """(F,) bool: feet whose floor is too high over that of the other one, or of the other pair."""
    held = np.zeros(len(floor), bool)
    lowest = {pair: min((floor[f] for f in pair if known[f]), default=np.inf) for pair in pairs}
    for pair, low in lowest.items():
        for f in pair:
            held[f] = known[f] and (floor[f] - low > _HELD * leg or low - min(lowest.values()) > _REARED * leg)
    return held


def stance(lift: np.ndarray, speed: np.ndarray, *, dt: float, clearance: float, shortest: float) -> np.ndarray:
    """Which feet stand, without any assumption about the gait.

    A foot stands when it is low and slow. Slow is relative to the same foot's swing, because reconstructed feet slide,
    and to its own slowest quarter, because noise moves a foot that never swings.

    Args:
        lift: (T, F) m over the foot's floor.  speed: (T, F) m/s, horizontal.
        dt: s.  clearance: m, a foot lifted more than this swings.  shortest: s, see `settled`.

    Returns:
        (T, F) bool.
    """
    noise, swing = np.percentile(speed, [25, 95], axis=0)
    slow = speed < np.maximum(np.maximum(_SLOW * swing, np.minimum(3 * noise, 0.6 * swing)), 0.12)
    return settled(slow & (lift < clearance), dt=dt, shortest=shortest)


def slow_motion(standing: np.ndarray, *, dt: float) -> float:
    """How many times as fast a motion must be played for its flights to last as long as jumps; 1 if they do.

    Without the body's height nothing shows that feet which all leave the ground at once, as in a jumping jack, are in
    a jump; but if they are, it is one of a few centimetres.

    Args:
        standing: (T, F) bool.
    """
    flights = [b - a for a, b in runs(np.logical_not(standing.any(axis=1))) if a > 0 and b < len(standing)]
    usual = dt * float(np.median(flights)) if len(flights) > 1 else 0.0
    return usual / _JUMP if usual > 2 * _JUMP else 1.0


def slowness(xy: np.ndarray, *, dt: float) -> np.ndarray:
    """(T, F) in (0, 1]: how slow each foot of xy (T, F, 2) m is for its own swing."""
    speed = np.linalg.norm(np.gradient(xy, dt, axis=0), axis=2)
    return np.exp(-((speed / np.maximum(_SLOW * np.percentile(speed, 95, axis=0), 1e-12)) ** 2))


def settled(standing: np.ndarray, *, dt: float, shortest: float) -> np.ndarray:
    """(T, F) bool without stances and swings shorter than `shortest` (s)."""
    n = 2 * round(shortest / dt) | 1
    return median_filter(standing.astype(np.uint8), (n, 1), mode="nearest").astype(bool)


def slide(xy: np.ndarray, weight: np.ndarray, *, dt: float, smoothing: float) -> np.ndarray:
    """Path (T, 2) by which everything slides over the ground, judged by the feet that stand.

    Depth from one camera drifts, so a whole reconstruction slides. Standing feet do not: their common velocity (the
    weighted geometric median over feet, so that one swinging foot is outvoted) is the slide. Subtract the result from
    every key point.

    Args:
        xy: (T, F, 2) m.  weight: (T, F) >= 0, how surely each foot stands.  dt: s.
        smoothing: s, standard deviation of a Gaussian.
    """
    velocity = np.gradient(xy, dt, axis=0)
    total = weight.sum(axis=1)
    # A ground that does not slide has half a vote.
    velocity = np.concatenate([velocity, np.zeros((len(xy), 1, 2))], axis=1)
    w = np.concatenate([weight / np.maximum(total, 1e-12)[:, None], np.full((len(xy), 1), 0.5)], axis=1)
    w /= w.sum(axis=1)[:, None]
    common = np.sum(w[..., None] * velocity, axis=1)
    for _ in range(20):  # Weiszfeld's iteration
        far = np.maximum(np.linalg.norm(velocity - common[:, None], axis=2), 1e-3)
        common = np.sum((w / far)[..., None] * velocity, axis=1) / np.sum(w / far, axis=1)[:, None]
    known = np.flatnonzero(total > 0.2)
    if not len(known):
        return np.zeros((len(xy), 2))
    frames = np.arange(len(xy))
    common = np.stack([np.interp(frames, known, common[known, c]) for c in range(2)], axis=1)
    common = gaussian_filter1d(common, smoothing / dt, axis=0, mode="nearest")
    return np.concatenate([np.zeros((1, 2)), np.cumsum((common[1:] + common[:-1]) / 2 * dt, axis=0)])


def split(xy: np.ndarray, standing: np.ndarray, *, dt: float, tolerance: float, step: float) -> np.ndarray:
    """Take creeping out of stances: a standing foot stays within `tolerance` (m) of its stance's median place.

    Creeping at either end of a stance belongs to the swing beside it. What still creeps is two stances with a step of
    `step` (s) between, at the moment of fastest creep: there the creature shuffled.

    Args:
        xy: (T, 2) m, path of one foot.  standing: (T,) bool.

    Returns:
        (T,) bool.
    """
    out = standing.copy()
    half = max(1, round(step / dt / 2))
    speed = np.linalg.norm(np.gradient(gaussian_filter1d(xy, half, axis=0, mode="nearest"), dt, axis=0), axis=1)
    todo = runs(standing)
    while todo:
        start, end = todo.pop()
        away = np.linalg.norm(xy[start:end] - np.median(xy[start:end], axis=0), axis=1) > tolerance
        if not away.any():
            continue
        near = np.flatnonzero(~away)
        first, last = (start + int(near[0]), start + int(near[-1]) + 1) if len(near) else (start, end)
        if (first, last) != (start, end) and 2 * (last - first) > end - start:
            out[start:first] = out[last:end] = False
            todo.append((first, last))
        elif end - start >= 6 * half:
            middle = start + 2 * half + int(np.argmax(speed[start + 2 * half : end - 2 * half]))
            out[middle - half : middle + half] = False
            todo += [(start, middle - half), (middle + half, end)]
    return out


def anchor(x: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """One place for each stance; what that moves is blended over the swings before and after.

    Args:
        x: (T, D), path of one foot (m) or where it points (rad, continuous).  standing: (T,) bool.

    Returns:
        (T, D), constant over each stance.
    """
    shift, known = np.zeros_like(x), np.zeros(len(x), bool)
    for start, end in runs(standing):
        shift[start:end] = np.median(x[start:end], axis=0) - x[start:end]
        known[start:end] = True
    if not known.any():
        return x.copy()
    frames = np.arange(len(x))
    return x + np.stack([np.interp(frames, frames[known], column[known]) for column in shift.T], axis=1)


def clear(lift: np.ndarray, standing: np.ndarray, *, least: float) -> np.ndarray:
    """Lift (T,) of one foot with 0 in stance and at least a half sine of `least` (m) in swings between stances."""
    out = np.where(standing, 0.0, lift)
    for start, end in runs(~standing):
        if start > 0 and end < len(lift):
            arc = np.sin(np.pi * (np.arange(start, end) - start + 1) / (end - start + 1))
            out[start:end] = np.maximum(out[start:end] * np.sqrt(arc), least * arc)
    return out
