"""Where the robot is, from joint encoders and IMU alone: no contact sensor, no reliance on where the ground is.

Legs that stand tie the body to points of the ground (`inekf`); which legs stand is told by their joints' torques and by
the plan (`foot_force`). Position along the ground and heading cannot be observed: they start as the first pose has them
and drift with every step.
"""

import time
from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from slomo.gravity import GRAVITY
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track import inekf
from slomo.track.foot_force import FootForces, contact_probability
from slomo.track.sensors import SensorSample

Array = np.ndarray

STILL = 0.05  # rad/s, joint speed under which a robot on all its feet stands still
SLOW = 0.05  # s, over which that speed is averaged
# rad, m: heading and place are known like this in the beginning, and counted anew once they are as uncertain as that.
FOUND, LOST = (1e-4, 1e-4), (0.1, 1.0)


@dataclass(frozen=True)
class Tuning:
    """Standard deviations that the filter assumes.

    Attributes:
        gyro: rad/s/sqrt(Hz).  accelerometer: m/s^2/sqrt(Hz).
        gyro_walk, accelerometer_walk: of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
        leg: m, of where kinematics have a foot.
        stance: m/sqrt(s), how a standing foot wanders.  rest: while the robot stands still, which shows the bias of
            the gyroscope.  swing: in the air, where a foot tells nothing.
        ground: m, of the terrain's height where a foot comes down. Each touchdown pulls this softly, once.
        tilt: rad, gyro_bias: rad/s, accelerometer_bias: m/s^2, height: m, speed: m/s, in the beginning.
    """

    gyro: float = 4e-4
    accelerometer: float = 2e-2
    gyro_walk: float = 2e-5
    accelerometer_walk: float = 1e-3
    leg: float = 2e-3
    stance: float = 5e-3
    rest: float = 2e-4
    swing: float = 3.0
    ground: float = 0.02
    tilt: float = 0.02
    gyro_bias: float = 0.02
    accelerometer_bias: float = 0.15
    height: float = 0.02
    speed: float = 0.05


