"""Checks a whole-body motion against the URDF's dynamics and limits, and shows it as a point-foot reference.

Shares no equations with the solver: where that asks the inverse dynamics for what is missing, this integrates the
forward dynamics M(q) a + b(q, v) = S^T tau + J^T lam, with Pinocchio's own spatial velocities, and compares with the
next knot.
"""

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.motion import Reference, WholeBody
from slomo.optimize.check import Check, worst
from slomo.optimize.verify_ground import ground_checks
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain

Array = np.ndarray

_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def verify_whole_body(robot: Robot, motion: WholeBody, *, terrain: Terrain, mu: float) -> dict[str, Check]:
    """All checks by name, as of `verify`; the motion is verified when every one `holds`.

    dynamics_residual: defect of one semi-implicit step by forward dynamics, in m, rad, m/s and rad/s alike, and s of
        the time axis.
    Those of `ground_checks`, at the contact frames by forward kinematics.
    torque_ratio, speed_ratio: |joint torque|, |joint velocity| over the URDF's limits.
    joint_range: rad beyond a joint's range.  cycle_gap: m, rad, m/s and rad/s by which the ends of a cycle do not meet.

    Raises:
        InvalidData: the motion was made for another robot.
    """
    m, joints = motion, robot.joint_names
    if m.robot_digest != robot.digest:
        raise InvalidData(
            "was made for another robot, or for an earlier state of its files", where=f"robot {robot.name}"
        )
    parts = ("root position", "root rotation", "root velocity", *joints, "time")
    data = robot.model.createData()
    points = np.array([_points(robot, data, q) for q in m.q])
    s = m.q[:, 7:]
    checks = {
        "dynamics_residual": worst(_defect(robot, m), 1e-6, "", m.t[1:], parts),
        **ground_checks(m.t, points, m.lam, terrain=terrain, mu=mu, names=robot.limb_names),
        "torque_ratio": worst(np.abs(m.tau) / robot.effort, 1.0, "", m.t[:-1], joints),
        "speed_ratio": worst(np.abs(m.v[1:, 6:]) / robot.velocity, 1.0, "", m.t[1:], joints),
        "joint_range": worst(np.maximum(s - robot.upper, robot.lower - s).clip(0.0), 1e-6, "rad", m.t, joints),
    }
    if len(m.cycle):
        checks["cycle_gap"] = worst(_cycle_gap(m), 1e-6, "", m.t[-1:], parts[:-1])
    return checks


def _cycle_gap(m: WholeBody) -> Array:
    """(1, 3 + nj) how far the last state is from the first one, turned about z and moved by `cycle`."""
    turn, (q0, q1), (v0, v1) = Rotation.from_euler("z", m.cycle[3]), m.q[[0, -1]], m.v[[0, -1]]
    place = np.abs(q1[:3] - turn.apply(q0[:3]) - m.cycle[:3]).max()
    rotation = ((turn * Rotation.from_quat(q0[3:7])).inv() * Rotation.from_quat(q1[3:7])).magnitude()
    speed = np.abs(np.concatenate([v1[:3] - turn.apply(v0[:3]), v1[3:6] - v0[3:6]])).max()
    joints = np.maximum(np.abs(q1[7:] - q0[7:]), np.abs(v1[6:] - v0[6:]))
    return np.concatenate([[place, rotation, speed], joints])[None]


def _points(robot: Robot, data: pin.Data, q: Array) -> Array:
    """(C, 3) m, contact frames in the world."""
    pin.framesForwardKinematics(robot.model, data, q)
    return np.array([data.oMf[robot.model.getFrameId(name)].translation for name in robot.foot_names])


