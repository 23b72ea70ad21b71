"""Checks a reference against the model's equations and limits. Shares no code with the solver: plain NumPy.

Every check is a number with a limit, a place and a time; docs/verify.md says why each limit is what it is.
"""

from typing import Protocol

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.optimize.check import Check, worst
from slomo.optimize.inverse import JointMotion, joint_motion
from slomo.optimize.verify_ground import ground_checks
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain

Array = np.ndarray

BODY_ERROR, FOOT_ERROR = 0.015, 0.025  # m, means that a robot of a dog's size should keep


class Wanted(Protocol):
    """What was asked for: `problem.Targets`, or anything with the same of its attributes.

    Attributes:
        q: (T, 7 + 3 C), laid out as in `motion.Reference`.
        body_confidence: (T,).  foot_confidence: (T, C).  points: (T, C, 3) m.
    """

    @property
    def q(self) -> Array: ...

    @property
    def points(self) -> Array: ...

    @property
    def body_confidence(self) -> Array: ...

    @property
    def foot_confidence(self) -> Array: ...


def verify(
    model: PointFootModel,
    reference: Reference,
    *,
    terrain: Terrain,
    robot: Robot | None = None,
    joints: JointMotion | None = None,
    want: Wanted | None = None,
) -> dict[str, Check]:
    """All checks by name; the reference is verified when every one `holds`.

    dynamics_residual: defect of one semi-implicit step, in m, rad, m/s and rad/s alike, and s of the time axis.
    Those of `ground_checks`.
    input_ratio: |u| / u_max.  leg_length: m beyond the limits.  pair_distance: m, toe to heel, off their distance.
    body_clearance: m by which a point comes too near to the body.  cycle_gap: m, rad, m/s and rad/s by which a motion
    that is to repeat for ever does not close.
    With a robot, those of `joint_checks`, from its `joint_motion` unless that is given as `joints`.  With what was
    wanted, `body_error` and `foot_error` (warnings): m, mean.
    """
    r, names = reference, model.names
    parts = ("body position", "body rotation", "body velocity", *names, "time")
    R = Rotation.from_quat(r.q[:, 3:7])
    hips = r.q[:, None, :3] + np.stack([R.apply(h) for h in model.leg_roots], axis=1)
    leg = np.linalg.norm(hips - r.points, axis=2)
    ratio = np.abs(r.u.reshape(-1, model.C, 3)) / model.u_max
    checks = {"dynamics_residual": worst(dynamics_defect(model, r), 1e-6, "", r.t[1:], parts)}
    checks |= ground_checks(r.t, r.points, r.lam, terrain=terrain, mu=model.mu, names=names)
    checks["input_ratio"] = worst(ratio.max(axis=2), 1.0 + 1e-9, "", r.t[:-1], names)
    checks["leg_length"] = worst(np.maximum(leg - model.leg_max, model.leg_min - leg).clip(0.0), 1e-4, "m", r.t, names)
    if len(model.pairs):
        a, b = model.pairs.T
        off = np.abs(np.linalg.norm(r.points[:, a] - r.points[:, b], axis=2) - model.pair_length)
        checks["pair_distance"] = worst(off, 1e-3, "m", r.t, tuple(f"{names[i]} to {names[j]}" for i, j in model.pairs))
    if np.any(np.isfinite(model.clearance)):
        below = -np.einsum("tji,tcj->tci", R.as_matrix(), r.points - r.q[:, None, :3])[..., 2]
        checks["body_clearance"] = worst(np.maximum(model.clearance - below, 0.0), 1e-3, "m", r.t, names)
    if len(r.cycle):
        parts = ("body position", "body rotation", "body velocity", *names)
        checks["cycle_gap"] = worst(cycle_gap(r), 1e-6, "", r.t[-1:], parts)
    if robot is not None:
        checks |= joint_checks(robot, r, joints or joint_motion(robot, r))
    if want is not None:
        checks |= tracking_checks(r, want, names)
    return checks


def dynamics_defect(model: PointFootModel, r: Reference) -> Array:
    """(T - 1, 4 + C) defects of the steps: body position, rotation and velocities, each point, and the time axis."""
    C, h = model.C, r.h[:, None]
    q, v, q1, v1 = r.q[:-1], r.v[:-1], r.q[1:], r.v[1:]
    u = r.u.reshape(-1, C, 3)
    weight = np.array([0.0, 0.0, -model.g])
    R, R1 = Rotation.from_quat(q[:, 3:7]), Rotation.from_quat(q1[:, 3:7])
    acceleration = u.sum(axis=1) / model.mass + weight
    torque = np.cross(r.points[:-1] - q[:, None, :3], u).sum(axis=1)
    w = v[:, 3:6]
    spin = np.linalg.solve(model.inertia, (R.inv().apply(torque) - np.cross(w, w @ model.inertia.T)).T).T
    points = (r.lam - u) / model.foot_mass[:, None] + weight
    turn = (R * Rotation.from_rotvec(h * v1[:, 3:6])).inv() * R1
    dv = np.abs(v1 - v - h * np.concatenate([acceleration, spin, points.reshape(len(u), -1)], axis=1))
    dq = np.abs(q1[:, 7:] - q[:, 7:] - h * v1[:, 6:])
    return np.column_stack(
        [
            np.abs(q1[:, :3] - q[:, :3] - h * v1[:, :3]).max(axis=1),
            np.maximum(turn.magnitude(), np.abs(np.linalg.norm(q1[:, 3:7], axis=1) - 1)),
            dv[:, :6].max(axis=1),
            np.maximum(dv[:, 6:], dq).reshape(len(u), C, 3).max(axis=2),
            np.abs(np.diff(r.t) - r.h),
        ]
    )


