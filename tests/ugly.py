"""Ugly input, drawn at random: what reconstructions and other people's files do to a motion, and what was done."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from slomo.formats import load_keypoints
from slomo.motion import KeypointMotion
from walking import person, walk

Array = np.ndarray
PUBLISHED = Path(__file__).resolve().parents[2] / "shared" / "keypoints"


@dataclass(frozen=True)
class Ugly:
    """One input.

    Attributes:
        motion: what `slomo retarget` is given.
        friction: of the ground, 0.3 to 1.0.
        options: `retarget.*` to set (a terrain step, at times).
        done: what was done, for the report of a failure.
    """

    motion: KeypointMotion
    friction: float
    options: dict[str, Any]
    done: dict[str, Any] = field(default_factory=dict)


def quadruped(seed: int) -> Ugly:
    """An animal that walks, trots, stands, sits or rears, or a published one where those files are; then spoiled."""
    rng = np.random.default_rng([seed, 4])
    kind = str(rng.choice(["walk", "trot", "stand", "sit", "rear", "paper"], p=[0.3, 0.2, 0.15, 0.05, 0.05, 0.25]))
    motion = _published(("cat00", "dog_cpr"), rng) if kind == "paper" else None
    if motion is None:
        speed = {"walk": rng.uniform(0.2, 0.9), "trot": rng.uniform(0.5, 1.3)}.get(kind, 0.0)
        leg = rng.uniform(0.35, 0.9)  # with a trunk of 0.8 m: from a dachshund to a giraffe
        period = rng.uniform(0.6, 1.2) if kind != "trot" else rng.uniform(0.4, 0.7)
        motion = walk(leg=leg, speed=speed, period=period, seconds=rng.uniform(2.0, 6.0), trot=kind == "trot")
        if kind in ("sit", "rear"):
            motion = _raised(motion, leg, rng.uniform(0.3, 0.6) if kind == "sit" else rng.uniform(0.6, 1.05), kind)
        motion = _turned(motion, rng.choice([0.0, rng.uniform(-0.8, 0.8)]))
    step = {}
    if (kind in ("stand", "paper") and rng.random() < 0.5) or rng.random() < 0.1:
        step = {"step_height": float(rng.choice([-0.1, 0.1]) * rng.uniform(0.3, 1.0))}
    return _spoiled(motion, kind, step, rng)


def human(seed: int) -> Ugly:
    """A person who walks, stands, bends down, jumps or does jumping jacks, whole or as the paper's five points."""
    rng = np.random.default_rng([seed, 2])
    kind = str(rng.choice(["walk", "stand", "bend", "jump", "jack", "paper"], p=[0.35, 0.1, 0.15, 0.1, 0.2, 0.1]))
    motion = _published(("human_jumping_jack",), rng) if kind == "paper" else None
    if motion is None:
        seconds, period = rng.uniform(2.0, 6.0), rng.uniform(0.9, 1.5) * (1.0 + (kind == "jack"))
        frames = len(np.arange(0, seconds, 1 / 30))
        bow = rng.uniform(0.5, 1.1) * (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(frames) / frames))
        motion = person(
            height=rng.uniform(1.0, 2.1), seconds=seconds, period=period,
            speed=rng.uniform(0.3, 1.4) if kind == "walk" else 0.0, bend=bow if kind == "bend" else 0.0,
            jump=rng.uniform(0.03, 0.25) if kind == "jump" else 0.0,
            spread=rng.uniform(0.3, 0.9) if kind == "jack" else 0.0,
        )  # fmt: skip
        if rng.random() < 0.25:
            motion = _only(motion, ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle"))
        motion = _turned(motion, rng.choice([0.0, rng.uniform(-0.8, 0.8)]))
    step = {}
    if kind == "stand" and rng.random() < 0.5:
        height = float(rng.choice([-0.1, 0.1]) * rng.uniform(0.3, 1.0))
        step = {"step_height": height, "step_limbs": ("left_toe", "left_heel")}
    return _spoiled(motion, kind, step, rng)


def _published(names: tuple[str, ...], rng: np.random.Generator) -> KeypointMotion | None:
    """A part of one of the authors' files, or None where they are not beside the checkout."""
    path = PUBLISHED / f"{rng.choice(names)}.json"
    if not path.exists():
        return None
    motion = load_keypoints(path)
    length = int(min(len(motion.t), rng.integers(50, 140)))
    start = int(rng.integers(0, len(motion.t) - length + 1))
    part = slice(start, start + length)
    return replace(motion, t=motion.t[part], positions=motion.positions[part], confidence=motion.confidence[part])


def _spoiled(motion: KeypointMotion, kind: str, options: dict[str, Any], rng: np.random.Generator) -> Ugly:
    """What every input goes through, each step with some probability; sizes are fractions of the body's size."""
    size = float(np.median(np.ptp(motion.positions, axis=1).max(axis=1)))
    done: dict[str, Any] = {"kind": kind, **options}
    spoil: list[tuple[str, float, Callable[..., KeypointMotion]]] = [
        ("noise", 0.7, _noisy), ("slide", 0.4, _sliding), ("tilt", 0.3, _tilted), ("spikes", 0.6, _spiked),
        ("gaps", 0.5, _gapped), ("dropped", 0.4, _dropped), ("duplicated", 0.2, _duplicated), ("rate", 0.3, _sampled),
        ("missing limb", 0.1, _without_limb),
    ]  # fmt: skip
    for name, chance, change in spoil:
        if rng.random() < chance:
            motion = change(motion, size, rng)
            done[name] = True
    scale, heading = float(10 ** rng.uniform(-3, 3)), float(rng.uniform(-np.pi, np.pi))
    c, s = np.cos(heading), np.sin(heading)
    offset = scale * size * rng.uniform(-20, 20, 3)
    positions = scale * motion.positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + offset
    motion = replace(motion, positions=positions, t=motion.t + rng.uniform(0, 10))
    friction = float(rng.uniform(0.3, 1.0))
    return Ugly(motion, friction, options, {**done, "scale": scale, "heading": heading, "friction": friction})


def _noisy(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    noise = size * rng.uniform(0.002, 0.02) * rng.standard_normal(motion.positions.shape)
    return replace(motion, positions=motion.positions + noise)


def _sliding(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """One camera's errors in depth: everything slides, and the ground sinks and rises."""
    t = motion.t[:, None] - motion.t[0]
    wave = np.sin(rng.uniform(0.5, 2.0, 3) * t + rng.uniform(0, 6, 3))
    path = size * (rng.uniform(-0.15, 0.15, 3) * t * [1, 1, 0.2] + rng.uniform(0, [0.1, 0.1, 0.03]) * wave)
    return replace(motion, positions=motion.positions + path[:, None])


def _tilted(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """A ground that was estimated some degrees wrong."""
    a, b = rng.uniform(-0.08, 0.08, 2)
    centre = motion.positions.mean(axis=(0, 1))
    R = np.array([[1, 0, a], [0, 1, b], [-a, -b, 1]])
    return replace(motion, positions=(motion.positions - centre) @ R.T + centre)


def _spiked(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """Single samples that are elsewhere: 15 m/s and more."""
    positions = motion.positions.copy()
    hit = rng.random(positions.shape[:2]) < rng.uniform(0, 0.02)
    positions[hit] += size * rng.uniform(0.3, 3.0) * rng.standard_normal((hit.sum(), 3))
    return replace(motion, positions=positions)


def _gapped(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """Key points that are missing for a while; what stands in the file there is anything."""
    positions, confidence = motion.positions.copy(), motion.confidence.copy()
    for _ in range(rng.integers(1, 6)):
        i, start = rng.integers(len(motion.names)), rng.integers(len(motion.t))
        gap = slice(start, start + int(rng.integers(1, max(2, len(motion.t) // 5))))
        confidence[gap, i] = 0
        positions[gap, i] = rng.choice([0.0, 1e4 * size])
    return replace(motion, positions=positions, confidence=confidence)


def _some(motion: KeypointMotion, keep: Array) -> KeypointMotion:
    return replace(motion, t=motion.t[keep], positions=motion.positions[keep], confidence=motion.confidence[keep])


def _dropped(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """Whole frames that are not there."""
    return _some(motion, np.flatnonzero(rng.random(len(motion.t)) > rng.uniform(0, 0.3)))


def _duplicated(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """Frames that repeat the one before."""
    source = np.arange(len(motion.t))
    again = rng.random(len(source)) < 0.15
    source[1:] -= again[1:]
    return replace(motion, positions=motion.positions[source], confidence=motion.confidence[source])


def _sampled(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """Another frame rate: 8 to 240 Hz."""
    t = np.arange(motion.t[0], motion.t[-1], 1 / rng.choice([8.0, 12.0, 60.0, 120.0, 240.0]))
    near = np.clip(np.searchsorted(motion.t, t), 1, len(motion.t) - 1)
    w = np.clip((t - motion.t[near - 1]) / (motion.t[near] - motion.t[near - 1]), 0, 1)[:, None]
    c = np.where(w > 0.5, motion.confidence[near], motion.confidence[near - 1])
    c = c * (motion.confidence[near] > 0) * (motion.confidence[near - 1] > 0)
    positions = (1 - w[..., None]) * motion.positions[near - 1] + w[..., None] * motion.positions[near]
    return replace(motion, t=t, positions=positions, confidence=c)


def _without_limb(motion: KeypointMotion, size: float, rng: np.random.Generator) -> KeypointMotion:
    """The end of one limb was never seen."""
    limb = str(rng.choice([n for n in motion.names if n.endswith(("_paw", "_ankle", "_wrist"))]))
    confidence = motion.confidence.copy()
    confidence[:, motion.index(limb)] = 0
    return replace(motion, confidence=confidence)


def _only(motion: KeypointMotion, names: tuple[str, ...]) -> KeypointMotion:
    columns = [motion.index(n) for n in names]
    return replace(
        motion, names=names, positions=motion.positions[:, columns], confidence=motion.confidence[:, columns]
    )


def _turned(motion: KeypointMotion, rate: float) -> KeypointMotion:
    """A straight path bent into a circle, turning at `rate` rad/s or less: feet that stand go on standing."""
    if rate == 0:
        return motion
    speed = float(np.ptp(motion.positions[..., 0].mean(axis=1))) / (motion.t[-1] - motion.t[0])
    radius = np.sign(rate) * max(speed / abs(rate), 1.2)  # in bends that are narrower, bodies would be bent double
    angle = motion.positions[..., 0] / radius
    out = motion.positions.copy()
    out[..., 0] = (radius - motion.positions[..., 1]) * np.sin(angle)
    out[..., 1] = radius - (radius - motion.positions[..., 1]) * np.cos(angle)
    return replace(motion, positions=out)


def _raised(motion: KeypointMotion, leg: float, angle: float, kind: str) -> KeypointMotion:
    """Sits down or rears up by `angle` rad within a second and stays so for a while, about its hind hips."""
    t = motion.t - motion.t[0]
    up = angle * np.clip(np.minimum(t - 0.3, t[-1] - 0.3 - t) / 0.8, 0, 1)
    up = angle * (3 * (up / angle) ** 2 - 2 * (up / angle) ** 3)
    out = motion.positions.copy()
    pivot = motion["hind_left_hip"] * [1, 0, 1]
    drop = 0.4 * leg * up / angle if kind == "sit" else np.zeros_like(up)
    for i, name in enumerate(motion.names):
        if name.startswith("front") and (kind == "rear" or not name.endswith("paw")):
            d = out[:, i] - pivot
            out[:, i, 0] = pivot[:, 0] + np.cos(up) * d[:, 0] - np.sin(up) * d[:, 2]
            out[:, i, 2] = pivot[:, 2] + np.sin(up) * d[:, 0] + np.cos(up) * d[:, 2]
        if not name.endswith("paw"):
            out[:, i, 2] -= drop
    return replace(motion, positions=out)
