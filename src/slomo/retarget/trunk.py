"""The trunk of a creature as a moving frame: x forward, y left, z up."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion

Array = np.ndarray
Pairs = tuple[tuple[str, str], ...]
_OFTEN = 0.2  # of the time: a body that is near level so much shows what level is
_POSTURE = 0.35  # rad: up to here a mean tilt is a matter of where key points sit, from twice as much on a posture


@dataclass(frozen=True)
class Trunk:
    """Origin (T, 3) m between the legs' roots and rotation, world from trunk (T of them)."""

    origin: Array
    rotation: Rotation

    @cached_property
    def heading(self) -> Array:
        """(T,) rad, continuous: the twist about the vertical, which a trunk that stands upright still has."""
        q = self.rotation.as_quat()
        return np.unwrap(2 * np.arctan2(q[:, 2], q[:, 3]))

    @cached_property
    def tilt(self) -> Array:
        """(T, 2) rad, roll and pitch (nose down positive): the rotation vector that is left without the heading."""
        return (Rotation.from_euler("z", -self.heading[:, None]) * self.rotation).as_rotvec()[:, :2]

    def leveled(self, *, slope: float) -> tuple["Trunk", Array]:
        """Without the constant tilt that differently placed key points give, down to a ground of `slope` (rad, pitch).

        It is told from the times when the body is within 0.35 rad of level, if there are such. Otherwise the mean tilt
        is a posture the more, the larger it is, and from 0.7 rad on nothing is removed.

        Returns:
            The trunk, and the roll and pitch (2,) rad that were removed.
        """
        tilt = self.tilt - [0.0, slope]
        near = np.linalg.norm(tilt, axis=1) < _POSTURE
        mean = np.median(tilt[near] if near.mean() > _OFTEN else tilt, axis=0)
        bias = mean * np.clip(2 - np.linalg.norm(mean) / _POSTURE, 0, 1)
        # Misplaced key points turn the frame within the body, whichever way the body looks.
        return Trunk(self.origin, self.rotation * Rotation.from_rotvec([*bias, 0.0]).inv()), bias


def seen(motion: KeypointMotion, names: tuple[str, ...]) -> bool:
    """Whether all the key points are there and were seen at least once."""
    return all(n in motion.names and np.any(motion.confidence[:, motion.index(n)] > 0) for n in names)


def middle(motion: KeypointMotion, groups: tuple[tuple[str, ...], ...], what: str) -> Array:
    """(T, 3) mean of the first group that was seen. Raises `InvalidData` naming all of them."""
    for names in groups:
        if seen(motion, names):
            return np.mean([motion[n] for n in names], axis=0)
    raise InvalidData(
        f"no key point marks {what}", where="key points", valid=[n for group in groups for n in group],
        todo="give them under these names",
    )  # fmt: skip


def across(motion: KeypointMotion, pairs: Pairs) -> Array:
    """(T, 3) from right to left, the sum over pairs (left, right) weighted by confidence; 0 where none is seen."""
    out = np.zeros((len(motion.t), 3))
    for pair in pairs:
        if seen(motion, pair):
            left, right = map(motion.index, pair)
            weight = np.minimum(motion.confidence[:, left], motion.confidence[:, right])
            # What was never in doubt counts; a gap that was bridged counts little, but more than nothing.
            out += np.maximum(weight, 0.05)[:, None] * (motion.positions[:, left] - motion.positions[:, right])
    return out


def frame(main: Array, left: Array, *, axis: str) -> Rotation:
    """Rotations with the trunk's x or z `axis` along main (T, 3) and y as near as possible to left (T, 3).

    Where `left` says nothing, y is horizontal.
    """
    a = _unit(main)
    level = np.cross([0.0, 0.0, 1.0], a) if axis == "x" else np.broadcast_to([0.0, 1.0, 0.0], a.shape)
    y = _unit(left)
    y = y - np.sum(y * a, axis=1)[:, None] * a
    y = np.where((np.linalg.norm(y, axis=1) > 1e-6)[:, None], y, level)
    y = _unit(y)
    x, z = (a, np.cross(a, y)) if axis == "x" else (np.cross(y, a), a)
    return Rotation.from_matrix(np.stack([x, y, z], axis=2))


def _unit(x: Array) -> Array:
    length = np.linalg.norm(x, axis=1)
    return x / np.where(length > 0, length, 1.0)[:, None]
