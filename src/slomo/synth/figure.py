"""The motion of a rendered person: feet that stand are still, legs follow them by inverse kinematics, and the centre of
mass is over the soles. Lengths are standing heights of the skeleton; x forward, y left, z up in every link at rest."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from slomo.gravity import GRAVITY
from slomo.rotation import rot_zyx
from slomo.synth.creature import Creature, forward, joint_rotation
from slomo.synth.gait import Path, smooth_random

Array = np.ndarray


@dataclass(frozen=True)
class Stride:
    """A way to get ahead on two legs.

    Attributes:
        duty: fraction of the stride that the ball of a foot stands.  froude: v^2 / (g leg) at the usual speed.
        rate: stride frequency in units of sqrt(g / leg).  elbow, lean: rad, of the arms and of the trunk.
        lift: heights, of a foot that swings.
    """

    duty: float
    froude: float
    rate: float
    elbow: float
    lean: float
    lift: float


STRIDES = {"walk": Stride(0.52, 0.18, 0.27, 0.3, 0.03, 0.04), "run": Stride(0.36, 0.85, 0.41, 1.4, 0.10, 0.14)}
ON_THE_SPOT = ("stand", "squat", "jack", "wave", "stretch", "bend", "jump")
MOVES = (*STRIDES, *ON_THE_SPOT)
_OVER_SOLE = 0.45  # of the way from the ankle to the ball of the foot: where the centre of mass is above
_STRAIGHT = 0.997  # of the lengths of thigh and shank that a leg is stretched to at most
_TYPICAL = 1.7  # m, by which those who jump fall as people of any height do
_ROUNDS = 12  # of legs to the feet and of balance, in turn
_SIDES = (("left", 1.0), ("right", -1.0))


@dataclass(frozen=True)
class Figure:
    """Poses at T times: link rotations R (T, B, 3, 3) and nodes (T, M, 3) in the world, z up, the ground at 0; contact
    (T, 2) of the left and the right foot, a foot's ball standing still where it is true."""

    R: Array
    nodes: Array
    contact: Array


@dataclass(frozen=True)
class _Plan:
    """What is asked of the legs and of the rest: balls of the feet (T, 2, 3) and their pitch (T, 2), contact (T, 2),
    heading (T,), the pelvis (T, 3) against where balance and reach have it, and joint angles q (T, B, 3)."""

    ball: Array
    pitch: Array
    contact: Array
    heading: Array
    pelvis: Array
    q: Array


def pose(c: Creature, name: str, t: Array, *, height: float, speed: float | None, turn: float, seed: int) -> Figure:
    """Move a person.

    Args:
        name: of `MOVES`.  t: (T,) s.  height: m, of the person.
        speed: m/s, or None for the usual speed.  turn: rad/s, positive to the left; both of a walk or a run.

    Raises:
        ValueError: the legs do not reach, or somebody on the spot is to travel or turn.
    """
    rng = np.random.default_rng([seed, 3])
    if name in STRIDES:
        plan = _strides(c, STRIDES[name], t, height, speed, turn, rng)
    elif speed or turn:
        raise ValueError(f"a {name} is done on the spot")
    else:
        plan = _on_the_spot(c, name, t, rng)
    return _legs(c, plan, float(t[1] - t[0]) if len(t) > 1 else 1.0, whole=name in STRIDES)


def _number(c: Creature) -> dict[str, int]:
    return {n: j for j, n in enumerate(c.skeleton.names)}


def _leg(c: Creature) -> tuple[float, float]:
    """Lengths of thigh and shank."""
    at = _number(c)
    a, b = (float(np.linalg.norm(c.offset[at[n]])) for n in ("left_knee", "left_ankle"))
    return a, b


def _idle(c: Creature, t: Array, rng: np.random.Generator) -> Array:
    """(T, B, 3) rad: small motions of trunk, head and arms."""
    s = c.skeleton
    q = 0.25 * smooth_random(rng, t, 1.5, 3 * s.link_count).reshape(len(t), -1, 3) * s.sigma[: s.link_count]
    return q * (np.array(["spine" in n or "neck" in n or "head" in n for n in s.names[: s.link_count]])[:, None])


