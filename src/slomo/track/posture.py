"""Joint angles along a reference, and towards a plan that has left it."""

import numpy as np

from slomo.motion import Reference
from slomo.optimize.inverse import Legs, joint_motion
from slomo.robot import Robot
from slomo.track.plan import PlanPoint

Array = np.ndarray

ATTEMPTS = 8
ARRIVED = 1e-5  # m, of points, and of a centimetre times a sole's tilt


class Posture:
    """The reference's joint motion by inverse kinematics (`optimize.inverse`), between its knots.

    Args:
        robot: the robot.  reference: of its point-foot model.

    Attributes:
        first: (nq,) the robot in the reference's first pose, on the real ground.
    """

    def __init__(self, robot: Robot, reference: Reference):
        self.robot = robot
        motion = joint_motion(robot, reference)
        self._t, self._q = reference.t, motion.q[:, 7:]
        self._v = np.gradient(self._q, self._t, axis=0)
        self.first = motion.q[0].copy()
        self.first[2] += robot.foot_radius
        self._legs = Legs(robot)

    def at(self, t: float) -> tuple[Array, Array]:
        """(nj,) rad and (nj,) rad/s at a time; held before the first and after the last."""
        k = int(np.clip(np.searchsorted(self._t, t) - 1, 0, len(self._t) - 2))
        s = float(np.clip((t - self._t[k]) / (self._t[k + 1] - self._t[k]), 0, 1))
        return (1 - s) * self._q[k] + s * self._q[k + 1], (1 - s) * self._v[k] + s * self._v[k + 1]

    def towards(self, plan: PlanPoint) -> tuple[Array, Array]:
        """(nj,) rad and (nj,) rad/s of the plan, by one step of inverse kinematics from the reference's then."""
        joints, speeds = self.at(plan.t)
        state_q = np.concatenate([plan.position, plan.quat_xyzw])
        state_v = np.concatenate([plan.velocity, plan.angular_velocity])
        root = self._legs.root(state_q, state_v)
        joints = self._legs.solve(root[:7], joints, plan.points, joints, iterations=1)
        q = np.concatenate([root[:7], joints])
        return joints, self._legs.velocities(q, root[7:], speeds, plan.point_velocities.ravel())


def standing_pose(robot: Robot, q_point: Array) -> Array:
    """(nq,) the robot on the real ground with the base and the points of a point-foot configuration (7 + 3 C,)."""
    legs, nominal = Legs(robot), robot.q_nominal[7:]
    root = legs.root(q_point, np.zeros(6 + 3 * len(robot.limbs)))[:7]
    joints = nominal
    for _ in range(ATTEMPTS):  # a hand that is far from where it nominally is takes longer, and leaves soles tilted
        joints = legs.solve(root, joints, q_point[7:].reshape(-1, 3), nominal)
        if np.abs(legs.error).max() < ARRIVED:
            break
    q = np.concatenate([root, joints])
    q[2] += robot.foot_radius
    return q
