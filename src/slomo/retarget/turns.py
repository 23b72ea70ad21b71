"""Feet that leave the ground one after the other, where a motion has both in the air for longer than a jump lasts."""

import numpy as np

from slomo.retarget.clean import runs

Array = np.ndarray

JUMP = 0.2  # s, longest flight that is taken for one
_EARLIER = 0.15  # s by which the first foot may leave earlier, and the second one land later, while both stand


def in_turn(standing: Array, *, dt: float) -> tuple[Array, Array]:
    """When each of two feet is where it was at which time, so that one stands while the other one swings.

    A body that never moves in the data shows no flight: feet that part and meet at once did so in a jump (or slid),
    perhaps in slow motion, in which no jump is possible. The time of both swings is shared: the foot that left the
    ground first goes through its swing in the first half, the other one in the second.

    Args:
        standing: (T, 2) bool.

    Returns:
        (T, 2) frame (not whole) of the data at which each foot is, and standing (T, 2) bool.
    """
    T = len(standing)
    frame, on = np.tile(np.arange(T, dtype=float)[:, None], (1, 2)), standing.copy()
    swings = [runs(~foot) for foot in standing.T]
    for a, b in runs(~standing.any(axis=1)):
        if (b - a) * dt <= JUMP:
            continue
        spans = [next((r for r in foot if r[0] <= a and b <= r[1]), (a, b)) for foot in swings]
        first = 0 if spans[0] <= spans[1] else 1
        start, end = min(s[0] for s in spans), max(s[1] for s in spans)
        if start == 0 or end == T:
            continue  # it begins or ends in the air
        for _ in range(round(_EARLIER / dt)):
            start -= start > 1 and on[start - 2].all()
            end += end < T - 1 and on[end + 1].all()
        middle = (start + end) // 2
        for foot, (begin, until) in ((first, (start, middle)), (1 - first, (middle, end))):
            left, landed = spans[foot]
            frame[start:begin, foot], frame[until:end, foot] = left - 1, landed
            frame[begin:until, foot] = np.linspace(left - 1, landed, until - begin, endpoint=False)
            on[start:end, foot] = True
            on[begin:until, foot] = False
    return frame, on


def at(x: Array, frame: Array) -> Array:
    """x (T, 2, ...) of each foot at its own frames (T, 2), linear between whole ones."""
    k = np.clip(np.floor(frame).astype(int), 0, len(x) - 2)
    s = (frame - k).reshape(*frame.shape, *(1,) * (x.ndim - 2))
    foot = np.arange(2)
    return (1 - s) * x[k, foot] + s * x[k + 1, foot]
