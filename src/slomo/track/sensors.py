"""What a robot tells the controller, and how simulated sensors spoil it."""

from collections import deque
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class SensorSample:
    """What the robot (or its simulation) measures at one time; joints in the robot model's order.

    Attributes:
        t: s, when it was measured, on the controller's clock.
        q: (nj,) rad.  v: (nj,) rad/s.  tau: (nj,) N m, the motors' own estimate.
        gyro: (3,) rad/s, in the IMU's frame, which is the root link's.
        acceleration: (3,) m/s^2, specific force in the same frame: at rest +g upwards.
        quat_xyzw: (4,) the IMU's own attitude where it has one, else None. Only ever used to begin with.
    """

    t: float
    q: Array
    v: Array
    tau: Array
    gyro: Array
    acceleration: Array
    quat_xyzw: Array | None = None


@dataclass(frozen=True)
class SensorErrors:
    """Standard deviations: of a bias, drawn once for each joint and axis, and of the noise of a sample at 1 kHz.

    Encoders of 15 bits with zeros set by hand, torques from motor currents, and a MEMS IMU after warming up, on a body
    that shakes: the IMU's noise is three times what data sheets give at rest.
    """

    q_bias: float = 3e-3
    q: float = 5e-4
    v: float = 0.05
    tau_bias: float = 0.1
    tau: float = 0.2
    gyro_bias: float = 5e-3
    gyro: float = 1e-2
    acceleration_bias: float = 0.1
    acceleration: float = 0.15
    delay: float = 1e-3


class SimulatedSensors:
    """Spoils true samples.

    Attributes:
        q_bias: (nj,) rad, of the encoders, which the motors' own PD reads too.
    """

    def __init__(self, joints: int, *, seed: int, errors: SensorErrors | None = None):
        self.errors = e = errors or SensorErrors()
        self._rng = rng = np.random.default_rng(seed)
        self.q_bias = e.q_bias * rng.normal(size=joints)
        self._tau_bias = e.tau_bias * rng.normal(size=joints)
        self._gyro_bias = e.gyro_bias * rng.normal(size=3)
        self._acceleration_bias = e.acceleration_bias * rng.normal(size=3)
        self._queue: deque[SensorSample] = deque()

    def read(self, true: SensorSample) -> SensorSample:
        """Measure now; returns the newest sample that has arrived by then (the first one at once)."""
        e, normal = self.errors, self._rng.normal
        nj = len(true.q)
        spoiled = SensorSample(
            t=true.t,
            q=true.q + self.q_bias + e.q * normal(size=nj),
            v=true.v + e.v * normal(size=nj),
            tau=true.tau + self._tau_bias + e.tau * normal(size=nj),
            gyro=true.gyro + self._gyro_bias + e.gyro * normal(size=3),
            acceleration=true.acceleration + self._acceleration_bias + e.acceleration * normal(size=3),
        )
        self._queue.append(spoiled)
        while len(self._queue) > 1 and self._queue[1].t <= true.t - e.delay + 1e-9:
            self._queue.popleft()
        return self._queue[0]
