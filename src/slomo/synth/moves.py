"""How creatures move: gaits, turns, postures and gestures as joint angles and a root path over any times.

Made for pictures and their flow, not for physics: feet are near the ground and about still while they stand, no more.
"""

from dataclasses import dataclass

import numpy as np

from slomo.rotation import rot_zyx
from slomo.skeleton import Gait, Skeleton
from slomo.synth.creature import Creature, forward
from slomo.synth.gait import smooth_random

Array = np.ndarray


@dataclass(frozen=True)
class Move:
    """Poses at T times: link rotations (T, B, 3, 3) and node positions (T, M, 3) in the world, body lengths, z up, the
    ground at 0. `name` says what it is."""

    name: str
    R: Array
    nodes: Array


def _joint(skeleton: Skeleton, word: str) -> list[int]:
    return [j for j, n in enumerate(skeleton.names[: skeleton.link_count]) if word in n]


def _wander(skeleton: Skeleton, t: Array, rng: np.random.Generator, size: float) -> Array:
    """(T, B, 3) rad: slow random motion of all joints around a random pose, in units of the joints' spread."""
    B = skeleton.link_count
    held = rng.standard_normal((B, 3)) * size
    moving = smooth_random(rng, t, rng.uniform(0.4, 1.5), 3 * B).reshape(-1, B, 3) * size * 0.4
    return (held + moving) * skeleton.sigma[:B]


def _gait(skeleton: Skeleton, gait: Gait, t: Array, rng: np.random.Generator) -> tuple[Array, float, Array]:
    """Joint angles (T, B, 3), speed in body lengths / s, and the stride's angle (T,) rad."""
    rest = skeleton.rest()
    leg = float(np.mean([rest[n.swing, 2] - rest[n.contact, 2] for n in skeleton.limbs]))
    q = np.zeros((len(t), skeleton.link_count, 3))
    amplitude, rate = np.radians(rng.uniform(7, 36)), rng.uniform(0.6, 3.2)
    duty = np.clip(gait.duty + rng.uniform(-0.1, 0.1), 0.2, 0.8)
    start, lift = rng.random(), rng.uniform(0.4, 1.4)
    land = np.array(gait.land) + rng.uniform(-0.06, 0.06, len(gait.land))
    for limb, when in zip(skeleton.limbs, land, strict=True):
        c = (rate * t + start - when) % 1.0
        swing = np.clip((c - duty) / (1 - duty), 0, 1)
        ease = swing**2 * (3 - 2 * swing)
        front = "front" in limb.name
        own = amplitude * (0.85 if front else 1.0)
        q[:, limb.swing, 1] = own * np.where(c < duty, 2 * c / duty - 1, 1 - 2 * ease)
        for joint, angle in limb.lift:
            q[:, joint, 1] = lift * angle * np.sin(np.pi * swing) ** 1.5
    beat = 2 * np.pi * (rate * t + start)
    return q, 2 * leg * np.tan(amplitude) / duty * rate, beat


def _to_ground(skeleton: Skeleton, offset: Array, R0: Array, q: Array, height: Array) -> tuple[Array, Array]:
    """Links and nodes with the lowest node at its sole's height plus `height` (T,). Root at x = y = 0."""
    R, p = forward(skeleton, offset, q)
    R, p = R0[:, None] @ R, np.einsum("tij,tmj->tmi", R0, p)
    p[..., 2] += (skeleton.sole + height - p[..., 2].min(1))[:, None]
    return R, p


def _level(skeleton: Skeleton, offset: Array, q: Array) -> float:
    """Pitch, rad, that brings the lowest front and the lowest hind foot to one height, on average."""
    _, p = forward(skeleton, offset, q)
    ends = [np.stack([p[:, n.contact] for n in skeleton.limbs if w in n.name], 1) for w in ("front", "hind")]
    low = [e[..., 2].min(1).mean() for e in ends]
    apart = ends[0][..., 0].mean() - ends[1][..., 0].mean()
    return float(np.arctan2(low[0] - low[1], max(apart, 0.2)))


