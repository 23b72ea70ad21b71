"""The motion of the procedural animal: trunk along a path, paws still while they stand, legs by inverse kinematics."""

from dataclasses import dataclass

import numpy as np

from slomo.gravity import GRAVITY
from slomo.rotation import rot_zyx
from slomo.synth.acts import ACTS, perform
from slomo.synth.animal import FEET, KEYPOINTS, LEG_JOINTS, Proportions, rest_joints

_FOLDED = 0.36  # of the lengths of a leg's upper bones: the least distance between their ends, of a paw in the air


@dataclass(frozen=True)
class Gait:
    """Foot-fall pattern.

    Attributes:
        phases: touch-down of FEET as fractions of the stride.  duty: fraction of the stride that a foot stands.
        froude: v^2 / (g hip height) at the usual speed.  rate: stride frequency in units of sqrt(g / hip height).
        lift: heights of the withers, of a paw that swings.  bound: rad, by which the spine arches and stretches.
    """

    phases: tuple[float, float, float, float]
    duty: float
    froude: float
    rate: float
    lift: float = 0.10
    bound: float = 0.0


GAITS = {
    "walk": Gait((0.25, 0.75, 0.0, 0.5), 0.62, 0.12, 0.30),  # lateral sequence: HL, FL, HR, FR
    "pace": Gait((0.08, 0.58, 0.0, 0.5), 0.58, 0.14, 0.31),
    "trot": Gait((0.5, 0.0, 0.0, 0.5), 0.52, 0.27, 0.39),
    "gallop": Gait((0.45, 0.60, 0.0, 0.12), 0.30, 1.8, 0.62, 0.12, 0.12),  # transverse, on the right lead
    "rotary": Gait((0.60, 0.45, 0.0, 0.12), 0.30, 1.8, 0.62, 0.12, 0.12),  # a gallop whose front and hind leads differ
    "stand": Gait((0.0, 0.0, 0.0, 0.0), 1.0, 0.0, 0.2),
}
MOVES = (*GAITS, *ACTS)


@dataclass(frozen=True)
class Motion:
    """The animal over time.

    Attributes:
        t: (T,) s.  keypoints: (T, N, 3) m, world, in order of `KEYPOINTS`.  contact: (T, 4) bool, in order of `FEET`.
        lateral: (T, 3) unit vector to the trunk's left.
    """

    t: np.ndarray
    keypoints: np.ndarray
    contact: np.ndarray
    lateral: np.ndarray


def smooth_random(rng: np.random.Generator, t: np.ndarray, period: float, n: int) -> np.ndarray:
    """(T, n) smooth curves of about unit amplitude that change over `period` s: sums of sines."""
    k = np.arange(1, 5)
    a, b = rng.uniform(0, 2 * np.pi, (4, n)), rng.uniform(0.7, 1.3, (4, n))
    wave = np.sin(2 * np.pi * t[:, None, None] * (k[:, None] * b / (2.5 * period)) + a)
    return (wave / np.sqrt(k)[:, None]).sum(1) / 1.44


