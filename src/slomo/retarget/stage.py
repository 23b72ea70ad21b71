"""Retarget: a creature's key points to the robot's `base`, hips and contact points, in the robot's size.

The paper (Zhang et al., RA-L 2023) scales and offsets by hand. Here everything is decided from the key points and the
robot's kinematics, and said in report.json. All lengths are scaled by one factor, the robot's leg over the creature's,
so that Froude numbers, and with them the character of the gait, change as little as one factor allows; a person's arms
have one of their own.
"""

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import ground, human, place, prepare, quadruped
from slomo.retarget.feet import slow_motion
from slomo.retarget.footprint import make_terrain, on_step, start_at_origin
from slomo.retarget.soles import RobotBody
from slomo.robot import Robot
from slomo.stage import Artifact, Inputs, Progress, Silent
from slomo.terrain import Terrain

VERSION = 6


@dataclass(frozen=True)
class Config:
    """Parameters of `slomo retarget`.

    Attributes:
        start: s, what comes before is left out.  end: s, what comes after is left out (0: until the last frame).
        rate: Hz of the result.
        body_cutoff, foot_cutoff: Hz of the smoothing of trunk and of feet and hands.
        scale: robot over creature; 0 takes the ratio of their legs.
        level: remove the mean roll and pitch that differently placed key points give (up to 0.35 rad).
        max_turn_rate: rad/s; faster turns are reconstruction errors, and the longest part without one is used.
        step_height: m, height of a step under the feet of `step_limbs`; below 0 a step down.
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

    def __post_init__(self):
        for name in ("rate", "body_cutoff", "foot_cutoff", "max_turn_rate"):
            if not getattr(self, name) > 0:
                raise UsageError(f"needs a number above 0, got {getattr(self, name)}", where=f"retarget.{name}")
        for name in ("start", "end", "scale"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"needs a number of at least 0, got {getattr(self, name)}", where=f"retarget.{name}")


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """Key points of the creature to `keypoints.npz` (base, hips, points), `terrain.json` and `report.json`.

    Raises:
        UsageError: a step under unknown limbs or beside a terrain file, or a part outside the motion.
        InvalidData: too little usable motion, key points that do not span a trunk, a person for a quadruped or an
            animal for a humanoid.
    """
    robot = inputs.robot
    assert robot is not None
    given = Terrain.load(inputs.files["terrain"]) if "terrain" in inputs.files else None
    if given is not None and config.step_height:
        raise UsageError("both a terrain file and a step are given", where="retarget.step_height", todo="set it to 0")
    source = KeypointMotion.from_arrays(next(iter(inputs.artifacts.values())).npz["keypoints.npz"])
    kind = _kind(source, robot)
    body = RobotBody.of(robot)
    stepping = on_step(body, config.step_limbs, robot.limb_names) if config.step_height else np.zeros(0, bool)
    report: dict[str, Any] = {"robot": robot.name, "subject": "animal" if kind is quadruped else "person"}

    dt = 1 / config.rate
    motion, subject, walk = _on_the_ground(source, kind, body, config, stepping, report, progress)
    if subject.fixed and (slower := slow_motion(walk.standing[:, walk.known], dt=dt)) > 1:
        progress.note(f"no jump lasts as long as both feet are in the air here: played {slower:.1f} times as fast")
        source = replace(source, t=source.t[0] + (source.t - source.t[0]) / slower)
        config = replace(config, start=config.start / slower, end=config.end / slower)
        motion, subject, walk = _on_the_ground(source, kind, body, config, stepping, report, Silent())
        report["played_faster"] = slower
    paths, trunk = start_at_origin(walk.paths, walk.trunk, body)
    progress.update(0.7, "terrain")
    if given is not None:
        terrain = given
        progress.note(f"the ground is that of {inputs.files['terrain'].name}, in the frame in which the motion starts")
    else:
        terrain = make_terrain(paths.soles, stepping, height=config.step_height)
    under = terrain.height(paths.soles)
    made = place.placed(walk, paths, trunk, subject, under, robot, body, dt=dt)
    if body.hands:
        _report_hands(subject, body, robot, report, progress)
    names = ("base", *(f"{n}_hip" for n in robot.limb_names), *robot.key_points)
    result = KeypointMotion(
        t=motion.t - motion.t[0],
        positions=np.concatenate([made.base[:, None], made.hips, made.points], axis=1),
        names=names,
        confidence=np.concatenate([np.ones((len(under), 1 + len(robot.limbs))), made.confidence], axis=1),
        contact=made.standing.astype(float),
        contact_names=robot.key_points,
    )
    report |= {
        "heading_change_rad": float(trunk.heading[-1] - trunk.heading[0]),
        "distance_m": float(np.linalg.norm(np.diff(paths.body, axis=0), axis=1).sum()),
        "stance_fraction": dict(zip(body.soles, walk.standing.mean(axis=0).round(3).tolist(), strict=True)),
        "body_moved_for_reach_m": made.moved,
        "swings_drawn_fraction": float(made.drawn.mean()),
        "beyond_reach_fraction": float(made.beyond.mean()),
        "unseen_limbs": [n for n, u in zip(body.soles, ~walk.known, strict=True) if u],
        "terrain_boxes": len(terrain.boxes),
    }
    if report["unseen_limbs"]:
        progress.note(f"never seen, so kept under the hip: {', '.join(report['unseen_limbs'])}")
    progress.note(
        f"{robot.name}: scale {report['scale']:.3g}, {result.t[-1]:.2f} s, {report['distance_m']:.2f} m, "
        f"turns {np.degrees(report['heading_change_rad']):+.0f} degrees"
    )
    return Artifact(
        npz={"keypoints.npz": result.to_arrays()}, json={"terrain.json": terrain.to_json(), "report.json": report}
    )


def _on_the_ground(
    source: KeypointMotion,
    kind: ModuleType,
    body: RobotBody,
    config: Config,
    stepping: np.ndarray,
    report: dict[str, Any],
    progress: Progress,
) -> tuple[KeypointMotion, Any, ground.Walk]:
    """The usable part of the key points, what they say of the creature, and its soles on the ground."""
    motion = prepare.prepare(source, kind.trunk_of, kind.PAIRS, config, report, progress)
    progress.update(0.3, "smoothing")
    quick = {n for limb in kind.LIMBS for n in kind.ends(limb)}
    subject = kind.read(prepare.smoothed(motion, quick, config))
    for line in subject.said:
        progress.note(line)
    return motion, subject, ground.grounded(subject, body, config, stepping, report, progress)


def _kind(source: KeypointMotion, robot: Robot) -> ModuleType:
    """The module that reads this creature. Raises `InvalidData` naming the key point that is missing."""
    kind, other = (quadruped, human) if robot.kind == "quadruped" else (human, quadruped)
    missing = [limb for limb in kind.LIMBS if kind.ends(limb)[0] not in source.names]
    if missing:
        fits_other = all(other.ends(limb)[0] in source.names for limb in other.LIMBS)
        todo = (
            "a person's motion needs a humanoid robot" if kind is quadruped else "an animal's motion needs a quadruped"
        )
        needed = ", ".join(kind.ends(limb)[0] for limb in kind.LIMBS)
        raise InvalidData(
            f"no key point {kind.ends(missing[0])[0]!r}, which {robot.name} needs for its {missing[0]} limb "
            f"(it has: {', '.join(source.names)}; needed: {needed})",
            where="key points", todo=todo if fits_other else "",
        )  # fmt: skip
    if not any(np.any(source.confidence[:, source.index(kind.ends(limb)[0])] > 0) for limb in kind.LIMBS):
        raise InvalidData(
            "no foot has any confidence", where="key points", valid=[kind.ends(limb)[0] for limb in kind.LIMBS]
        )
    return kind


def _report_hands(subject: Any, body: RobotBody, robot: Robot, report: dict[str, Any], progress: Progress) -> None:
    """Say how arms are scaled, and which hand was never seen."""
    if subject.hands is None:
        report["unseen_hands"] = ["left", "right"]
    else:
        known = np.any(subject.hands.confidence > 0, axis=0)
        report["unseen_hands"] = [s for s, k in zip(body.soles, known, strict=True) if not k]
        arm = float(robot.leg_reach[list(body.hands), 1].mean())
        report["arm_scale"] = arm / subject.hands.arm
        progress.note(f"arms are scaled by {report['arm_scale']:.3g}, body and legs by {report['scale']:.3g}")
    if report["unseen_hands"]:
        progress.note(f"never seen, so hanging: {' and '.join(report['unseen_hands'])} hand")
