"""The key-point JSON that the authors of SLoMo published (Zhang et al., RA-L 2023).

`{"FrameDuration": s, "Frames": [[18 numbers], ...]}`: root xyz, three angles, four end effectors xyz. Units are not
metric and the conventions differ between files, so what can be told from the data is told from it:

- which axis is up, animal or person, hands or feet first: see `paper_axes`;
- the first angle of an animal is a heading plus a constant: the constant is the one that best agrees with the
  direction from the hind to the front feet;
- left and right of an animal: the left feet lie to the left of that direction. Of a person's pairs the first is left.

The second and third angle behave like a biased roll and pitch. The root of an animal sits at its pelvis.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from slomo.errors import InvalidData
from slomo.formats.paper_axes import read_axes
from slomo.motion import KeypointMotion

Array = np.ndarray

_ANGLE_CONFIDENCE = 0.5  # the trunk points are made from angles whose convention is only inferred
_COLUMNS = 18
_AGREES = 0.7  # mean resultant length of the difference of heading and feet: a spread of about 0.8 rad
_SWAYS, _TOGETHER = 0.02, 0.8  # rad, spread of a roll that is one; correlation of the arms' and the legs' roll
_TURN = 0.5  # s, standard deviation: over a stride, swinging limbs show which way the body looks


def load(path: Path, *, note: Callable[[str], None] = lambda message: None) -> KeypointMotion:
    """Read one file as a `KeypointMotion` (file units, z up, trunk points placed from the angles).

    Raises:
        InvalidData: not such a file, not finite, or its conventions cannot be told from the data.
    """
    frames, dt = _read(path)
    root, angles, ends = frames[:, :3], frames[:, 3:6], frames[:, 6:].reshape(-1, 4, 3)
    reading = read_axes(root, ends, dt, where=path, note=note)
    root, ends = reading.turn(root), reading.turn(ends)
    t = dt * np.arange(len(frames))
    if not reading.person:
        return _animal(path, t, root, angles if reading.axis == 2 else None, ends, note)
    note(f"a person, {'hands' if reading.hands[0] == 0 else 'feet'} first")
    return _person(path, t, root, ends[:, list(reading.hands)], ends[:, list(reading.feet)], note)


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
    path: Path, t: Array, root: Array, angles: Array | None, paws: Array, note: Callable[[str], None]
) -> KeypointMotion:
    along = (paws[:, :2].mean(axis=1) - paws[:, 2:].mean(axis=1))[:, :2]
    length = float(np.median(np.linalg.norm(along, axis=1)))
    if length == 0:
        raise InvalidData("front and hind feet coincide, so the heading cannot be told", where=path)
    direction = np.arctan2(along[:, 1], along[:, 0])
    heading, pitch, roll = _angles(direction, angles, t, note)
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    if np.median(np.einsum("tlc,tc->tl", paws[:, ::2, :2] - paws[:, 1::2, :2], left)) < 0:
        note("the first foot of each pair lies to the right: left and right exchanged")
        paws = paws[:, [1, 0, 3, 2]]
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


def _angles(
    direction: Array, angles: Array | None, t: Array, note: Callable[[str], None]
) -> tuple[Array, Array, Array]:
    """Heading, pitch and roll (T,) rad from the file's angles, as far as the feet bear them out."""
    if angles is not None:
        unit = {s: np.exp(1j * (direction - s * angles[:, 0])) for s in (1.0, -1.0)}
        sign = max(unit, key=lambda s: abs(unit[s].mean()) + 1e-3 * s)
        difference = unit[sign]
        if abs(difference.mean()) > _AGREES:
            offset = float(np.arctan2(np.median(np.imag(difference)), np.median(np.real(difference))))
            start = "" if sign > 0 else "minus "
            degrees = f"{np.degrees(offset):+.0f} degrees"
            note(f"heading is {start}the first angle {degrees}, from the direction hind to front feet")
            # The third angle falls when the front end rises (seen on three published clips); the second is -roll.
            bend = [angles[:, c] - np.median(angles[:, c]) for c in (2, 1)]
            return sign * angles[:, 0] + offset, bend[0], -bend[1]
    note("the angles do not go with the feet: heading from the direction hind to front feet, no roll and pitch")
    smooth = gaussian_filter1d(np.exp(1j * direction), _TURN / (t[1] - t[0]), mode="nearest")
    return np.angle(smooth), np.zeros(len(t)), np.zeros(len(t))


