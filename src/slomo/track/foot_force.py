"""Forces of the ground on the feet, from joint torques and motion alone: no force sensor is needed."""

from math import exp

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.robot import Robot
from slomo.track.sensors import SensorSample

Array = np.ndarray

SMOOTHING = 0.004  # s, time constant of torques and accelerations
DAMPING = 1e-4  # m^2, of the least squares, against 0.02 to 0.1 of a leg: it acts near stretched legs only


class FootForces:
    """J^T f = M(q) a + h(q, v) - tau over the joints, solved for f by damped least squares.

    The root's motion comes from the IMU: specific force instead of acceleration and gravity, so that no attitude and no
    velocity enter. Torques and accelerations pass the same low-pass filter.

    Attributes:
        at: (F, 3) m, foot frames in the root's frame.  J: (F, 6, nj) their Jacobians there, linear above angular.
    """

    def __init__(self, robot: Robot):
        self.robot = robot
        self.model = robot.model.copy()
        self.model.gravity.linear = np.zeros(3)
        self.model.armature = np.concatenate([np.zeros(6), robot.rotor_inertia])
        self.data = self.model.createData()
        self._frames = [self.model.getFrameId(robot.foot_names[c]) for c in robot.feet]
        self.reset()

    def reset(self) -> None:
        """Forget what the filters hold."""
        self._t: float | None = None

    def update(self, sample: SensorSample) -> Array:
        """(F, 3) N in the root's frame: force of the ground on each foot that stands (not hands)."""
        q = np.concatenate([[0, 0, 0, 0, 0, 0, 1.0], sample.q])
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        self.at = np.array([self.data.oMf[f].translation for f in self._frames])
        self.J = np.array([pin.getFrameJacobian(self.model, self.data, f, world)[:, 6:] for f in self._frames])
        raw = np.concatenate([sample.acceleration, sample.gyro, sample.v, sample.tau])
        if self._t is None:
            self._smooth, rate = raw.copy(), np.zeros_like(raw)
        else:
            dt = max(sample.t - self._t, 1e-6)
            rate = (raw - self._smooth) / (SMOOTHING + dt)
            self._smooth = self._smooth + dt * rate
        self._t = sample.t
        nj = len(sample.q)
        # The smoothed velocity's rate is the smoothed acceleration.
        a = np.concatenate([self._smooth[:3], rate[3 : 6 + nj]])
        v = np.concatenate([np.zeros(3), self._smooth[3 : 6 + nj]])
        tau = pin.rnea(self.model, self.data, q, v, a)[6:] - self._smooth[6 + nj :]
        J = self.J[:, :3].reshape(-1, nj)
        return np.linalg.solve(J @ J.T + DAMPING * np.eye(len(J)), J @ tau).reshape(-1, 3)


def contact_probability(force: float, planned: bool, weight: float) -> float:
    """That a foot stands, from the normal force on it (N), from whether the plan has it stand, and the weight (N).

    Logistic in the force about 8 % of the weight; the plan shifts that by 6 % either way (a prior of 2 in the log odds;
    Bledt et al. 2018 fuse plan and force alike).
    """
    return 1 / (1 + exp(-min(max((force / weight - 0.08) / 0.03 + (2.0 if planned else -2.0), -30.0), 30.0)))