def _quadruped_posture(skeleton: Skeleton, name: str, q: Array, rng: np.random.Generator) -> float:
    """Lay a posture over angles (T, B, 3), in place; returns the trunk's pitch, rad, positive nose down."""
    u = rng.uniform

    def turn(word: str, low: float, high: float, sides: str = "") -> None:
        for j in _joint(skeleton, word):
            if sides in skeleton.names[j]:
                q[:, j, 1] += np.radians(u(low, high))

    if name == "sit":
        turn("hip", -75, -45), turn("knee", 45, 75), turn("hock", -75, -35), turn("shoulder", 5, 35)
        return -np.radians(u(25, 50))
    if name == "rear":
        turn("hip", 5, 55), turn("knee", -10, 30), turn("shoulder", -60, 30), turn("elbow", -90, -10)
        turn("wrist", 0, 80)
        return -np.radians(u(25, 75))
    if name == "lie":
        turn("hip", -60, -30), turn("knee", 50, 75), turn("hock", -85, -50), turn("shoulder", -10, 40)
        turn("elbow", -105, -50), turn("wrist", -20, 60)
        return 0.0
    if name == "bow":
        turn("shoulder", -60, -15), turn("elbow", -70, 20), turn("withers", -40, 50)
        return np.radians(u(10, 35))
    if name == "reach":  # one paw up, or a hind leg
        limb = skeleton.limbs[rng.integers(len(skeleton.limbs))]
        q[:, limb.swing, 1] += np.radians(u(-65, 20))
        for joint, angle in limb.lift:
            q[:, joint, 1] += np.radians(u(0.2, 1.6) * np.degrees(angle))
        return 0.0
    if name == "graze":
        turn("withers", 30, 70), turn("neck", 0, 35), turn("head", -40, 20)
    return 0.0


def _carry_head(skeleton: Skeleton, q: Array, rng: np.random.Generator) -> None:
    """Lay over angles (T, B, 3), in place, how high the head is carried and where it looks: the rest pose holds it up,
    but many animals walk with it at the height of their back, and all look about."""
    lowered = np.radians(rng.uniform(-15, 55))
    aside = np.radians(rng.uniform(-110, 110)) * (rng.random() < 0.5)
    for word, pitch, yaw in (("withers", 1.0, 0.4), ("neck", 0.0, 0.3), ("head", -0.7, 0.3)):
        for j in _joint(skeleton, word):
            q[:, j] += [0, pitch * lowered, yaw * aside]


QUADRUPED = {"gait": 0.56, "stand": 0.1, "sit": 0.05, "rear": 0.05, "lie": 0.03, "bow": 0.04, "reach": 0.07,
             "graze": 0.06, "any": 0.04}  # fmt: skip
HUMAN = {"gait": 0.3, "stand": 0.1, "squat": 0.1, "stretch": 0.12, "jack": 0.12, "wave": 0.12, "any": 0.14}


def _quadruped(c: Creature, t: Array, rng: np.random.Generator) -> Move:
    s = c.skeleton
    name = str(rng.choice(list(QUADRUPED), p=list(QUADRUPED.values())))
    q = np.tile(c.build.stance, (len(t), 1, 1))
    speed, turn, bounce, pitch = 0.0, 0.0, np.zeros(len(t)), np.zeros(len(t))
    if name == "gait":
        gait = s.gaits[rng.integers(len(s.gaits))]
        angles, speed, beat = _gait(s, gait, t, rng)
        q += angles
        bound = "gallop" in gait.name
        name = gait.name
        bounce = rng.uniform(0, 0.12 if bound else 0.02) * (1 + np.sin(beat * (1 if bound else 2) + rng.uniform(0, 6)))
        rock = rng.uniform(0.02, 0.16) if bound else rng.uniform(0, 0.03)
        pitch = rock * np.sin(beat + rng.uniform(0, 6))
        spine = _joint(s, "spine_mid")[0]
        q[:, spine, 1] += rng.uniform(0, 0.3 if bound else 0.05) * np.sin(beat + rng.uniform(0, 6))
        q[:, _joint(s, "withers")[0], 1] += rng.uniform(0, 0.12) * np.sin(beat * 2 + rng.uniform(0, 6))
        turn = rng.normal(0, 0.5) if rng.random() < 0.5 else 0.0
        q[:, spine, 2] += 0.15 * turn
    q += _wander(s, t, rng, 0.9 if name == "any" else 0.18)
    free = _joint(s, "tail") + _joint(s, "neck") + _joint(s, "withers") + _joint(s, "head")
    q[:, free] += (_wander(s, t, rng, rng.uniform(0.3, 1.0)))[:, free]
    _carry_head(s, q, rng)
    tilt = _quadruped_posture(s, name, q, rng)
    q = np.clip(q, s.lower[: s.link_count], s.upper[: s.link_count])
    q[:, 0] = 0
    if name not in ("sit", "rear", "bow", "any"):
        tilt += np.clip(_level(s, c.offset, q), -0.4, 0.4)
    roll = rng.normal(0, 0.04) + 0.03 * smooth_random(rng, t, 0.7, 1)[:, 0]
    return _placed(c, name, t, q, pitch + tilt, roll, bounce, speed, turn, rng)