def _defect(robot: Robot, m: WholeBody) -> Array:
    """(T - 1, 3 + nj + 1) defects: root position, rotation and velocities, joints, time axis."""
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in robot.foot_names]
    h, nj = m.h[:, None], m.q.shape[1] - 7
    dv = np.empty((len(m.h), model.nv))
    for k, (q, v, tau, lam) in enumerate(zip(m.q, m.v, m.tau, m.lam, strict=False)):
        R = pin.Quaternion(q[3:7]).normalized().matrix()
        spatial = np.concatenate([R.T @ v[:3], v[3:]])
        force = np.concatenate([np.zeros(6), tau]) - pin.nonLinearEffects(model, data, q, spatial)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        for f, each in zip(frames, lam, strict=True):
            force += pin.getFrameJacobian(model, data, f, _WORLD)[:3].T @ each
        a = np.linalg.solve(_symmetric(pin.crba(model, data, q)), force)
        # From the spatial acceleration of the root to that of its origin in the world.
        a[:3] = R @ (a[:3] + np.cross(spatial[3:6], spatial[:3]))
        dv[k] = m.v[k + 1] - v - m.h[k] * a
    v1 = m.v[1:]
    R, R1 = Rotation.from_quat(m.q[:-1, 3:7]), Rotation.from_quat(m.q[1:, 3:7])
    turn = (R * Rotation.from_rotvec(h * v1[:, 3:6])).inv() * R1
    move = np.abs(np.diff(m.q, axis=0) - h * np.insert(v1, 3, 0.0, axis=1))
    return np.column_stack(
        [
            move[:, :3].max(axis=1),
            np.maximum(turn.magnitude(), np.abs(np.linalg.norm(m.q[1:, 3:7], axis=1) - 1)),
            np.abs(dv[:, :6]).max(axis=1),
            np.maximum(np.abs(dv[:, 6:]), move[:, 7:]).reshape(-1, nj),
            np.abs(np.diff(m.t) - m.h),
        ]
    )


def _symmetric(M: Array) -> Array:
    """The whole of a matrix of which only the upper triangle may be filled."""
    return np.triu(M) + np.triu(M, 1).T


def point_foot_reference(robot: Robot, model: PointFootModel, motion: WholeBody) -> Reference:
    """The motion as the point-foot model sees it, for what follows such references.

    The body is the base frame, the points are the contact frames, forces are the motion's; u is what makes each point's
    own equation m_c f'' = -u + m_c g + lam exact. The equations of the body hold only as far as the robot resembles the
    model (its limbs have mass and move), and the model's limits on u and leg length were not asked for.
    """
    m, data, base = motion, robot.model.createData(), robot.model.getFrameId(robot.base)
    T, C = len(m.t), len(robot.foot_names)
    # With the knot before the first, from which its velocity comes, by a step like the first or, of a cycle, the last.
    h = np.concatenate([m.h[-1:] if len(m.cycle) else m.h[:1], m.h])[:, None]
    before = np.concatenate(
        [
            m.q[0, :3] - h[0] * m.v[0, :3],
            (Rotation.from_quat(m.q[0, 3:7]) * Rotation.from_rotvec(-h[0] * m.v[0, 3:6])).as_quat(),
            m.q[0, 7:] - h[0] * m.v[0, 6:],
        ]
    )
    points, poses = np.empty((T + 1, C, 3)), np.empty((T + 1, 7))
    for k, q in enumerate(np.vstack([before, m.q])):
        points[k] = _points(robot, data, q)
        poses[k] = pin.SE3ToXYZQUAT(data.oMf[base])
    R = Rotation.from_quat(poses[:, 3:7])
    v = np.concatenate(
        [
            np.diff(poses[:, :3], axis=0) / h,
            (R[:-1].inv() * R[1:]).as_rotvec() / h,
            (np.diff(points, axis=0) / h[..., None]).reshape(T, -1),
        ],
        axis=1,
    )
    acceleration = (np.diff(v[:, 6:], axis=0) / h[1:]).reshape(T - 1, C, 3)
    u = m.lam - model.foot_mass[:, None] * (acceleration + [0.0, 0.0, model.g])
    return Reference(
        t=m.t, h=m.h, q=np.concatenate([poses, points.reshape(T + 1, -1)], axis=1)[1:], v=v, u=u.reshape(T - 1, -1),
        lam=m.lam, point_names=robot.foot_names, robot_digest=robot.digest, cycle=m.cycle,
    )  # fmt: skip
