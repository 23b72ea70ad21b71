"""The key-point JSON that the authors of SLoMo published (Zhang et al., RA-L 2023).

`{"FrameDuration": s, "Frames": [[18 numbers], ...]}`: root xyz, three angles, four end effectors xyz. Units are not
metric and the conventions differ between files, so what can be told from the data is told from it:

- z up or down: the end effectors hang below the root;
- animal or person: four end effectors near the ground, or two;
- the first angle is a heading plus a constant: the constant is the one that best agrees with the direction from the
  hind to the front feet;
- left and right: the left feet lie to the left of that direction.

The second and third angle behave like a biased roll and pitch. The root of an animal sits at its pelvis.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion

_ANGLE_CONFIDENCE = 0.5  # the trunk points are made from angles whose convention is only inferred
_COLUMNS = 18
# Median height over the lowest end effector, as a fraction of the root's: feet are below, hands above.
_FOOT, _HAND = 0.4, 0.55


def load(path: Path, *, note: Callable[[str], None] = lambda message: None) -> KeypointMotion:
    """Read one file as a `KeypointMotion` (file units, z up, trunk points placed from the angles).

    Raises:
        InvalidData: not such a file, not finite, or its conventions cannot be told from the data.
    """
    frames, dt = _read(path)
    root, angles, ends = frames[:, :3].copy(), frames[:, 3:6], frames[:, 6:].reshape(-1, 4, 3).copy()
    below = np.median(root[:, 2]) - np.median(ends[..., 2].min(axis=1))
    if below < 0:
        note("z points down in this file: turned by 180 degrees about x")
        root[:, 1:] *= -1
        ends[..., 1:] *= -1
        below = np.median(root[:, 2]) - np.median(ends[..., 2].min(axis=1))
    if below == 0:
        raise InvalidData("end effectors are level with the root, so up and down cannot be told", where=path)
    t = dt * np.arange(len(frames))
    # Height of each end effector over the lowest one, as a fraction of the root's.
    level = (np.median(ends[..., 2], axis=0) - np.median(ends[..., 2], axis=0).min()) / below
    if np.all(level < _FOOT):
        return _animal(path, t, root, angles, ends, note)
    if np.all(level[:2] > _HAND) and np.all(level[2:] < _FOOT):
        hands, feet = ends[:, :2], ends[:, 2:]
    elif np.all(level[2:] > _HAND) and np.all(level[:2] < _FOOT):
        hands, feet = ends[:, 2:], ends[:, :2]
    else:
        raise InvalidData(
            f"cannot tell animal from person: end effectors at {np.round(level, 2).tolist()} of the root's height",
            where=path,
        )
    note(f"a person, {'hands' if level[0] > _HAND else 'feet'} first")
    names = ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
    positions = np.concatenate([root[:, None], hands, feet], axis=1)
    return KeypointMotion(t=t, positions=positions, names=names, confidence=np.ones(positions.shape[:2]))


def _read(path: Path) -> tuple[np.ndarray, float]:
    try:
        data = json.loads(Path(path).read_text())
        frames, dt = np.array(data["Frames"], float), float(data["FrameDuration"])
    except OSError as e:
        raise InvalidData(e.strerror or "cannot be read", where=path) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as e:
        raise InvalidData(f"is neither .npz nor JSON ({e})", where=path, todo="give a key-point file") from None
    except (KeyError, TypeError, ValueError):
        raise InvalidData(
            "is not a key-point JSON: needs FrameDuration (s) and Frames (T, 18) of numbers", where=path
        ) from None
    if frames.ndim != 2 or frames.shape[1] != _COLUMNS or len(frames) < 8:
        raise InvalidData(f"Frames has shape {frames.shape}, expected (8 or more, {_COLUMNS})", where=path)
    bad = np.argwhere(~np.isfinite(frames))
    if len(bad):
        raise InvalidData(f"not a finite number in frame {bad[0, 0]}, column {bad[0, 1]}", where=path)
    if not (np.isfinite(dt) and dt > 0):
        raise InvalidData(f"FrameDuration is {dt}, expected seconds > 0", where=path)
    return frames, dt


def _animal(
    path: Path,
    t: np.ndarray,
    root: np.ndarray,
    angles: np.ndarray,
    paws: np.ndarray,
    note: Callable[[str], None],
) -> KeypointMotion:
    along = (paws[:, :2].mean(axis=1) - paws[:, 2:].mean(axis=1))[:, :2]
    length = float(np.median(np.linalg.norm(along, axis=1)))
    if length == 0:
        raise InvalidData("front and hind feet coincide, so the heading cannot be told", where=path)
    difference = np.arctan2(along[:, 1], along[:, 0]) - angles[:, 0]
    offset = np.angle(np.median(np.cos(difference)) + 1j * np.median(np.sin(difference)))
    heading = angles[:, 0] + offset
    note(f"heading is the first angle {np.degrees(offset):+.0f} degrees, from the direction hind to front feet")
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    if np.median(np.einsum("tlc,tc->tl", paws[:, ::2, :2] - paws[:, 1::2, :2], left)) < 0:
        note("the first foot of each pair lies to the right: left and right exchanged")
        paws = paws[:, [1, 0, 3, 2]]
    # The third angle falls when the front end rises (seen on three published clips); the second is -roll.
    pitch = angles[:, 2] - np.median(angles[:, 2])
    roll = -(angles[:, 1] - np.median(angles[:, 1]))
    forward = np.stack([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), -np.sin(pitch)], axis=1)
    level = np.concatenate([left, np.zeros((len(t), 1))], axis=1)
    side = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * np.cross(forward, level)
    width = 0.25 * length * side
    positions = np.concatenate(
        [np.stack([root, root + length * forward, root + width, root - width], axis=1), paws], axis=1
    )
    names = ("pelvis", "withers", "hind_left_hip", "hind_right_hip")
    names += tuple(f"{end}_{s}_paw" for end in ("front", "hind") for s in ("left", "right"))
    confidence = np.ones(positions.shape[:2])
    confidence[:, 1:4] = _ANGLE_CONFIDENCE
    return KeypointMotion(t=t, positions=positions, names=names, confidence=confidence)
