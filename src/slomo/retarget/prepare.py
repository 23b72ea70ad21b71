"""From key points as they come to smooth ones on a uniform grid: which part is used, what is a gap or a spike."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import clean
from slomo.retarget.trunk import Pairs, Trunk, seen
from slomo.runs import runs
from slomo.stage import Progress

if TYPE_CHECKING:
    from slomo.retarget.stage import Config

_MARGIN = 0.15  # s, left out beside an impossible turn
_TURN = 0.04  # s, standard deviation of the smoothing of the heading in which turns are looked for
_BRIDGE = 0.02  # weight of a straight bridge over a gap: without, noise at a gap's ends would be extrapolated
_NOISE = 0.02  # of the body's size
_LONG_GAP = 0.3  # s, bridging more than this is worth a word


def prepare(
    source: KeypointMotion,
    trunk_of: Callable[[KeypointMotion], Trunk],
    pairs: Pairs,
    config: "Config",
    report: dict[str, Any],
    progress: Progress,
) -> KeypointMotion:
    """The wanted and usable part on a uniform grid; samples that cannot be believed have confidence 0.

    Args:
        trunk_of: tells how the body looks, to find turns that are not real.
        pairs: (left, right) key points of the trunk that stand in for each other.

    Raises:
        UsageError: start and end leave nothing. InvalidData: too few frames, or no usable part of half a second.
    """
    wanted = _wanted(source, config)
    rate = (len(wanted.t) - 1) / float(wanted.t[-1] - wanted.t[0])
    report["source_hz"] = rate
    filled = clean.bridge(wanted)
    size = float(np.median(np.ptp(filled.positions, axis=1).max(axis=1)))
    marked = clean.despike(wanted, size=0.25 * size, window=0.5)
    report["untrusted_samples"] = int((marked.confidence == 0).sum())
    _say_gaps(marked, report, progress)
    motion = clean.resample(clean.thin(clean.bridge(marked), config.rate), config.rate)
    motion = _complete(motion, pairs, progress)
    return _believable(motion, trunk_of, config, report, progress)


def _wanted(source: KeypointMotion, config: "Config") -> KeypointMotion:
    end = config.end or source.t[-1]
    if not config.start < end or config.start >= source.t[-1] or end <= source.t[0]:
        raise UsageError(
            f"start {config.start} s and end {end} s leave nothing of {source.t[0]:.2f} to {source.t[-1]:.2f} s",
            where="retarget",
        )
    wanted = (source.t >= config.start) & (source.t <= end)
    if wanted.sum() < 8:
        raise InvalidData(f"only {wanted.sum()} frames between {config.start} and {end} s", where="key points")
    return clean.cut(source, clean.longest_run(wanted))


def _say_gaps(motion: KeypointMotion, report: dict[str, Any], progress: Progress) -> None:
    """Which key points were missing for how long at a time."""
    step = float(np.median(np.diff(motion.t)))
    gaps = {}
    for name, c in zip(motion.names, motion.confidence.T, strict=True):
        if np.any(c > 0):
            gaps[name] = step * max((end - start for start, end in runs(c == 0)), default=0)
    report["longest_gap_s"] = {n: round(g, 3) for n, g in gaps.items() if g > 0}
    worst = max(gaps, key=lambda n: gaps[n], default=None)
    if worst and gaps[worst] > _LONG_GAP:
        progress.note(f"gaps are bridged, the longest of {gaps[worst]:.2f} s in {worst}")
    never = [n for n, c in zip(motion.names, motion.confidence.T, strict=True) if not np.any(c > 0)]
    report["never_seen"] = never


def _complete(motion: KeypointMotion, pairs: Pairs, progress: Progress) -> KeypointMotion:
    """Place the unseen one of a pair beside the other as another pair lies."""
    whole = [p for p in pairs if seen(motion, p)]
    positions, confidence = motion.positions.copy(), motion.confidence.copy()
    for left, right in pairs:
        if not whole or left not in motion.names or right not in motion.names:
            continue
        a, b = motion.index(left), motion.index(right)
        i, j = motion.index(whole[0][0]), motion.index(whole[0][1])
        for missing, other, aside in (
            (a, b, positions[:, i] - positions[:, j]),
            (b, a, positions[:, j] - positions[:, i]),
        ):
            if seen(motion, (motion.names[other],)) and not seen(motion, (motion.names[missing],)):
                positions[:, missing] = positions[:, other] + aside
                confidence[:, missing] = 0.5 * confidence[:, other]
                progress.note(f"{motion.names[missing]} was never seen: placed beside {motion.names[other]}")
    return replace(motion, positions=positions, confidence=confidence)


def _believable(
    motion: KeypointMotion,
    trunk_of: Callable[[KeypointMotion], Trunk],
    config: "Config",
    report: dict[str, Any],
    progress: Progress,
) -> KeypointMotion:
    """The longest part in which the body does not turn faster than bodies do."""
    heading = gaussian_filter1d(trunk_of(motion).heading, _TURN * config.rate, mode="nearest")
    turning = np.abs(np.gradient(heading, 1 / config.rate))
    # What surrounds such a turn is bad too.
    n = round(_MARGIN * config.rate)
    keep = clean.longest_run(np.logical_not(binary_dilation(turning > config.max_turn_rate, iterations=n)))
    if keep.stop - keep.start < 0.5 * config.rate:
        raise InvalidData(
            f"no half second without turns faster than {config.max_turn_rate} rad/s", where="key points",
            todo="choose a part with --set retarget.start=... and retarget.end=...",
        )  # fmt: skip
    kept = clean.cut(motion, keep)
    report["used_s"] = [float(kept.t[0]), float(kept.t[-1])]
    if keep.stop - keep.start < len(motion.t):
        progress.note(
            f"turns faster than {config.max_turn_rate} rad/s are not real: using {kept.t[0]:.2f} to {kept.t[-1]:.2f} s"
        )
    return kept


def smoothed(motion: KeypointMotion, quick: set[str], config: "Config") -> KeypointMotion:
    """Every key point smoothed, those in `quick` (limbs) less."""
    size = float(np.median(np.ptp(motion.positions, axis=1).max(axis=1)))
    positions = np.stack(
        [
            clean.smooth(
                motion.positions[:, i], np.maximum(motion.confidence[:, i], _BRIDGE), dt=1 / config.rate,
                cutoff=config.foot_cutoff if n in quick else config.body_cutoff, least=_NOISE * size,
            )
            for i, n in enumerate(motion.names)
        ],
        axis=1,
    )  # fmt: skip
    return replace(motion, positions=positions)