class Estimator:
    """`start` with a sample at rest, then `sense` each sample; `state` whenever it is wanted.

    Attributes:
        contact: (C,) probability that each of the robot's points stands; 0 for hands.
        force: (F, 3) N, world, of the ground on each foot.
        feet: (F, 3) m, world, where the filter has the feet's centres.
        gyro_bias: (3,) rad/s.  accelerometer_bias: (3,) m/s^2.
    """

    def __init__(self, robot: Robot, terrain: Terrain, *, tuning: Tuning | None = None):
        self.robot, self.terrain, self.tuning = robot, terrain, tuning or Tuning()
        self._forces = FootForces(robot)
        self._radius = np.array([robot.limbs[c].foot_radius for c in robot.feet])
        self._weight = robot.mass * GRAVITY
        self.contact = np.zeros(len(robot.limbs))

    def warm_up(self) -> float:
        """Compile the filter; returns the seconds."""
        start = time.perf_counter()
        nj = len(self.robot.joint_names)
        zero, up = np.zeros(nj), np.array([0.0, 0.0, GRAVITY])
        pose = self.robot.q_nominal
        for t in (0.0, 1e-3):
            sample = SensorSample(t, pose[7:], zero, zero, np.zeros(3), up)
            if t == 0:
                self.start(sample, pose)
            else:
                self.sense(sample, np.ones(len(self.contact), bool))
        return time.perf_counter() - start

    def start(self, sample: SensorSample, pose: Array) -> None:
        """Begin at rest on standing feet.

        Args:
            pose: (nq,) about where the robot is: its position along the ground and its heading are taken from it.
                Roll and pitch are gravity's, the height is that of feet on the terrain.
        """
        tuning, N = self.tuning, len(self.robot.feet)
        self._forces.reset()
        self.force = self._forces.update(sample)
        up = sample.acceleration / np.linalg.norm(sample.acceleration)
        if sample.quat_xyzw is not None:
            up = Rotation.from_quat(sample.quat_xyzw).inv().apply([0.0, 0.0, 1.0])
        tilt = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
        heading = Rotation.from_quat(pose[3:7]).as_euler("ZYX")[0] - tilt.as_euler("ZYX")[0]
        self._R = np.ascontiguousarray((Rotation.from_euler("Z", heading) * tilt).as_matrix())
        legs = self._forces.at @ self._R.T
        self._p = pose[:3].copy()
        self._p[2] = np.mean(self._ground(self._p + legs) - legs[:, 2])
        self._v = np.zeros(3)
        self.feet = self._p + legs
        self._bias = np.zeros(6)
        n = 15 + 3 * N
        P = np.zeros((n, n))
        P[:3, :3] = np.diag([tuning.tilt, tuning.tilt, FOUND[0]]) ** 2
        P[3:6, 3:6] = tuning.speed**2 * np.eye(3)
        position = np.diag([FOUND[1], FOUND[1], tuning.height]) ** 2
        for i in range(6, 9 + 3 * N, 3):  # what is not known of the position is not known of the feet, alike
            for j in range(6, 9 + 3 * N, 3):
                P[i : i + 3, j : j + 3] = position
        P[9 : 9 + 3 * N, 9 : 9 + 3 * N] += tuning.leg**2 * np.eye(3 * N)
        P[n - 6 : n - 3, n - 6 : n - 3] = tuning.gyro_bias**2 * np.eye(3)
        P[n - 3 :, n - 3 :] = tuning.accelerometer_bias**2 * np.eye(3)
        self._P = P
        self._stands = np.ones(N, bool)
        self._speed = sample.v.copy()
        self.contact[self.robot.feet] = 1.0
        for c in range(N):
            self._touch_down(c)
        self._last = sample

    def sense(self, sample: SensorSample, planned: Array) -> None:
        """Take in a sample.

        Args:
            planned: (C,) bool, which points the plan has standing now.
        """
        tuning, feet, last = self.tuning, self.robot.feet, self._last
        dt = sample.t - last.t
        if not dt > 0:
            return
        w = last.gyro - self._bias[:3]
        # A round foot rolls: its centre moves by the leg's turning times the radius, while the ground holds it.
        turning = (w + self._forces.J[:, 3:] @ last.v) @ self._R.T
        drift = np.stack([turning[:, 1], -turning[:, 0], np.zeros(len(turning))], axis=1) * self._radius[:, None]
        p = self.contact[feet]
        loose = np.clip((0.9 - p) / 0.4, 0.0, 1.0)
        drift *= (loose < 1)[:, None]
        still = self._stands.all() and np.abs(self._speed).max() < STILL
        stance = tuning.rest if still else tuning.stance
        inekf.predict(
            *self._state, last.gyro, last.acceleration, drift, dt, GRAVITY,
            np.array([tuning.gyro, tuning.accelerometer, tuning.gyro_walk, tuning.accelerometer_walk]),
            stance + loose**2 * tuning.swing,
        )  # fmt: skip
        self.force = self._forces.update(sample) @ self._R.T
        inekf.correct_legs(*self._state, self._forces.at, tuning.leg)
        self.contact[feet] = [
            contact_probability(f, bool(on), self._weight)
            for f, on in zip(self.force[:, 2], planned[feet], strict=True)
        ]
        stands = np.where(self._stands, self.contact[feet] > 0.4, self.contact[feet] > 0.7)
        for c in np.flatnonzero(stands & ~self._stands):
            self._touch_down(int(c))
        self._stands = stands
        if self._P[2, 2] > LOST[0] ** 2 or max(self._P[6, 6], self._P[7, 7]) > LOST[1] ** 2:
            inekf.forget_place(self._P, *FOUND)
        self._speed += dt / SLOW * (sample.v - self._speed)
        self._last = sample

    def state(self, t: float) -> tuple[Array, Array]:
        """q (nq,), v (nv,) of the whole robot at a time (s) at or soon after the last sample, as it moved then."""
        s = self._last
        ahead = max(t - s.t, 0.0)
        omega = s.gyro - self._bias[:3]
        R = self._R @ pin.exp3(omega * ahead)
        q = np.concatenate([self._p + ahead * self._v, pin.Quaternion(R).coeffs(), s.q + ahead * s.v])
        return q, np.concatenate([R.T @ self._v, omega, s.v])

    @property
    def gyro_bias(self) -> Array:
        return self._bias[:3]

    @property
    def accelerometer_bias(self) -> Array:
        return self._bias[3:]

    @property
    def _state(self) -> tuple[Array, ...]:
        return self._R, self._v, self._p, self.feet, self._bias, self._P

    def _ground(self, points: Array) -> Array:
        """(F,) m, height of the feet's centres when they stand at points (F, 3), as the terrain has it."""
        return self.terrain.height(points) + self._radius

    def _touch_down(self, c: int) -> None:
        height = float(self._ground(self.feet)[c])
        inekf.correct_height(*self._state, c, height, self.tuning.ground)
