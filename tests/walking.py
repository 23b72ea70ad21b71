"""A creature that walks, in closed form: what it does is known exactly."""

import numpy as np

from slomo.motion import KeypointMotion

PHASE = {"hind_left": 0.0, "front_left": 0.25, "hind_right": 0.5, "front_right": 0.75}  # lateral-sequence walk


def walk(*, leg: float = 0.5, speed: float = 0.6, period: float = 0.8, seconds: float = 3.0) -> KeypointMotion:
    """A creature with straight legs of `leg` m that walks along x with duty factor 0.7; its feet stand exactly."""
    t = np.arange(0, seconds, 1 / 30)
    names, points = [], []
    body = np.stack([speed * t, np.zeros_like(t), np.full_like(t, leg)], axis=1)
    for limb, phase in PHASE.items():
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
