"""What a robot tells the controller."""

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