def _human(c: Creature, t: Array, rng: np.random.Generator) -> Move:
    s, u = c.skeleton, rng.uniform
    name = str(rng.choice(list(HUMAN), p=list(HUMAN.values())))
    number = {n: j for j, n in enumerate(s.names[: s.link_count])}
    q = np.tile(c.build.stance, (len(t), 1, 1))
    speed, turn, bounce, pitch = 0.0, rng.normal(0, 0.4) * (rng.random() < 0.5), np.zeros(len(t)), np.zeros(len(t))
    side = (("left", 1.0), ("right", -1.0))
    if name == "gait":
        gait = s.gaits[rng.integers(len(s.gaits))]
        angles, speed, beat = _gait(s, gait, t, rng)
        q += angles
        swing = u(0, 1.3)
        for w, y in side:  # arms against the legs
            q[:, number[f"{w}_shoulder"], 1] -= swing * angles[:, number[f"{w}_hip"], 1]
            q[:, number[f"{w}_elbow"], 1] -= u(0, 1.7 if gait.name == "run" else 0.6)
            q[:, number[f"{w}_shoulder"], 0] += y * u(0, 0.25)
        bounce = u(0, 0.03) * (1 + np.sin(2 * beat))
        name = gait.name
    period = u(0.8, 2.5)
    wave = 0.5 - 0.5 * np.cos(2 * np.pi * (t / period + rng.random()))  # 0 to 1 and back
    if name == "squat":
        depth = wave * u(0.5, 2.2)
        for w, y in side:
            q[:, number[f"{w}_hip"], 1] -= depth
            q[:, number[f"{w}_hip"], 0] += y * u(0, 0.4)
            q[:, number[f"{w}_knee"], 1] += u(0.9, 1.1) * 1.2 * depth
            q[:, number[f"{w}_ankle"], 1] -= 0.4 * depth
            q[:, number[f"{w}_shoulder"], 1] -= u(0, 1.4) * wave
        pitch = 0.35 * depth * u(0.2, 1)
    if name in ("stretch", "jack"):
        both, legs = u(1.0, 3.0), u(0.1, 0.6) if name == "jack" else u(0, 0.3)
        ahead, bent = (u(-2.8, 0.4), u(0, 1.2)) if name == "stretch" and rng.random() < 0.5 else (0.0, u(0, 0.4))
        for w, y in side:
            q[:, number[f"{w}_shoulder"], 0] += y * wave * both * (0.15 if ahead else 1.0)
            q[:, number[f"{w}_shoulder"], 1] += wave * ahead
            q[:, number[f"{w}_elbow"], 1] -= bent
            q[:, number[f"{w}_hip"], 0] += y * (wave if name == "jack" else 1.0) * legs
        bounce = u(0, 0.06) * np.sin(np.pi * wave) if name == "jack" else bounce
        pitch = u(-0.3, 0.8) * wave if name == "stretch" else pitch
    if name == "wave":
        for w, y in side if rng.random() < 0.2 else (side[rng.integers(2)],):
            q[:, number[f"{w}_shoulder"], 0] += y * u(0.3, 2.7)
            q[:, number[f"{w}_shoulder"], 2] += y * u(-0.5, 1.5)
            q[:, number[f"{w}_elbow"], 1] -= u(0.2, 2.2) + 0.5 * wave
    q += _wander(s, t, rng, 0.75 if name == "any" else 0.16)
    q = np.clip(q, s.lower[: s.link_count], s.upper[: s.link_count])
    q[:, 0] = 0
    return _placed(c, name, t, q, pitch + rng.normal(0, 0.06), rng.normal(0, 0.04), bounce, speed, turn, rng)


def _placed(c: Creature, name: str, t: Array, q: Array, pitch, roll, bounce, speed, turn, rng) -> Move:
    """On the ground, along a path through the origin that turns at `turn` rad/s."""
    heading = rng.uniform(0, 2 * np.pi) + turn * (t - t[0])
    R0 = rot_zyx(heading, np.zeros_like(t) + pitch, np.zeros_like(t) + roll)
    R, nodes = _to_ground(c.skeleton, c.offset, R0, q, bounce)
    mid = (heading[1:] + heading[:-1]) / 2
    step = (speed * np.diff(t))[:, None] * np.stack([np.cos(mid), np.sin(mid)], 1)
    nodes[:, :, :2] += np.concatenate([np.zeros((1, 2)), np.cumsum(step, 0)])[:, None]
    return Move(name, R, nodes)


def move(c: Creature, t: Array, rng: np.random.Generator) -> Move:
    """Something that the creature does at times t (T,) s, drawn at random."""
    return _human(c, t, rng) if c.skeleton.kind == "human" else _quadruped(c, t, rng)