class Path:
    """Where the trunk's middle is and looks at time t: constant speed (m/s) and turning rate (rad/s)."""

    def __init__(self, speed: float, turn: float, middle: float):
        self.speed, self.turn, self.middle = speed, turn, middle

    def at(self, t: np.ndarray, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """(..., 2) m, world, of the trunk-fixed point (x, y): x forward from the pelvis, y left."""
        a = self.turn * t
        s = self.speed * t
        u = s * np.sinc(a / np.pi)
        w = s * np.where(np.abs(a) < 1e-9, a / 2, (1 - np.cos(a)) / np.where(np.abs(a) < 1e-9, 1, a))
        x = x - self.middle
        return np.stack([u + np.cos(a) * x - np.sin(a) * y, w + np.sin(a) * x + np.cos(a) * y], -1)


def _two_bones(a: np.ndarray, c: np.ndarray, ab: float, bc: float, bend: np.ndarray) -> np.ndarray:
    """(T, 3) the joint between `a` and `c` (T, 3) m that bends towards `bend` (T, 3); lengths m."""
    d = c - a
    n = np.linalg.norm(d, axis=1, keepdims=True)
    if np.any(n > ab + bc) or np.any(n < abs(ab - bc)):
        raise ValueError("leg does not reach")
    x = d / n
    along = (ab**2 - bc**2 + n**2) / (2 * n)
    y = bend - (bend * x).sum(1, keepdims=True) * x
    return a + along * x + np.sqrt(np.maximum(ab**2 - along**2, 0)) * y / np.linalg.norm(y, axis=1, keepdims=True)


def _feet(gait: Gait, rate: float, t: np.ndarray, path: Path, rest: dict[str, np.ndarray], lift: float, rng):
    """Paw positions (T, 4, 3), contact (T, 4), the signed stride phase (T, 4): stance 0..1, swing 1..2, and the stride
    (T,) in turns."""
    paws, contact, phase = np.zeros((len(t), 4, 3)), np.zeros((len(t), 4), bool), np.zeros((len(t), 4))
    start = rng.uniform()
    for i, leg in enumerate(FEET):
        home = rest[f"{leg}_paw"]
        stride = t * rate + start - gait.phases[i] if path.speed or path.turn else np.zeros_like(t)
        k = np.floor(stride)
        s = stride - k
        middle = (k + gait.duty / 2 - start + gait.phases[i]) / rate  # time of mid-stance
        foot = path.at(middle if path.speed or path.turn else 0 * t, home[0], home[1])
        following = path.at(middle + 1 / rate, home[0], home[1])
        contact[:, i] = s <= gait.duty
        w = np.clip((s - gait.duty) / max(1 - gait.duty, 1e-9), 0, 1)
        blend = w**3 * (10 - 15 * w + 6 * w**2)
        paws[:, i, :2] = foot + blend[:, None] * (following - foot)
        paws[:, i, 2] = home[2] + lift * np.sin(np.pi * w**0.8) ** 2
        phase[:, i] = np.where(contact[:, i], s / gait.duty, 1 + w)
    return paws, contact, phase, t * rate + start


def animate(p: Proportions, gait_name: str, t: np.ndarray, *, speed: float | None, turn: float, seed: int) -> Motion:
    """Move the animal along a path through the origin.

    Args:
        p: proportions.  gait_name: of `MOVES`.  t: (T,) s.
        speed: m/s, or None for the usual speed of the gait.  turn: rad/s, positive to the left; both of a gait.
        seed: of all small variations.

    Raises:
        ValueError: the legs do not reach, or what is done on the spot is to travel or turn.
    """
    if gait_name in ACTS and (speed or turn):
        raise ValueError(f"to {gait_name} is done on the spot")
    gait, rest, h = GAITS.get(gait_name, GAITS["stand"]), rest_joints(p), p.height
    act = perform(gait_name, p, t, seed)
    rng = np.random.default_rng([seed, 3])
    hip = p.hip * h
    usual = np.sqrt(gait.froude * GRAVITY * hip)
    v = usual if speed is None else speed
    # Animals lengthen and quicken their stride together as they speed up.
    rate = gait.rate * np.sqrt(GRAVITY / hip) * (np.sqrt(v / usual) if usual and v else 1.0)
    path = Path(v, turn, p.trunk * h / 2)
    paws, contact, phase, stride = _feet(gait, rate, t, path, rest, gait.lift * h, rng)
    paws, contact = paws + h * act.paws, contact & act.contact
    swings = ~contact & (act.lean <= 0)

    moving = 1.0 if v or turn else 0.0
    beat = 2 * np.pi * (t * rate + rng.uniform())
    slow = smooth_random(rng, t, 1.5, 8)
    bob = 0.008 * h * moving * np.cos(2 * beat) + 0.004 * h * slow[:, 0] * (2 - moving)
    yaw, roll = turn * t, 0.025 * moving * np.sin(beat) + 0.01 * slow[:, 1]
    pitch = 0.012 * moving * np.sin(2 * beat + 1.0) + 0.008 * slow[:, 2]
    pitch = pitch + act.pitch
    # Nose up while the hind feet are down; the back arched while all are in the air, and stretched half a stride later.
    arch = gait.bound * np.cos(2 * np.pi * (stride - 0.95))
    if gait.bound:
        pitch = pitch - 0.5 * gait.bound * np.cos(2 * np.pi * (stride - 0.2))
        bob = bob + 0.02 * h * np.cos(2 * np.pi * (stride - 0.95))
    bend = np.clip(0.35 * turn * p.trunk * h / max(v, 0.3), -0.5, 0.5) + 0.05 * moving * np.sin(beat + 0.7)
    one = np.ones_like(t)

    def pose(drop: float) -> dict[str, np.ndarray]:
        """Trunk joints (T, 3), and shoulders and hips, with the trunk lowered by `drop` m."""
        R = rot_zyx(yaw, pitch, roll)
        fore = R @ rot_zyx(bend / 2, arch, 0 * t)  # rear and fore halves bend about the middle of the spine
        aft = R @ rot_zyx(-bend / 2, -arch, 0 * t)
        x, y, z = (rest["spine_mid"] * one[:, None] + h * act.shift).T
        centre = np.concatenate([path.at(t, x, y), (z - drop + bob)[:, None]], 1)
        nod = 0.05 * moving * np.sin(2 * beat + 0.4) + 0.09 * slow[:, 3] + act.look - arch
        look = fore @ rot_zyx(0.5 * bend + 0.18 * slow[:, 4], nod, 0 * t)
        wag = aft @ rot_zyx(0.30 * slow[:, 5] + 0.12 * np.sin(beat), 0.15 * slow[:, 6] - act.pitch, 0 * t)
        out: dict[str, np.ndarray] = {"spine_mid": centre}

        def hang(name: str, parent: str, R: np.ndarray) -> None:
            out[name] = out[parent] + R @ (rest[name] - rest[parent])

        hang("withers", "spine_mid", fore)
        hang("pelvis", "spine_mid", aft)
        hang("tail_base", "pelvis", aft)
        hang("tail_tip", "tail_base", wag)
        hang("neck", "withers", look)
        hang("head", "neck", look)
        hang("nose", "head", look @ rot_zyx(0.15 * slow[:, 4], 0.05 * slow[:, 7], 0 * t))
        for side in ("left", "right"):
            hang(f"front_{side}_shoulder", "withers", fore)
            hang(f"hind_{side}_hip", "pelvis", aft)
        return out

    def legs(joints: dict[str, np.ndarray]) -> None:
        forward, up = np.stack([np.cos(yaw), np.sin(yaw), 0 * t], 1), np.array([0, 0, 1.0])
        for i, leg in enumerate(FEET):
            top, mid, low, paw = (f"{leg}_{n}" for n in LEG_JOINTS[leg.split("_")[0]])
            front = leg.startswith("front")
            r = rest[low] - rest[paw]
            length, tilt = np.linalg.norm(r), np.arctan2(-r[0], r[2])  # the last bone leans back by `tilt`
            ph = phase[:, i]
            stance, swing = np.clip(ph, 0, 1), np.clip(ph - 1, 0, 1)
            ease = swing**2 * (3 - 2 * swing)
            if front:  # the shoulder blade swings with the leg
                ahead = 0.035 * h * moving * np.where(ph <= 1, np.cos(np.pi * stance), 2 * ease - 1)
                joints[top] = joints[top] + ahead[:, None] * forward
            # The heel comes up at the end of the stance, the paw folds in swing and reaches out before touch-down.
            off = 0.55 if front else 0.65
            lean = tilt - moving * (
                off * np.clip((stance - 0.45) / 0.55, 0, 1) ** 2 - 0.18 * np.cos(np.pi * stance / 2)
            )
            lean = lean - moving * (1.0 if front else 0.45) * np.sin(np.pi * swing) ** 2 * (1 - 0.3 * swing)
            lean = lean + moving * ease * (off + 0.18) + act.lean[:, i]
            bone = length * (-np.sin(lean)[:, None] * forward + np.cos(lean)[:, None] * up)
            ab, bc = float(np.linalg.norm(rest[mid] - rest[top])), float(np.linalg.norm(rest[low] - rest[mid]))
            # A paw in the air is no nearer than the leg folds.
            d = paws[:, i] + bone - joints[top]
            n = np.linalg.norm(d, axis=1, keepdims=True)
            short = np.maximum(max(_FOLDED * (ab + bc), 1.05 * abs(ab - bc)) - n, 0)
            out = np.where(swings[:, i, None], short, 0) * d / n
            joints[paw] = paws[:, i] + out
            joints[low] = joints[paw] + bone
            joints[mid] = _two_bones(joints[top], joints[low], ab, bc, -forward if front else forward)
        joints["chest"] = (joints["front_left_shoulder"] + joints["front_right_shoulder"]) / 2

    # Lower the trunk by the least that lets every leg reach at every time, or raise it where legs do not fold as far.
    for drop in sorted(np.arange(-24, 51) * 0.005 * h, key=abs):
        joints = pose(drop)
        try:
            legs(joints)
        except ValueError:
            continue
        lateral = np.stack([-np.sin(yaw), np.cos(yaw), 0 * t], 1)
        return Motion(t, np.stack([joints[n] for n in KEYPOINTS], 1), contact, lateral)
    raise ValueError(f"this one's legs do not reach to {gait_name}" + (f" at {v:.2f} m/s" if v else ""))
