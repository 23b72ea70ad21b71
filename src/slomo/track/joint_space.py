"""Between the point-foot model and the whole robot's joints: its state one way, joint targets and torques the other.

The point-foot world is the plane of the feet's centres, which lies `foot_radius` above the ground: everything that
crosses here is shifted by that much in z.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.robot import Robot
from slomo.track.plan import PlanPoint

Array = np.ndarray

# Damping (m/rad, squared) of the Gauss-Newton step: far below a leg's Jacobian (0.1 to 0.3 m/rad), it only acts where
# the leg is nearly stretched.
DAMPING = 1e-5
ITERATIONS = 8
TOLERANCE = 1e-5  # m
LARGEST_STEP = 0.5  # rad, per iteration


@dataclass(frozen=True)
class JointCommand:
    """What the motors run between two ticks: tau = kp (q - q_now) + kd (v - v_now) + tau.

    Attributes:
        q: (nj,) rad.  v: (nj,) rad/s.  tau: (nj,) N m, feed-forward.
        kp: (nj,) N m/rad.  kd: (nj,) N m s/rad.
    """

    q: Array
    v: Array
    tau: Array
    kp: Array
    kd: Array


class JointSpace:
    """Inverse kinematics of all feet at once, and J^T forces.

    Deterministic: it starts from its last solution (the nominal pose after `reset`).

    Args:
        kp: N m/rad, kd: N m s/rad, of the motors' PD: one number for all or (nj,).
    """

    def __init__(self, robot: Robot, *, kp: Array | float = 20.0, kd: Array | float = 1.0):
        self.robot, self.model, self.data = robot, robot.model, robot.model.createData()
        nj = len(robot.joint_names)
        self.kp, self.kd = np.broadcast_to(kp, nj), np.broadcast_to(kd, nj)
        self._base = self.model.getFrameId(robot.base)
        self._feet = [self.model.getFrameId(name) for name in robot.foot_names]
        self._hips = [self.model.getFrameId(limb.hip) for limb in robot.limbs]
        self._T_root_base = self.model.frames[self._base].placement
        self._raise = np.array([0.0, 0.0, robot.foot_radius])
        self.reset()

    def reset(self) -> None:
        """Forget the last solution."""
        self._joints = self.robot.q_nominal[7:].copy()

    def solve(self, feet: Array) -> Array:
        """Joint angles that put the feet where they should be, as near as the joint limits allow.

        Damped Gauss-Newton on |p(q) - feet|^2, clipped to the limits after each step. A foot out of the leg's reach is
        first brought within it along the line from the hip, else the steps would swing about the stretched leg.

        Args:
            feet: (C, 3) m, foot frames in the base frame.

        Returns:
            (nj,) rad.
        """
        target = feet @ self._T_root_base.rotation.T + self._T_root_base.translation
        q = self._joints
        for _ in range(ITERATIONS):
            p, J = self._feet_in_root(q)
            hips = np.array([self.data.oMf[h].translation for h in self._hips])
            legs = target - hips
            length = np.linalg.norm(legs, axis=1, keepdims=True)
            legs *= np.clip(length, self.robot.leg_reach[:, :1], self.robot.leg_reach[:, 1:]) / np.maximum(length, 1e-9)
            error = (hips + legs).ravel() - p
            if np.abs(error).max() < TOLERANCE:
                break
            step = np.clip(_damped_solve(J, error), -LARGEST_STEP, LARGEST_STEP)
            q = np.clip(q + step, self.robot.lower, self.robot.upper)
        self._joints = q
        return q

    def pose(self, q_point: Array) -> Array:
        """(nq,) whole configuration with the base and the feet of a point-foot configuration (7 + 3 C,)."""
        R = _matrix(q_point[3:7])
        feet = (q_point[7:].reshape(-1, 3) - q_point[:3]) @ R
        T_world_root = pin.SE3(R, q_point[:3] + self._raise) * self._T_root_base.inverse()
        return np.concatenate([pin.SE3ToXYZQUAT(T_world_root), self.solve(feet)])

    def state(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The point-foot state of the whole robot's: ((7 + 3 C,), (6 + 3 C,)), laid out as in `motion.Reference`."""
        pin.forwardKinematics(self.model, self.data, q, v)
        pin.updateFramePlacements(self.model, self.data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        base = pin.SE3ToXYZQUAT(self.data.oMf[self._base])
        base[:3] -= self._raise
        points = [self.data.oMf[f].translation - self._raise for f in self._feet]
        twist = pin.getFrameVelocity(self.model, self.data, self._base, world)
        omega = self.data.oMf[self._base].rotation.T @ twist.angular
        speeds = [pin.getFrameVelocity(self.model, self.data, f, world).linear for f in self._feet]
        return np.concatenate([base, *points]), np.concatenate([twist.linear, omega, *speeds])

    def command(self, now: PlanPoint, ahead: PlanPoint, *, u: Array, q: Array, v: Array) -> JointCommand:
        """Joint targets of a point-foot state and the torques of leg forces.

        tau = -J^T R^T u: the legs press the feet down with -u so that they carry the body with u.

        Args:
            now, ahead: where the robot should be, and where a little later, at which the joints aim.
            u: (C, 3) N, world, forces of the feet on the body.
            q: (nq,) where the robot is, for the Jacobian of the forces.  v: (nv,).
        """
        R = _matrix(ahead.quat_xyzw)
        feet = (ahead.points - ahead.position) @ R
        joints = self.solve(feet)
        _, J = self._feet_in_root(joints)
        relative = (ahead.point_velocities - ahead.velocity) @ R - feet @ pin.skew(ahead.angular_velocity).T
        speeds = _damped_solve(J, (relative @ self._T_root_base.rotation.T).ravel())
        _, J_now = self._feet_in_root(q[7:])
        R_root = _matrix(q[3:7])
        tau = -J_now.T @ (u @ R_root).ravel()
        return JointCommand(
            joints,
            np.clip(speeds, -self.robot.velocity, self.robot.velocity),
            np.clip(tau, -self.robot.effort, self.robot.effort),
            self.kp,
            self.kd,
        )

    def _feet_in_root(self, joints: Array) -> tuple[Array, Array]:
        """(3 C,) m foot frames and (3 C, nj) their Jacobian, in the root link's frame."""
        q = np.concatenate([[0, 0, 0, 0, 0, 0, 1.0], joints])
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        p = np.concatenate([self.data.oMf[f].translation for f in self._feet])
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = np.vstack([pin.getFrameJacobian(self.model, self.data, f, world)[:3, 6:] for f in self._feet])
        return p, J


def _damped_solve(J: Array, y: Array) -> Array:
    """x minimising |J x - y|^2 + DAMPING |x|^2."""
    return np.linalg.solve(J.T @ J + DAMPING * np.eye(J.shape[1]), J.T @ y)


def _matrix(quat_xyzw: Array) -> Array:
    """(3, 3) rotation; twenty times faster than SciPy's for a single one."""
    x, y, z, w = quat_xyzw
    return pin.Quaternion(w, x, y, z).normalized().matrix()
