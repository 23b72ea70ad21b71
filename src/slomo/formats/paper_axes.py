"""Which way is up in five points, and which of them are hands: told from the data, or refused.

A reading is an up axis with a kind: an animal has its four ends at one level below its root; a person has two of them,
the feet, below, and the hands above, or hanging beside the hips. Where a person could also stand on their hands, the
feet are the pair that keeps to the ground: one of them is always low and still.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray
# Median height over the lowest end, as a fraction of the root's: feet are below, hands above.
FOOT, HAND = 0.4, 0.55
_TALL = 0.25  # least height of the root over the ends, of the body's greatest extent
_STEADY = 0.3  # of the root's height: the lower foot of a reading on an unusual axis keeps to its ground within this
_DECIDED = 3.0  # a reading counts as told when its feet keep to the ground this many times better than another's
_AXES = tuple((axis, sign) for axis in (2, 1, 0) for sign in (1.0, -1.0))


@dataclass(frozen=True)
class Reading:
    """One way to read the five points.

    Attributes:
        axis, sign: up is `sign` times the coordinate `axis`.
        person: or an animal.  hands: columns of the hands, () for an animal.
        spread: of the lower foot's height, over the root's.
        restless: by how much the feet fail to stand: `spread` times the speed of the slower one, in root heights per s.
    """

    axis: int
    sign: float
    person: bool
    hands: tuple[int, ...]
    spread: float
    restless: float

    @property
    def feet(self) -> tuple[int, ...]:
        return tuple(c for c in range(4) if c not in self.hands)

    @property
    def up(self) -> str:
        return f"{'xyz'[self.axis]} {'up' if self.sign > 0 else 'down'}"

    def turn(self, x: Array) -> Array:
        """(..., 3) turned so that z is up."""
        if self.axis == 2:
            return x if self.sign > 0 else x * [1.0, -1.0, -1.0]
        order, flip = ([0, 2, 1], 1) if self.axis == 1 else ([2, 1, 0], 0)
        out = x[..., order] * 1.0
        out[..., 2] *= self.sign
        out[..., flip] *= -self.sign  # keeps it a rotation
        return out


def read_axes(root: Array, ends: Array, dt: float, *, where: Path, note: Callable[[str], None]) -> Reading:
    """The reading of root (T, 3) and ends (T, 4, 3), columns in pairs.

    Raises:
        InvalidData: none, or more than one, makes sense; says what was seen.
    """
    readings = [r for a in _AXES if (r := _reading(root, ends, dt, *a)) is not None]
    readings = [r for r in readings if r.axis == 2 or r.spread < _STEADY]
    upright = [r for r in readings if r.axis == 2]
    # Z is up or down in every file that is known; another axis counts where z makes no sense, or only a person who
    # seems to sit on the ends that an animal on another axis would stand on.
    if not upright or (all(r.person for r in upright) and any(not r.person for r in readings)):
        upright = [r for r in readings if not r.person] or readings
    if not upright:
        heights = np.median(ends[..., 2] - root[:, None, 2], axis=0)
        raise InvalidData(
            f"cannot tell animal from person: ends at {np.round(heights, 2).tolist()} over the root, and other axes "
            "make no more sense", where=where,
        )  # fmt: skip
    best, *others = sorted(upright, key=lambda r: r.restless)
    if others and others[0].restless < _DECIDED * max(best.restless, 1e-9):
        raise InvalidData(
            f"cannot tell up from down: with {best.up} and with {others[0].up} two ends stand about as still",
            where=where,
        )
    if (best.axis, best.sign) != (2, 1.0):
        turned = "by 180 degrees about x" if best.axis == 2 else "so that z is up"
        note(f"{best.up.replace('down', 'points down').replace('up', 'points up')} in this file: turned {turned}")
    return best


def _reading(root: Array, ends: Array, dt: float, axis: int, sign: float) -> Reading | None:
    """What the points are if this is up, or None."""
    over = sign * (ends[..., axis] - root[:, None, axis])
    height = np.median(over, axis=0)
    below = -float(np.median(over.min(axis=1)))
    points = np.concatenate([root[:, None], ends], axis=1)
    size = float(np.median(np.linalg.norm(points[:, :, None] - points[:, None], axis=3).max(axis=(1, 2))))
    if below < _TALL * size or below <= 0:
        return None
    level = (height - height.min()) / below
    if np.all(height < 0) and np.all(level < FOOT):
        return Reading(axis, sign, False, (), *_unsteady(ends, dt, axis, sign, below))
    for hands, feet in (((0, 1), (2, 3)), ((2, 3), (0, 1))):
        if np.all(level[list(feet)] < FOOT) and np.all(level[list(hands)] > HAND):
            return Reading(axis, sign, True, hands, *_unsteady(ends[:, list(feet)], dt, axis, sign, below))
    return None


def _unsteady(feet: Array, dt: float, axis: int, sign: float, height: float) -> tuple[float, float]:
    """`spread` and `restless` of feet (T, n, 3)."""
    spread = float(np.ptp(np.percentile((sign * feet[..., axis]).min(axis=1), [10, 90]))) / height
    speed = float(np.median(np.linalg.norm(np.diff(feet, axis=0), axis=2).min(axis=1))) / dt / height
    return spread, (spread + 1e-3) * (speed + 1e-3)