def _person(
    path: Path, t: Array, root: Array, hands: Array, feet: Array, note: Callable[[str], None]
) -> KeypointMotion:
    """The first of each pair counts as the left one, as in the files of animals, unless that walks backwards."""

    def aside(pair: Array) -> Array:
        return gaussian_filter1d((pair[:, 0] - pair[:, 1])[:, :2], _TURN / (t[1] - t[0]), axis=0, mode="nearest")

    same = float(np.mean(np.sum(aside(hands) * aside(feet), axis=1) > 0))
    if 0.4 < same < 0.6:
        raise InvalidData("cannot tell which hand is on which foot's side: they agree half of the time", where=path)
    if same < 0.5:
        note("the first hand is on the side of the second foot: hands exchanged")
        hands = hands[:, ::-1]
    left = aside(feet)
    ahead = np.stack([left[:, 1], -left[:, 0]], axis=1) / np.maximum(np.linalg.norm(left, axis=1), 1e-12)[:, None]
    path_length = np.gradient(root[:, :2], axis=0)
    walked = float(np.sum(path_length * ahead))
    height = float(np.median(root[:, 2] - feet[..., 2].min(axis=1)))
    if walked < -2 * height and walked < -0.7 * float(np.linalg.norm(path_length, axis=1).sum()):
        note("the first of each pair counted as left would walk backwards: left and right exchanged")
        hands, feet = hands[:, ::-1], feet[:, ::-1]
    else:
        note("the first of each pair counts as the left one")
    if np.ptp(root, axis=0).max() < 1e-6 * height:
        hands, feet = _unrolled(root, hands, feet, ahead, note)
    names = ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
    positions = np.concatenate([root[:, None], hands, feet], axis=1)
    return KeypointMotion(t=t, positions=positions, names=names, confidence=np.ones(positions.shape[:2]))


def _unrolled(root: Array, hands: Array, feet: Array, ahead: Array, note: Callable[[str], None]) -> tuple[Array, Array]:
    """Hands and feet (T, 2, 3) turned about the body's forward axis, where a body that never moves hides its roll.

    In the plane of left and up, as complex numbers, a pair is turned by the angle a that makes its left l and right r
    mirror images: exp(i a) l = -conj(exp(i a) r), so 2 a = arg(-conj(l r)). Where arms and legs swing together in it,
    though they know nothing of each other, the whole body does; otherwise it is their own motion, and stays.
    """
    left = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], axis=1)
    ends = np.concatenate([hands, feet], axis=1) - root[:, None]
    plane = np.sum(ends * left[:, None], axis=2) + 1j * ends[..., 2]
    mirrored = np.stack([-np.conj(plane[:, 0] * plane[:, 1]), -np.conj(plane[:, 2] * plane[:, 3])], axis=1)
    arms, legs = (np.unwrap(np.angle(m)) / 2 for m in mirrored.T)
    if min(np.std(arms), np.std(legs)) < _SWAYS or np.corrcoef(arms, legs)[0, 1] < _TOGETHER:
        return hands, feet
    roll = np.unwrap(np.angle(mirrored.sum(axis=1))) / 2
    note(f"the body never moves, but arms and legs roll together: unrolled by {np.degrees(np.ptp(roll)):.0f} degrees")
    turned = plane * np.exp(1j * roll)[:, None]
    ends = ends + (turned - plane).real[..., None] * left[:, None]
    ends[..., 2] = turned.imag
    ends = ends + root[:, None]
    return ends[:, :2], ends[:, 2:]