def _strides(c: Creature, stride: Stride, t: Array, height: float, speed: float | None, turn: float, rng) -> _Plan:
    a, b = _leg(c)
    leg = (a + b) * height
    usual = np.sqrt(stride.froude * GRAVITY * leg)
    v = (usual if speed is None else speed) / height
    rate = stride.rate * np.sqrt(GRAVITY / leg) * np.sqrt(v * height / usual)
    path, start = Path(v, turn, 0.0), rng.uniform()
    ball, pitch, contact = np.zeros((len(t), 2, 3)), np.zeros((len(t), 2)), np.zeros((len(t), 2), bool)
    q, at = _idle(c, t, rng), _number(c)
    swing = rng.uniform(0.6, 1.2) * 0.5 * v / rate / (a + b)
    for k, (side, y) in enumerate(_SIDES):
        s = t * rate + start + 0.5 * k
        n, s = np.floor(s), s - np.floor(s)
        middle = (n - start - 0.5 * k + stride.duty / 2) / rate
        foot, following = (path.at(m, 0.05, 0.045 * y) for m in (middle, middle + 1 / rate))
        contact[:, k] = s <= stride.duty
        w = np.clip((s - stride.duty) / (1 - stride.duty), 0, 1)
        ball[:, k, :2] = foot + (w**3 * (10 - 15 * w + 6 * w**2))[:, None] * (following - foot)
        ball[:, k, 2] = c.skeleton.sole + stride.lift * np.sin(np.pi * w) ** 2
        # The heel comes up at the end of the stance, and the toes before it comes down again.
        off = np.clip((s / stride.duty - 0.55) / 0.45, 0, 1)
        pitch[:, k] = 0.85 * off**2 * (1 - w) ** 2 - 0.2 * np.sin(np.pi * w) * w
        q[:, at[f"{side}_shoulder"], 1] = swing * np.cos(2 * np.pi * (s - stride.duty / 2 + 0.25) - np.pi / 2)
        q[:, at[f"{side}_shoulder"], 0] = y * 0.12
        q[:, at[f"{side}_elbow"], 1] = -stride.elbow * (1 + 0.3 * np.cos(2 * np.pi * s))
    heading = turn * t
    pelvis = np.concatenate([path.at(t, 0.0, 0.0), np.zeros((len(t), 1))], 1)
    beat = 4 * np.pi * (t * rate + start - stride.duty / 2)
    if stride.duty < 0.5:  # a run is lowest in the middle of the stance
        pelvis[:, 2] = -0.008 - 0.012 * (1 + np.cos(beat))
    q[:, 0, 1] = stride.lean
    return _Plan(ball, pitch, contact, heading, pelvis, q)


def _eased(x: Array) -> Array:
    """From 0 to 1 while x does, with no speed at either end."""
    x = np.clip(x, 0, 1)
    return x**2 * (3 - 2 * x)


def _back_and_forth(x: Array) -> Array:
    """0, 1 for a while, 0 for a while, and again: once in each unit of x."""
    return np.clip(1.5 - np.abs((x % 1.0) - 0.5) * 4, 0, 1)


