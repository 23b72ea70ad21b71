"""Standing up and lying down: the body goes straight up and down over feet that stay where they are."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.gravity import GRAVITY
from slomo.robot import Robot
from slomo.track.joint_space import JointCommand, JointSpace

Array = np.ndarray

STEP = 0.005  # m, of height
LOWEST = 0.3  # of the standing height, at which nobody needs to crouch further
REACHED = 0.004  # m, of the feet
TO_LIMIT = 0.05  # rad, at least, from any joint's limit


@dataclass(frozen=True)
class Descent:
    """The joints along a straight descent, and the torques by which the legs carry the weight on it.

    Attributes:
        joints: (n, nj) rad, from the highest pose to the crouch.
        tau: (n, nj) N m.
    """

    joints: Array
    tau: Array

    def at(self, s: float) -> tuple[Array, Array]:
        """Joints and torques (nj,) at a share s in [0, 1] of the way down."""
        x = np.clip(s, 0, 1) * (len(self.joints) - 1)
        k = min(int(x), len(self.joints) - 2)
        a = x - k
        return (1 - a) * self.joints[k] + a * self.joints[k + 1], (1 - a) * self.tau[k] + a * self.tau[k + 1]


class Postures:
    """Descents of one robot."""

    def __init__(self, robot: Robot):
        self.robot = robot
        self._joints = JointSpace(robot)

    def descent(self, q: Array) -> Descent:
        """From a standing configuration q (nq,) down to where a leg is folded as far as it goes."""
        robot = self.robot
        point, _ = self._joints.state(q, np.zeros(robot.model.nv))
        feet = point[7:].reshape(-1, 3)
        top = point[2] - feet[:, 2].min()
        joints = [q[7:]]
        for fall in np.arange(STEP, max(top - LOWEST * robot.standing_height, 2 * STEP), STEP):
            lower = point.copy()
            lower[2] -= fall
            pose = self._joints.pose(lower)
            at = self._joints.state(pose, np.zeros(robot.model.nv))[0]
            missed = np.abs(at[7:].reshape(-1, 3) - feet).max()
            room = min((pose[7:] - robot.lower).min(), (robot.upper - pose[7:]).min())
            if len(joints) > 1 and (missed > REACHED or room < TO_LIMIT):
                break
            joints.append(pose[7:])
        tau = [self._carrying(np.concatenate([q[:7], x])) for x in joints]
        return Descent(np.array(joints), np.array(tau))

    def _carrying(self, q: Array) -> Array:
        """(nj,) N m: torques of the least vertical forces at the feet that carry the robot at rest, without the legs'
        own weight."""
        model, data = self.robot.model, self._joints.data
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        ids = [model.getFrameId(name) for name in self.robot.foot_names]
        com = pin.centerOfMass(model, data, q)
        arms = np.array([data.oMf[i].translation - com for i in ids])
        balance = np.vstack([np.ones(len(ids)), arms[:, 0], arms[:, 1]])
        force = np.linalg.lstsq(balance, np.array([self.robot.mass * GRAVITY, 0, 0]), rcond=None)[0]
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = np.vstack([pin.getFrameJacobian(model, data, i, world)[2, 6:] for i in ids])
        return -J.T @ np.maximum(force, 0)


def smooth(s: float) -> tuple[float, float]:
    """A share in [0, 1] that starts and ends at rest, and its derivative."""
    s = min(max(s, 0.0), 1.0)
    return s * s * (3 - 2 * s), 6 * s * (1 - s)


def blend(a: JointCommand, b: JointCommand, share: float) -> JointCommand:
    """Between two commands: a at 0, b at 1."""
    return JointCommand(*((1 - share) * x + share * y for x, y in zip(vars(a).values(), vars(b).values(), strict=True)))
