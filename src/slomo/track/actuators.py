"""The motors: what they make of a command, how late, and what they cannot do."""

from collections import deque

import numpy as np

from slomo.robot import Robot
from slomo.track.joint_space import JointCommand

Array = np.ndarray


class Motors:
    """PD and feed-forward of the newest command that has arrived, within the torque-speed limits.

    Args:
        delay: s, from `send` until a command counts. The first one counts at once.
    """

    def __init__(self, robot: Robot, *, delay: float = 0.0):
        self.robot, self.delay = robot, delay
        self._queue: deque[tuple[float, JointCommand]] = deque()
        self._command: JointCommand | None = None

    def send(self, t: float, command: JointCommand) -> None:
        """A command leaves the controller at time t (s)."""
        self._command = self._command or command
        self._queue.append((t + self.delay, command))

    def asked(self, t: float, q: Array, v: Array) -> Array:
        """(nj,) N m, what the command in force at time t asks for at joint angles q and speeds v (nj,)."""
        while self._queue and self._queue[0][0] <= t + 1e-9:
            self._command = self._queue.popleft()[1]
        c = self._command
        assert c is not None, "nothing sent"
        return c.kp * (c.q - q) + c.kd * (c.v - v) + c.tau

    def limited(self, tau: Array, v: Array) -> Array:
        """The torques (nj,) N m that the motors give of tau at speeds v (nj,) rad/s (see `torque_limits`)."""
        low, high = torque_limits(self.robot, v)
        return np.clip(tau, low, high)


def torque_limits(robot: Robot, v: Array) -> tuple[Array, Array]:
    """Least and greatest torque (nj,) N m at speeds v (nj,) rad/s.

    Along the motion the full effort up to the knee speed, from there in a straight line to nothing at the greatest
    speed, as the supply's voltage has it; against the motion the full effort.
    """
    room = np.maximum(robot.velocity - robot.knee_speed, 1e-9)
    high = robot.effort * np.clip((robot.velocity - v) / room, 0.0, 1.0)
    low = -robot.effort * np.clip((robot.velocity + v) / room, 0.0, 1.0)
    return low, high
