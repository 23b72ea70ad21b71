"""A creature that walks, in closed form: what it does is known exactly."""

import numpy as np

from slomo.motion import KeypointMotion

PHASE = {"hind_left": 0.0, "front_left": 0.25, "hind_right": 0.5, "front_right": 0.75}  # lateral-sequence walk


TROT = {"hind_left": 0.0, "front_left": 0.5, "hind_right": 0.5, "front_right": 0.0}


def walk(
    *, leg: float = 0.5, speed: float = 0.6, period: float = 0.8, seconds: float = 3.0, trot: bool = False
) -> KeypointMotion:
    """A creature with straight legs of `leg` m that walks along x with duty factor 0.7; its feet stand exactly.

    A speed of 0 leaves it treading on the spot. With `trot`, diagonal feet land together.
    """
    t = np.arange(0, seconds, 1 / 30)
    names, points = [], []
    body = np.stack([speed * t, np.zeros_like(t), np.full_like(t, leg)], axis=1)
    for limb, phase in (TROT if trot else PHASE).items():
        hip = body + [0.4 if "front" in limb else -0.4, 0.12 if "left" in limb else -0.12, 0.0]
        cycle = t / period - phase
        k, s = np.floor(cycle), cycle % 1
        swing = np.clip((s - 0.7) / 0.3, 0, 1)
        stride = speed * period
        x = hip[:, 0] - speed * t + stride * (k + phase + 0.35 + swing * swing * (3 - 2 * swing))
        z = 0.15 * leg * np.sin(np.pi * swing) ** 2
        names += [f"{limb}_{'shoulder' if 'front' in limb else 'hip'}", f"{limb}_paw"]
        points += [hip, np.stack([x, hip[:, 1], z], axis=1)]
    positions = np.stack(points, axis=1)
    return KeypointMotion(t=t, positions=positions, names=tuple(names), confidence=np.ones(positions.shape[:2]))


def _feet(t: np.ndarray, *, speed: float, period: float, duty: float, lift: float, phase: float) -> np.ndarray:
    """(T, 2) m: x and height of a foot that stands exactly, under a body at x = speed t."""
    cycle = t / period - phase
    k, s = np.floor(cycle), cycle % 1
    swing = np.clip((s - duty) / (1 - duty), 0, 1)
    x = speed * period * (k + phase + duty / 2 + swing * swing * (3 - 2 * swing))
    return np.stack([x, lift * np.sin(np.pi * swing) ** 2], axis=1)


def _bend(a: np.ndarray, c: np.ndarray, bones: tuple[float, float], towards: np.ndarray) -> np.ndarray:
    """(T, 3) the joint between a and c (T, 3) m, bent towards a direction (3,)."""
    d = c - a
    n = np.minimum(np.linalg.norm(d, axis=1), 0.999 * sum(bones))[:, None]
    x = d / np.linalg.norm(d, axis=1)[:, None]
    along = (bones[0] ** 2 - bones[1] ** 2 + n**2) / (2 * n)
    side = towards - np.sum(towards * x, axis=1)[:, None] * x
    side /= np.linalg.norm(side, axis=1)[:, None]
    return a + along * x + np.sqrt(np.maximum(bones[0] ** 2 - along**2, 0)) * side


def person(
    *,
    height: float = 1.75,
    speed: float = 1.0,
    period: float = 1.1,
    seconds: float = 3.0,
    bend: float | np.ndarray = 0.0,
    jump: float = 0.0,
    spread: float = 0.0,
) -> KeypointMotion:
    """A person of `height` m who walks along x with duty factor 0.62, or stays where they are with speed 0.

    Args:
        bend: rad, how far the trunk leans forward, one number or one for each of the 30 frames a second.
        jump: m, height of jumps in place, one every `period` s, in the air for sqrt(8 jump / g) s.
        spread: rad, how far the legs open in jumping jacks, with the arms, once every `period` s.
    """
    t = np.arange(0, seconds, 1 / 30)
    h, zero = height, np.zeros_like(t)
    air = np.sqrt(8 * jump / 9.81)
    since = t % period
    hop = np.where(since < air, 9.81 / 2 * since * (air - since), 0.0)
    # Jumping jacks: 0.3 s in the air to open, and half a period later to close; the arms take their time.
    opening, arms = (np.clip(since / s, 0, 1) - np.clip((since - period / 2) / s, 0, 1) for s in (0.3, 0.45 * period))
    arms = arms**2 * (3 - 2 * arms) * (spread > 0)
    opening = spread * opening**2 * (3 - 2 * opening)
    if spread:
        half = since % (period / 2)
        hop = np.where(half < 0.3, 9.81 / 2 * half * (0.3 - half), 0.0)
    leg = 0.470 * h  # hip to ankle; the knees stay a little bent
    pelvis = np.stack([speed * t, zero, 0.045 * h + 0.97 * leg * np.cos(opening / 2) + hop], axis=1)
    bend = bend + zero
    forward = np.stack([np.cos(bend), zero, -np.sin(bend)], axis=1)
    up = np.stack([np.sin(bend), zero, np.cos(bend)], axis=1)
    out = {"pelvis": pelvis}
    for name, z, x in (("spine_mid", 0.105, 0), ("chest", 0.24, 0), ("neck", 0.345, 0), ("head", 0.405, 0.01),
                       ("head_top", 0.49, 0.01), ("nose", 0.415, 0.075)):  # fmt: skip
        out[name] = pelvis + h * (z * up + x * forward)
    for side, y, phase in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        hip = pelvis + [0, 0.055 * h * y, 0]
        foot = _feet(t, speed=speed, period=period, duty=0.62, lift=0.08 * h * (speed > 0), phase=phase)
        ankle = np.stack(
            [foot[:, 0], 0.055 * h * y + y * leg * np.sin(opening / 2), foot[:, 1] + 0.045 * h + hop], axis=1
        )
        out[f"{side}_hip"], out[f"{side}_ankle"] = hip, ankle
        out[f"{side}_knee"] = _bend(hip, ankle, (leg / 2, leg / 2), np.array([[1.0, 0, 0]]))
        out[f"{side}_toe"] = ankle + [0.085 * h, 0, -0.027 * h]
        shoulder = pelvis + h * 0.305 * up + [0, 0.095 * h * y, 0]
        swing = 0.4 * (speed > 0) * np.sin(2 * np.pi * (t / period - phase))
        out_of = 0.8 * np.pi * arms
        hand = np.stack([np.sin(swing) * np.cos(out_of), y * np.sin(out_of), -np.cos(swing) * np.cos(out_of)], axis=1)
        out[f"{side}_shoulder"], out[f"{side}_wrist"] = shoulder, shoulder + 0.30 * h * hand
        out[f"{side}_elbow"] = _bend(shoulder, out[f"{side}_wrist"], (0.165 * h, 0.15 * h), np.array([[-1.0, 0, 0]]))
    positions = np.stack(list(out.values()), axis=1)
    return KeypointMotion(t=t, positions=positions, names=tuple(out), confidence=np.ones(positions.shape[:2]))
