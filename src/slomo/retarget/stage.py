"""Retarget: a creature's key points to the robot's `base`, hips and feet, in the robot's size.

The paper (Zhang et al., RA-L 2023) scales and offsets by hand. Here everything is decided from the key points and the
robot's kinematics, and said in report.json. All lengths are scaled by one factor, the robot's standing height over the
creature's, so that Froude numbers, and with them the character of the gait, change as little as one factor allows.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import clean, feet
from slomo.retarget.footprint import footprint, make_terrain, start_at_origin
from slomo.retarget.trunk import Trunk, trunk_frame
from slomo.robot import Robot
from slomo.stage import Artifact, Inputs, Progress

VERSION = 4


@dataclass(frozen=True)
class Config:
    """Parameters of `slomo retarget`.

    Attributes:
        start: s, what comes before is left out.  end: s, what comes after is left out (0: until the last frame).
        rate: Hz of the result.
        body_cutoff, foot_cutoff: Hz of the smoothing of trunk and paws.
        scale: robot over creature; 0 takes the ratio of standing heights.
        level: remove the mean roll and pitch that differently placed key points give (at most 0.35 rad).
        max_turn_rate: rad/s; faster turns are reconstruction errors, and the longest part without one is used.
        step_height: m, height of a step under the feet of `step_limbs`.
        step_limbs: limbs that stand on the step.
    """

    start: float = 0.0
    end: float = 0.0
    rate: float = 50.0
    body_cutoff: float = 3.0
    foot_cutoff: float = 6.0
    scale: float = 0.0
    level: bool = True
    max_turn_rate: float = 6.0
    step_height: float = 0.0
    step_limbs: tuple[str, ...] = ("front_left", "front_right")


_MAX_LEVEL = 0.35  # rad, key points misplaced by more than this are a posture, not a misplacement
_MAX_TILT = 0.6  # rad, roll and pitch that a legged robot can follow
_CLEARANCE = 0.10  # of the standing height: a foot lifted more than this swings
_SHORTEST = 0.08  # s, shorter stances and swings are noise
_CREEP = 0.25  # of the standing height: a standing foot that creeps further takes a step
_MARGIN = 0.15  # s, left out beside an impossible turn
_STEP = 0.24  # s, duration of such a step


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """Key points of the creature to `keypoints.npz` (base, hips, feet), `terrain.json` and `report.json`.

    Raises:
        UsageError: no four-legged robot, or a step under unknown limbs.
        InvalidData: too little usable motion, or key points that do not span a trunk.
    """
    robot = inputs.robot
    assert robot is not None
    if robot.kind != "quadruped":
        raise UsageError(f"retargeting to a {robot.kind} is not there yet", where=robot.name, valid=("quadrupeds",))
    source = KeypointMotion.from_arrays(next(iter(inputs.artifacts.values())).npz["keypoints.npz"])
    paws = _paw_names(source, robot)
    report: dict[str, Any] = {"robot": robot.name}

    motion = _prepare(source, config, report, progress)
    progress.update(0.3, "smoothing")
    motion = _smooth(motion, paws, config)
    trunk = trunk_frame(motion)
    paw_columns = [motion.index(n) for n in paws]
    confidence = motion.confidence[:, paw_columns]
    if np.all(confidence == 0):
        raise InvalidData("no foot has any confidence", where="key points", valid=paws)

    dt = 1 / config.rate
    heights = motion.positions[:, paw_columns, 2]
    lift, ground = feet.lifts(
        heights,
        _pairs(robot),
        dt=dt,
        window=0.6,
        most=0.3 * float(np.median(trunk.origin[:, 2] - heights.mean(axis=1))),
    )
    rise = trunk.origin[:, 2] - ground
    height = float(np.median(rise))
    if height <= 0:
        raise InvalidData("the trunk lies below the feet", where="key points", todo="check that z points up")
    scale = config.scale or robot.standing_height / height
    xy, lift, base_xy = scale * motion.positions[:, paw_columns, :2], scale * lift, scale * trunk.origin[:, :2]
    clearance = _CLEARANCE * robot.standing_height

    low = np.exp(-((lift / clearance) ** 2)) * (confidence > 0)
    drift = feet.slide(xy, low, dt=dt, smoothing=0.15)
    standing = _standing(motion, paws, xy - drift[:, None], lift, clearance=clearance, dt=dt)
    drift = drift + feet.slide(xy - drift[:, None], standing.astype(float), dt=dt, smoothing=0.1)
    xy, base_xy = xy - drift[:, None], base_xy - drift
    trunk, report["leveled_rad"] = _level(trunk, config, robot)
    xy, base_xy, stride = footprint(xy, base_xy, trunk.yaw, standing, robot)
    creep = _CREEP * robot.standing_height
    standing = np.stack(
        [
            feet.split(p, on, dt=dt, tolerance=creep, step=_STEP)
            for p, on in zip(xy.swapaxes(0, 1), standing.T, strict=True)
        ],
        axis=1,
    )
    xy = np.stack([feet.anchor(xy[:, f], standing[:, f]) for f in range(len(paws))], axis=1)
    xy, base_xy, trunk = start_at_origin(xy, base_xy, trunk)
    progress.update(0.7, "terrain")
    terrain = make_terrain(xy, robot, step_height=config.step_height, step_limbs=config.step_limbs)
    under = terrain.height(xy)
    lift = np.stack([feet.clear(z, on, least=clearance) for z, on in zip(lift.T, standing.T, strict=True)], axis=1)
    bounce = scale * (rise - height)
    bounce = np.clip(bounce, -0.4 * robot.standing_height, 0.1 * robot.standing_height)
    base = np.column_stack([base_xy, robot.standing_height + bounce + under.mean(axis=1)])
    hips = base[:, None] + np.einsum("tij,cj->tci", trunk.rotation().as_matrix(), robot.nominal_hips)
    soles = np.concatenate([xy, (under + lift)[..., None]], axis=2)
    # A limb that was never seen stays under its hip, and says so by confidence 0.
    unseen = np.all(confidence == 0, axis=0)
    soles[:, unseen] = np.concatenate([hips[:, unseen, :2], under[:, unseen, None]], axis=2)

    result = _motion(motion.t, base, hips, soles, confidence, standing, robot)
    reach = np.linalg.norm(soles - hips, axis=2)
    report |= {
        "scale": scale,
        "standing_height_source": height,
        "stride_scale": stride,
        "heading_change_rad": float(trunk.yaw[-1] - trunk.yaw[0]),
        "distance_m": float(np.linalg.norm(np.diff(base_xy, axis=0), axis=1).sum()),
        "slide_removed_m": float(np.linalg.norm(np.diff(drift, axis=0), axis=1).sum()),
        "stance_fraction": dict(zip(robot.limb_names, standing.mean(axis=0).round(3).tolist(), strict=True)),
        "beyond_reach_fraction": float(np.mean((reach > robot.leg_reach[:, 1]) | (reach < robot.leg_reach[:, 0]))),
        "unseen_limbs": [n for n, u in zip(robot.limb_names, unseen, strict=True) if u],
        "terrain_boxes": len(terrain.boxes),
    }
    progress.note(
        f"{robot.name}: scale {scale:.3f}, {result.t[-1] - result.t[0]:.2f} s, {report['distance_m']:.2f} m, "
        f"turns {np.degrees(report['heading_change_rad']):+.0f} degrees"
    )
    return Artifact(
        npz={"keypoints.npz": result.to_arrays()}, json={"terrain.json": terrain.to_json(), "report.json": report}
    )


def _paw_names(source: KeypointMotion, robot: Robot) -> list[str]:
    paws = [f"{limb}_paw" for limb in robot.limb_names]
    missing = [n for n in paws if n not in source.names]
    if missing:
        raise InvalidData(
            f"no key point {missing[0]!r}, which {robot.name} needs for its {missing[0].removesuffix('_paw')} limb",
            where="key points",
            valid=source.names,
            todo="a person's motion needs a humanoid robot",
        )
    return paws


def _pairs(robot: Robot) -> tuple[tuple[int, ...], ...]:
    """Columns of the front and of the hind feet."""
    x = robot.nominal_hips[:, 0]
    return tuple(np.flatnonzero(x > x.mean()).tolist()), tuple(np.flatnonzero(x <= x.mean()).tolist())


def _prepare(source: KeypointMotion, config: Config, report: dict[str, Any], progress: Progress) -> KeypointMotion:
    """Uniform grid, the wanted and the usable part, spikes marked."""
    end = config.end or source.t[-1]
    if not source.t[0] <= config.start < end:
        raise UsageError(
            f"start {config.start} s and end {end} s leave nothing of {source.t[0]:.2f} to {source.t[-1]:.2f} s",
            where="retarget",
        )
    wanted = (source.t >= config.start) & (source.t <= end)
    if wanted.sum() < 8:
        raise InvalidData(f"only {wanted.sum()} frames between {config.start} and {end} s", where="key points")
    motion = clean.resample(clean.cut(source, clean.longest_run(wanted)), config.rate)
    size = float(np.median(np.ptp(motion.positions, axis=1).max(axis=1)))
    motion = clean.despike(motion, size=0.25 * size, window=0.5)
    report["untrusted_samples"] = int((motion.confidence == 0).sum())
    turning = np.abs(np.gradient(trunk_frame(motion).yaw, 1 / config.rate))
    # What surrounds such a turn is bad too.
    n = round(_MARGIN * config.rate)
    keep = clean.longest_run(np.logical_not(binary_dilation(turning > config.max_turn_rate, iterations=n)))
    if keep.stop - keep.start < 0.5 * config.rate:
        raise InvalidData(
            f"no half second without turns faster than {config.max_turn_rate} rad/s", where="key points",
            todo="choose a part with --set retarget.start=... and retarget.end=...",
        )  # fmt: skip
    kept = clean.cut(motion, keep)
    report["used_s"] = [float(kept.t[0]), float(kept.t[-1])]
    if keep.stop - keep.start < len(motion.t):
        progress.note(
            f"turns faster than {config.max_turn_rate} rad/s are not real: using {kept.t[0]:.2f} to {kept.t[-1]:.2f} s"
        )
    return kept


def _smooth(motion: KeypointMotion, paws: list[str], config: Config) -> KeypointMotion:
    positions = np.stack(
        [
            clean.smooth(
                motion.positions[:, i], motion.confidence[:, i], dt=1 / config.rate,
                cutoff=config.foot_cutoff if n in paws else config.body_cutoff,
            )
            for i, n in enumerate(motion.names)
        ],
        axis=1,
    )  # fmt: skip
    return KeypointMotion(
        t=motion.t, positions=positions, names=motion.names, confidence=motion.confidence,
        contact=motion.contact, contact_names=motion.contact_names,
    )  # fmt: skip


def _standing(
    motion: KeypointMotion, paws: list[str], xy: np.ndarray, lift: np.ndarray, *, clearance: float, dt: float
) -> np.ndarray:
    """(T, F) bool: the given contact probabilities where there are any, else low and slow feet."""
    speed = np.linalg.norm(np.gradient(xy, dt, axis=0), axis=2)
    standing = feet.stance(lift, speed, dt=dt, clearance=clearance, shortest=_SHORTEST)
    if motion.contact is not None:
        for f, name in enumerate(paws):
            if name in motion.contact_names:
                standing[:, f] = motion.contact[:, motion.contact_names.index(name)] > 0.5
    return feet.settled(standing, dt=dt, shortest=_SHORTEST)


def _level(trunk: Trunk, config: Config, robot: Robot) -> tuple[Trunk, list[float]]:
    """Roll and pitch about zero, or about the slope of the step, and within what a robot can follow."""
    front = [n in config.step_limbs for n in robot.limb_names]
    x = robot.nominal_hips[:, 0]
    rise = config.step_height * np.array(front, float)
    slope = -np.arctan(np.polyfit(x, rise, 1)[0])
    bias = np.zeros(2)
    if config.level:
        bias = np.clip([np.median(trunk.roll), np.median(trunk.pitch) - slope], -_MAX_LEVEL, _MAX_LEVEL)
    return Trunk(
        origin=trunk.origin,
        yaw=trunk.yaw,
        pitch=np.clip(trunk.pitch - bias[1], -_MAX_TILT, _MAX_TILT),
        roll=np.clip(trunk.roll - bias[0], -_MAX_TILT, _MAX_TILT),
    ), bias.tolist()


def _motion(
    t: np.ndarray,
    base: np.ndarray,
    hips: np.ndarray,
    soles: np.ndarray,
    confidence: np.ndarray,
    standing: np.ndarray,
    robot: Robot,
) -> KeypointMotion:
    names = ("base", *(f"{n}_hip" for n in robot.limb_names), *(f"{n}_foot" for n in robot.limb_names))
    trusted = np.ones((len(t), 1 + hips.shape[1]))
    return KeypointMotion(
        t=t - t[0],
        positions=np.concatenate([base[:, None], hips, soles], axis=1),
        names=names,
        confidence=np.concatenate([trusted, confidence], axis=1),
        contact=standing.astype(float),
        contact_names=tuple(f"{n}_foot" for n in robot.limb_names),
    )
