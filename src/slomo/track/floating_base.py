"""The equations of motion of the whole robot, solved for what the motors do not drive: the root.

    M_rr a_r + M_rj a_j + h_r = J_r^T f
    M_jr a_r + M_jj a_j + h_j = J_j^T f + tau

With the unknowns x = (a_j, f), joint accelerations and contact forces, both the whole acceleration and the joint
torques are affine in x: no equation is left for the solver.
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.robot import Robot
from slomo.track.sole import ContactPoint

Array = np.ndarray
WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class FloatingBase:
    """Kinematics and dynamics at one state.

    Args:
        robot: the robot.
        armature: kg m2, rotor inertia seen at the joints: (nj,) or one for all.
    """

    def __init__(self, robot: Robot, armature: Array | float):
        self.model = robot.model.copy()
        nj = self.model.nv - 6
        self.model.armature = np.concatenate([np.zeros(6), np.broadcast_to(armature, nj)])
        self.data = self.model.createData()
        self.nj = nj
        self._still = np.zeros(self.model.nv)

    def update(self, q: Array, v: Array) -> None:
        """Take the state q (nq,), v (nv,)."""
        model, data = self.model, self.data
        M = np.triu(pin.crba(model, data, q))
        self.M = M + np.triu(M, 1).T
        self.h = pin.nonLinearEffects(model, data, q, v).copy()
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, self._still)
        pin.updateFramePlacements(model, data)

    def placement(self, frame: int) -> pin.SE3:
        """T_world_frame."""
        return self.data.oMf[frame]

    def jacobian(self, frame: int) -> Array:
        """(6, nv): velocity (m/s, rad/s) of a frame along the world's axes."""
        return pin.getFrameJacobian(self.model, self.data, frame, WORLD)

    def velocity(self, frame: int) -> Array:
        """(6,) m/s, rad/s along the world's axes."""
        return pin.getFrameVelocity(self.model, self.data, frame, WORLD).vector

    def drift(self, frame: int) -> Array:
        """(6,) m/s^2, rad/s^2: acceleration of a frame's origin and its angular one, as far as velocities make it."""
        return pin.getFrameClassicalAcceleration(self.model, self.data, frame, WORLD).vector

    def affine(self, contacts: Sequence[ContactPoint]) -> tuple[Array, Array, Array, Array]:
        """Acceleration a = a0 + A x (nv,), m/s^2 and rad/s^2 with the root's in its own frame, and joint torques
        tau = t0 + T x (nj,), N m, of x = (a_j, f): the forces f (K, 3) N, world, act at the contacts."""
        nj, nv = self.nj, self.model.nv
        n = nj + 3 * len(contacts)
        Jt = np.zeros((nv, 3 * len(contacts)))
        for k, point in enumerate(contacts):
            J = self.jacobian(point.frame)
            lever = self.placement(point.frame).rotation @ point.offset
            Jt[:, 3 * k : 3 * k + 3] = (J[:3] + _cross(lever).T @ J[3:]).T
        M, h = self.M, self.h
        right = np.concatenate([-h[:6, None], -M[:6, 6:], Jt[:6]], axis=1)
        solved = np.linalg.solve(M[:6, :6], right)
        a0, A = np.zeros(nv), np.zeros((nv, n))
        a0[:6], A[:6] = solved[:, 0], solved[:, 1:]
        A[6:, :nj] = np.eye(nj)
        t0 = h[6:] + M[6:, :6] @ a0[:6]
        T = M[6:, :6] @ A[:6]
        T[:, :nj] += M[6:, 6:]
        T[:, nj:] -= Jt[6:]
        return a0, A, t0, T


def _cross(a: Array) -> Array:
    """(3, 3) matrix of the cross product from the left."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