def _on_the_spot(c: Creature, name: str, t: Array, rng: np.random.Generator) -> _Plan:
    q, at, u = _idle(c, t, rng), _number(c), rng.uniform
    T = len(t)
    pelvis, heading = np.zeros((T, 3)), np.full(T, u(-0.3, 0.3))
    apart, up, contact = np.full(T, u(0.045, 0.085)), np.zeros(T), np.ones((T, 2), bool)
    raised, beside = np.zeros((T, 2)), np.zeros(T)  # arms, sideways; the pelvis, to the left
    period = u(1.1, 2.2)
    if name == "squat":
        down = 0.5 - 0.5 * np.cos(2 * np.pi * (t / period / 1.4 + rng.random()))
        pelvis[:, 2] = -u(0.12, 0.25) * down
        q[:, at["spine_mid"], 1] += u(0.3, 0.7) * down
        for side, _ in _SIDES:
            q[:, at[f"{side}_shoulder"], 1] -= u(0.3, 1.3) * down
        apart += 0.04
    elif name == "jack":
        s = (t / period + rng.random()) % 1.0
        hop = np.where(s < 0.22, s / 0.22, np.where((s >= 0.5) & (s < 0.72), (s - 0.5) / 0.22, 0.0))
        ease = _eased(hop)
        open_ = np.where(s < 0.22, ease, np.where(s < 0.5, 1.0, np.where(s < 0.72, 1 - ease, 0.0)))
        apart = 0.06 + u(0.10, 0.18) * open_
        up = u(0.03, 0.06) * 4 * hop * (1 - hop)
        contact &= (hop == 0)[:, None]
        raised += (u(1.6, 2.6) * open_)[:, None]
    elif name == "wave":
        arm = rng.integers(2)
        raised[:, arm] = u(1.6, 2.6)
        q[:, at[f"{_SIDES[arm][0]}_shoulder"], 2] = _SIDES[arm][1] * u(0.6, 1.4)
        q[:, at[f"{_SIDES[arm][0]}_elbow"], 1] = -0.8 - 0.6 * np.sin(2 * np.pi * t * u(0.8, 1.6))
    elif name == "stretch":  # arms up, then to one side and to the other
        w = _eased(t / u(0.8, 1.4))
        raised += u(2.0, 2.7) * w[:, None]
        aside = u(0.2, 0.45) * w * np.sin(2 * np.pi * t / u(2.2, 3.2))
        q[:, at["spine_mid"], 0] += aside
        q[:, at["chest"], 0] += 0.4 * aside
        beside = 0.12 * aside  # the hips go the other way
    elif name == "bend":  # the hands to the ground
        w = _eased(_back_and_forth(t / period / 1.3 + 0.3 * rng.random()))
        lean, round_ = u(0.6, 1.0) * w, u(0.4, 0.8) * w
        q[:, 0, 1] = lean
        q[:, at["spine_mid"], 1] += 0.6 * round_
        q[:, at["chest"], 1] += 0.4 * round_
        pelvis[:, 2] = -u(0.02, 0.12) * w
        for side, _ in _SIDES:
            q[:, at[f"{side}_shoulder"], 1] -= lean + round_
    elif name == "jump":
        flight, deep = u(0.28, 0.42), u(0.08, 0.14)
        push = 2 * deep / (GRAVITY / _TYPICAL / 2 * flight)  # s, from rest to take-off, and from landing to rest
        s = (t / (period + 0.5) + rng.random()) % 1.0 * (period + 0.5) - push - 0.4  # from take-off
        up = np.where((s > 0) & (s < flight), GRAVITY / _TYPICAL / 2 * s * (flight - s), 0.0)
        contact &= ~((s > 0) & (s < flight))[:, None]
        away = np.where(s < flight / 2, -s, s - flight)  # s, from the air, on either side of it
        crouch = np.where(away < push, 1 - (1 - np.clip(away / push, 0, 1)) ** 2, _eased(1 - (away - push) / 0.4))
        pelvis[:, 2] = -deep * crouch
        q[:, at["spine_mid"], 1] += u(0.2, 0.5) * crouch
        for side, _ in _SIDES:
            q[:, at[f"{side}_shoulder"], 1] += u(0.3, 0.8) * crouch - u(0.8, 2.2) * (up > 0) * up / max(up.max(), 1e-9)
    for k, (side, y) in enumerate(_SIDES):
        q[:, at[f"{side}_shoulder"], 0] += y * (0.15 + raised[:, k])
        q[:, at[f"{side}_elbow"], 1] -= 0.25
    ball = np.zeros((T, 2, 3))
    ahead = np.stack([np.cos(heading), np.sin(heading)], 1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    for k, (_, y) in enumerate(_SIDES):
        ball[:, k, :2] = 0.06 * ahead + y * apart[:, None] * left
        ball[:, k, 2] = c.skeleton.sole + up
    sway = smooth_random(rng, t, 1.2, 2)
    pelvis[:, :2] += (0.01 * sway[:, :1] + beside[:, None]) * left
    pitch = np.where(contact, 0.0, 0.35)
    return _Plan(ball, pitch, contact, heading, pelvis, q)


def _legs(c: Creature, plan: _Plan, dt: float, *, whole: bool) -> Figure:
    """Legs to the feet, with the pelvis as high as they reach and shifted until the centre of mass is over the soles:
    in every frame, or if `whole` on average over all of them (`dt` s apart)."""
    s, at = c.skeleton, _number(c)
    a, b = _leg(c)
    ball = c.offset[[at[f"{side}_toe"] for side, _ in _SIDES]]  # in the ankles' frames
    T = len(plan.heading)
    ahead = np.stack([np.cos(plan.heading), np.sin(plan.heading)], 1)
    turned = rot_zyx(plan.heading, plan.q[:, 0, 1], np.zeros(T))
    foot_R = np.stack([rot_zyx(plan.heading, plan.pitch[:, k], np.zeros(T)) for k in (0, 1)], 1)
    ankle = plan.ball - (foot_R @ ball[..., None])[..., 0]
    sole = ankle + _OVER_SOLE * (plan.ball - ankle)
    hip = {side: c.offset[at[f"{side}_hip"]] for side, _ in _SIDES}
    shift, still = np.zeros(T), round(0.07 / dt) * 2 + 1
    q = plan.q.copy()
    q[:, 0] = 0
    R, p = np.empty(0), np.empty(0)
    aim, ends = ankle.copy(), [at[f"{side}_ankle"] for side, _ in _SIDES]
    for _ in range(_ROUNDS):
        root = plan.pelvis * [1, 1, 0] + np.concatenate([shift[:, None] * ahead, np.zeros((T, 1))], 1)
        d = np.stack([aim[:, k] - root - turned @ hip[side] for k, (side, _) in enumerate(_SIDES)], 1)
        over = (_STRAIGHT * (a + b)) ** 2 - (d[..., :2] ** 2).sum(-1)
        if over.min() <= 0:
            raise ValueError("the legs do not reach")
        high = minimum_filter1d((d[..., 2] + np.sqrt(over)).min(1), still, mode="nearest")
        rise = uniform_filter1d(high, still, mode="nearest") + plan.pelvis[:, 2]
        root[:, 2] += rise
        d[..., 2] -= rise[:, None]
        for k, (side, _) in enumerate(_SIDES):
            _reach(q, at, side, np.einsum("tji,tj->ti", turned, d[:, k]), a, b)
            shank = turned @ _chain(q, at[f"{side}_hip"], at[f"{side}_knee"])
            q[:, at[f"{side}_ankle"]] = _angles(np.swapaxes(shank, -1, -2) @ foot_R[:, k])
        R, p = forward(s, c.offset, q)
        R, p = turned[:, None] @ R, np.einsum("tij,tmj->tmi", turned, p) + root[:, None]
        aim += ankle - p[:, ends]  # bones are not quite along their links' axes
        off = ((_mass(c, R, p) - sole.mean(1))[:, :2] * ahead).sum(1)
        shift -= off.mean() if whole else off
    return Figure(R, p, plan.contact)


def _reach(q: Array, at: dict[str, int], side: str, d: Array, a: float, b: float) -> None:
    """Write the angles of hip and knee that bring the ankle to d (T, 3), from the hip in the pelvis' frame."""
    n = np.linalg.norm(d, axis=1)
    knee = np.pi - np.arccos(np.clip((a * a + b * b - n * n) / (2 * a * b), -1, 1))
    x, z = -b * np.sin(knee), -a - b * np.cos(knee)
    out = np.arcsin(np.clip(-d[:, 1] / z, -1, 1))
    q[:, at[f"{side}_hip"]] = 0
    q[:, at[f"{side}_hip"], 0] = out
    q[:, at[f"{side}_hip"], 1] = np.arctan2(-d[:, 2], d[:, 0]) - np.arctan2(-np.cos(out) * z, x)
    q[:, at[f"{side}_knee"]] = 0
    q[:, at[f"{side}_knee"], 1] = knee


def _chain(q: Array, *joints: int) -> Array:
    R = np.eye(3)
    for j in joints:
        R = R @ joint_rotation(q[:, j])
    return R


def _angles(R: Array) -> Array:
    """(T, 3) about x, y, z of rotations (T, 3, 3) = Ry Rx Rz, the inverse of `joint_rotation`."""
    return np.stack([np.arcsin(np.clip(-R[:, 1, 2], -1, 1)), np.arctan2(R[:, 0, 2], R[:, 2, 2]),
                     np.arctan2(R[:, 1, 0], R[:, 1, 1])], 1)  # fmt: skip


def _mass(c: Creature, R: Array, p: Array) -> Array:
    """(T, 3) centre of mass of the body's capsules, all of one density."""
    s = c.skeleton
    own = s.capsule_nodes == s.capsule_link[:, None]
    local = np.where(own[..., None], 0.0, c.offset[s.capsule_nodes]) + c.build.shift
    ends = p[:, s.capsule_link, None] + (R[:, s.capsule_link, None] @ local[..., None])[..., 0]
    r = c.build.radii.mean(-1)
    volume = r**2 * (np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1) + 4 / 3 * r)
    return (ends.mean(2) * (volume / volume.sum(1, keepdims=True))[..., None]).sum(1)
