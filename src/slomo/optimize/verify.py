"""Checks a reference against the model's equations and limits. Shares no code with the solver: plain NumPy.

Every check is a number with a limit; `Check.holds` is a comparison. Forces, gaps and slips of step k are judged where
the step ends, at knot k + 1, which is where an implicit contact model applies its force.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain

Array = np.ndarray

LOADED = 1.0  # N, a point is in contact during a step when its normal force exceeds this


@dataclass(frozen=True)
class Check:
    """The worst value of one quantity, where it is, and what is allowed.

    Attributes:
        value, limit: in `unit`; the check holds when value <= limit.
        t: s, of the worst value.  point: which contact point or part.
    """

    value: float
    limit: float
    unit: str
    t: float
    point: str

    @property
    def holds(self) -> bool:
        return bool(self.value <= self.limit)


def _worst(values: Array, limit: float, unit: str, t: Array, points: tuple[str, ...]) -> Check:
    """The largest of values (len(t), len(points)); a value that is not a number is the worst."""
    x = np.where(np.isfinite(values), values, np.inf)
    k, c = np.unravel_index(int(np.argmax(x)), x.shape)
    return Check(float(x[k, c]), limit, unit, float(t[k]), points[c])


def verify(
    model: PointFootModel, reference: Reference, *, terrain: Terrain, robot: Robot | None = None
) -> dict[str, Check]:
    """All checks by name; the reference is verified when every one holds.

    dynamics_residual: defect of one semi-implicit step, in m, rad, m/s and rad/s alike.
    complementarity: gap times normal force, N m.  penetration: m.
    friction_violation: N, tangential force beyond the cone.  pull: N, negative normal force.
    slip_per_second: horizontal path of all points together while they are loaded (normal force over 1 N), m per s.
    input_ratio: |u| / u_max.  leg_length: m beyond the limits.
    torque_ratio: |J^T u| / limit of the joints (with a robot).
    """
    r, names = reference, model.names
    body = _dynamics(model, r)
    t1 = r.t[1:]
    gap = r.points[..., 2] - terrain.height(r.points)
    normal, tangent = r.lam[..., 2], np.linalg.norm(r.lam[..., :2], axis=2)
    path = np.linalg.norm(np.diff(r.points[..., :2], axis=0), axis=2) * (normal > LOADED)
    fastest = np.unravel_index(int(np.argmax(path)), path.shape)
    R = Rotation.from_quat(r.q[:, 3:7])
    hips = r.q[:, None, :3] + np.stack([R.apply(h) for h in model.hips], axis=1)
    leg = np.linalg.norm(hips - r.points, axis=2)
    ratio = np.abs(r.u.reshape(-1, model.C, 3)) / model.u_max
    checks = {
        "dynamics_residual": _worst(body, 1e-6, "", t1, ("body position", "body rotation", "body velocity", *names)),
        "complementarity": _worst(np.abs(gap[1:] * normal), 1e-4, "N m", t1, names),
        "penetration": _worst(np.maximum(-gap, 0.0), 1e-3, "m", r.t, names),
        "friction_violation": _worst(np.maximum(tangent - model.mu * normal, 0.0), 1e-6, "N", t1, names),
        "pull": _worst(np.maximum(-normal, 0.0), 1e-9, "N", t1, names),
        "slip_per_second": Check(
            float(path.sum() / (r.t[-1] - r.t[0])), 0.02, "m/s", float(t1[fastest[0]]), names[fastest[1]]
        ),
        "input_ratio": _worst(ratio.max(axis=2), 1.0 + 1e-9, "", r.t[:-1], names),
        "leg_length": _worst(np.maximum(leg - model.leg_max, model.leg_min - leg).clip(0.0), 1e-4, "m", r.t, names),
    }
    if robot is not None:
        ratio, _ = joint_torque_ratio(robot, r)
        checks["torque_ratio"] = _worst(ratio, 1.0, "", r.t[:-1], robot.joint_names)
    return checks


def _dynamics(model: PointFootModel, r: Reference) -> Array:
    """(T - 1, 3 + C) defects: body position, rotation and velocities, and each point."""
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
        ]
    )


def joint_torque_ratio(robot: Robot, reference: Reference) -> tuple[Array, Array]:
    """Quasi-static joint torques |J^T u| over their limits (T - 1, nj), and the distance (T - 1, C) m by which inverse
    kinematics within the joint limits misses the feet."""
    model, data = robot.model, robot.model.createData()
    feet = [model.getFrameId(name) for name in robot.foot_names]
    root_base = robot_base_in_root(robot)
    q = robot.q_nominal.copy()
    ratio = np.zeros((len(reference.u), len(robot.effort)))
    miss = np.zeros((len(reference.u), len(feet)))
    for k, u in enumerate(reference.u.reshape(len(reference.u), -1, 3)):
        x = reference.q[k]
        T = pin.SE3(Rotation.from_quat(x[3:7]).as_matrix(), x[:3]) * root_base.inverse()
        q[:7] = pin.SE3ToXYZQUAT(T)
        for _ in range(30):
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacements(model, data)
            errors = np.array([p - data.oMf[f].translation for p, f in zip(reference.points[k], feet, strict=True)])
            J = np.concatenate(
                [pin.getFrameJacobian(model, data, f, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3, 6:] for f in feet]
            )
            miss[k] = np.linalg.norm(errors, axis=1)
            if miss[k].max() < 1e-6:
                break
            dq = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(len(J)), errors.ravel())
            q[7:] = np.clip(q[7:] + np.clip(dq, -0.3, 0.3), robot.lower, robot.upper)
        ratio[k] = np.abs(J.T @ u.ravel()) / robot.effort
    return ratio, miss


def robot_base_in_root(robot: Robot) -> pin.SE3:
    """Placement of the base frame in the free-flyer's frame."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.q_nominal)
    return data.oMi[1].inverse() * data.oMf[robot.model.getFrameId(robot.base)]
