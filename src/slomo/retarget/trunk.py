"""The trunk of a four-legged creature as a moving frame."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion

# What marks either end of the trunk, the best first.
_FRONT = (("front_left_shoulder", "front_right_shoulder"), ("withers",), ("chest",), ("neck",))
_HIND = (("hind_left_hip", "hind_right_hip"), ("pelvis",), ("tail_base",))
_PAIRS = (("front_left_shoulder", "front_right_shoulder"), ("hind_left_hip", "hind_right_hip"))


@dataclass(frozen=True)
class Trunk:
    """Origin (T, 3) between the limbs' roots; yaw, pitch (nose down positive) and roll (T,) rad, intrinsic z-y-x."""

    origin: np.ndarray
    yaw: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray

    def rotation(self) -> Rotation:
        """World from trunk: x forward, y left, z up."""
        return Rotation.from_euler("ZYX", np.stack([self.yaw, self.pitch, self.roll], axis=1))


def trunk_frame(motion: KeypointMotion) -> Trunk:
    """The trunk's frame from hips and shoulders, or from the spine where those are missing.

    Raises:
        InvalidData: no pair of key points spans the trunk; the message names what would do.
    """
    front, hind = _end(motion, _FRONT), _end(motion, _HIND)
    x = front - hind
    length = np.linalg.norm(x, axis=1)
    if np.any(length < 1e-9):
        raise InvalidData(f"front and hind end of the trunk coincide in frame {int(np.argmin(length))}")
    x = x / length[:, None]
    across = np.zeros_like(x)
    for left, right in _PAIRS:
        if left in motion.names and right in motion.names:
            weight = np.minimum(motion.confidence[:, motion.index(left)], motion.confidence[:, motion.index(right)])
            across += weight[:, None] * (motion[left] - motion[right])
    horizontal = np.cross([0.0, 0.0, 1.0], x)
    norm = np.linalg.norm(across, axis=1)
    across = np.where((norm > 0)[:, None], across / np.maximum(norm, 1e-12)[:, None], horizontal)
    y = across - np.sum(across * x, axis=1)[:, None] * x
    y = np.where((np.linalg.norm(y, axis=1) > 1e-6)[:, None], y, horizontal)
    y /= np.linalg.norm(y, axis=1)[:, None]
    frame = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=2))
    yaw, pitch, roll = np.unwrap(frame.as_euler("ZYX"), axis=0).T
    return Trunk(origin=(front + hind) / 2, yaw=yaw, pitch=pitch, roll=roll)


def _end(motion: KeypointMotion, groups: tuple[tuple[str, ...], ...]) -> np.ndarray:
    for names in groups:
        if all(n in motion.names and np.any(motion.confidence[:, motion.index(n)] > 0) for n in names):
            return np.mean([motion[n] for n in names], axis=0)
    raise InvalidData(
        "no key point marks the front and the hind end of the trunk",
        where="key points",
        valid=[n for group in groups for n in group],
        todo="give hips and shoulders, or pelvis and withers, under these names",
    )