def cycle_gap(r: Reference) -> Array:
    """(1, 3 + C) how far the last state is from the first one, turned about z and moved by `Reference.cycle`: body
    position, rotation and velocities, and each point with its velocity."""
    turn = Rotation.from_euler("z", r.cycle[3])
    place = turn.apply(np.vstack([r.q[0, :3], r.points[0]])) + r.cycle[:3]
    speed = turn.apply(np.vstack([r.v[0, :3], r.v[0, 6:].reshape(-1, 3)]))
    off = np.abs(np.vstack([r.q[-1, :3], r.points[-1]]) - place).max(axis=1)
    off_speed = np.abs(np.vstack([r.v[-1, :3], r.v[-1, 6:].reshape(-1, 3)]) - speed).max(axis=1)
    rotation = (turn * Rotation.from_quat(r.q[0, 3:7])).inv() * Rotation.from_quat(r.q[-1, 3:7])
    spin = np.abs(r.v[-1, 3:6] - r.v[0, 3:6]).max()
    body = [off[0], rotation.magnitude(), max(off_speed[0], spin)]
    return np.concatenate([body, np.maximum(off, off_speed)[1:]])[None]


def joint_checks(robot: Robot, reference: Reference, motion: JointMotion) -> dict[str, Check]:
    """The whole robot's limits along a reference.

    torque_ratio: |inverse dynamics' torque| over the effort limit.  speed_ratio: |joint velocity| over its limit.
    joint_miss: m by which inverse kinematics within the joints' limits misses a point.
    torque_ratio_static (a warning): |J^T u| alone over the effort limit.
    """
    r, names = reference, robot.joint_names
    return {
        "torque_ratio": worst(np.abs(motion.tau) / robot.effort, 1.0, "", r.t[:-1], names),
        "speed_ratio": worst(np.abs(motion.v[:, 6:]) / robot.velocity, 1.0, "", r.t, names),
        "torque_ratio_static": worst(
            np.abs(motion.tau_static) / robot.effort, 1.0, "", r.t[:-1], names, required=False
        ),
        "joint_miss": worst(motion.miss, 5e-3, "m", r.t, robot.limb_names),
    }


def tracking_checks(reference: Reference, want: Wanted, names: tuple[str, ...]) -> dict[str, Check]:
    """Warnings: mean distances from what was wanted, weighted by confidence; the place is the largest single one."""
    body, feet = tracking_errors(reference, want)
    at_body = worst(body[:, None], 0.0, "m", reference.t, ("body",))
    at_feet = worst(np.where(want.foot_confidence > 0, feet, 0.0), 0.0, "m", reference.t, names)
    mean = [_mean(body, want.body_confidence), _mean(feet, want.foot_confidence)]
    return {
        "body_error": Check(mean[0], BODY_ERROR, "m", at_body.t, "body", required=False),
        "foot_error": Check(mean[1], FOOT_ERROR, "m", at_feet.t, at_feet.point, required=False),
    }


def tracking_errors(reference: Reference, want: Wanted) -> tuple[Array, Array]:
    """Distances (T,) of the body and (T, C) of the points from where they were wanted, m."""
    body = np.linalg.norm(reference.q[:, :3] - want.q[:, :3], axis=1)
    return body, np.linalg.norm(reference.points - want.points, axis=2)


def tracking_table(reference: Reference, want: Wanted, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Key point -> `mean` and `max` (m) and the time `t` (s) of the largest; where nothing was known, all 0."""
    body, feet = tracking_errors(reference, want)
    columns = {"body": (body, want.body_confidence)}
    columns |= {n: (feet[:, c], want.foot_confidence[:, c]) for c, n in enumerate(names)}
    out = {}
    for name, (distance, confidence) in columns.items():
        seen = np.where(confidence > 0, distance, 0.0)
        k = int(np.argmax(seen))
        out[name] = {"mean": _mean(distance, confidence), "max": float(seen[k]), "t": float(reference.t[k])}
    return out


def _mean(distance: Array, confidence: Array) -> float:
    return float(np.sum(confidence * distance) / max(np.sum(confidence), 1e-12))


def robot_base_in_root(robot: Robot) -> pin.SE3:
    """Placement of the base frame in the free-flyer's frame."""
    return robot.model.frames[robot.model.getFrameId(robot.base)].placement
