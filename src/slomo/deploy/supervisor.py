"""The safety supervisor: between the controller and the wire, always on. Pure: time and states come in as arguments.

Whatever is wrong is a `Trip` with its cause and time, the first one stays, and from then on nothing but damping is let
through. Two causes leave time to lie down first (`landing`): a hot motor and a low battery.
"""

from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from math import acos, degrees

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.deploy.config import HZ, Config
from slomo.deploy.go1 import TICK_HZ, TICKS, RobotState
from slomo.robot import Robot
from slomo.track.joint_space import JointCommand

Array = np.ndarray

STOP_BUTTONS = {"B"}  # of the remote, alone or, as in the vendor's own stop, with L2
PERSISTENT = 3  # states in a row that show the same, so that one spike is no reason
FOLDED = 0.4  # rad, how far outside of its limits a joint may be before it has once been inside (lying, folded up)
POWER_SECONDS = 0.1
TORQUE_MARGIN = 1.25  # of the effort limit, for the motors' own estimate
READY_TILT, READY_SPEED = 30.0, 1.0  # degrees, rad/s: how a robot may lie before it stands up
CLOCK_TOLERANCE = 0.2


class Cause(StrEnum):
    """Why the robot was stopped."""

    SILENT = "no state from the robot"
    DELAYED = "states are delayed"
    LOSS = "packets are lost"
    CLOCK = "the robot's clock is wrong"
    LATE = "the controller is late"
    DEAD = "the controller ended"
    NUMBER = "the controller gave no finite number"
    ERROR = "an error in the program"
    POSITION = "a joint is at its limit"
    VELOCITY = "a joint is too fast"
    TORQUE = "a torque is too large"
    POWER = "too much power"
    TILT = "the body tilts"
    HEIGHT = "the body is too low"
    ATTITUDE = "the IMU gives no attitude"
    TEMPERATURE = "a motor is hot"
    BATTERY = "the battery is low"
    NOT_AT_REST = "the robot is not at rest"
    STOP_KEY = "stop key"
    SIGNAL = "stopped by a signal"


CAUSES = tuple(Cause)


@dataclass(frozen=True)
class Trip:
    """cause; t: s, when; detail: what was measured."""

    cause: Cause
    t: float
    detail: str

    def __str__(self) -> str:
        return f"{self.cause}: {self.detail} at {self.t:.3f} s"


class Supervisor:
    """`see` each state, `watch` and `allow` at each tick.

    Args:
        lowest: m, lowest height of the body's base in the motion.
        begin: s, when the run begins; the times of trips count from there.

    Attributes:
        trip: None, or why only damping is let through.
        landing: None, or why the robot should lie down now.
        upright: set by the caller while the robot should be standing, when its height counts.
    """

    def __init__(self, robot: Robot, config: Config, *, lowest: float, begin: float = 0.0):
        self.robot, self.config, self._origin = robot, config, begin
        self.trip: Trip | None = None
        self.landing: Trip | None = None
        self.upright = self._resting = False
        self.state: RobotState | None = None
        self._heard: float | None = None
        self._begun: float | None = None
        self._first_tick = 0
        self._arrivals: deque[float] = deque()
        self._in_a_row: dict[Cause, int] = {}
        self._armed = np.zeros(len(robot.joint_names), bool)
        self._power = 0.0
        self._feed_forward = np.zeros(len(robot.joint_names))
        self._last: JointCommand | None = None
        self._fresh = -np.inf
        self._least_height = config.min_height * min(robot.standing_height, lowest)
        self._data = robot.model.createData()
        self._base = robot.model.getFrameId(robot.base)
        self._feet = [robot.model.getFrameId(name) for name in robot.foot_names]

    def stop(self, cause: Cause, now: float, detail: str) -> None:
        """Trip. The first one stays."""
        if self.trip is None and not self._resting:
            self.trip = Trip(cause, now - self._origin, detail)

    def rest(self) -> None:
        """The run is over and the robot goes down: what is seen from now on is no reason to stop it."""
        self._resting = True

    def see(self, state: RobotState, arrival: float) -> None:
        """A state that is newer than the last, and when it came in (s)."""
        s, limits, c = state.sample, self.robot, self.config
        before, self.state, self._heard = self.state, state, arrival
        self._arrivals.append(arrival)
        if self._begun is None:
            self._begun, self._first_tick = arrival, state.tick
        if pressed := STOP_BUTTONS & state.buttons:
            self.stop(Cause.STOP_KEY, arrival, f"button {', '.join(sorted(pressed))} of the remote")
        outside = np.maximum(limits.lower - s.q, s.q - limits.upper)
        self._armed |= outside <= 0
        self._joint(Cause.POSITION, outside - np.where(self._armed, c.beyond_limit, FOLDED), s.q, "rad", arrival)
        self._joint(Cause.VELOCITY, np.abs(s.v) - limits.velocity, s.v, "rad/s", arrival)
        self._joint(Cause.TORQUE, np.abs(s.tau) - TORQUE_MARGIN * limits.effort, s.tau, "N m", arrival)
        dt = min(max(s.t - before.sample.t, 0.0), POWER_SECONDS) if before else 0.0
        self._power += dt / POWER_SECONDS * (float(np.abs(s.tau * s.v).sum()) - self._power)
        self._persist(Cause.POWER, self._power > c.max_power, "{:.0f} W", self._power, arrival)
        self._persist(Cause.ATTITUDE, s.quat_xyzw is None, "its quaternion is not of length 1", 0.0, arrival)
        if s.quat_xyzw is not None:
            self._posture(s.q, s.quat_xyzw, arrival)
        hottest = int(state.temperature.argmax())
        if self._lasting(Cause.TEMPERATURE, state.temperature[hottest] > c.max_temperature):
            detail = f"{limits.joint_names[hottest]} has {state.temperature[hottest]:.0f} degrees C"
            self._land(Cause.TEMPERATURE, arrival, detail)
        if self._lasting(Cause.BATTERY, state.battery < c.min_battery):
            self._land(Cause.BATTERY, arrival, f"{state.battery} %")

    def watch(self, now: float) -> None:
        """What shows only as time goes by: silence, delay, loss. Nothing before the first state."""
        if self.state is None or self._heard is None or self._begun is None:
            return
        c = self.config
        if now - self._heard > c.stale:
            self.stop(Cause.SILENT, now, f"none for {1e3 * (now - self._heard):.0f} ms")
        elif now - self.state.sample.t > c.stale:
            self.stop(Cause.DELAYED, now, f"the newest is {1e3 * (now - self.state.sample.t):.0f} ms old")
        while self._arrivals and self._arrivals[0] < now - 1:
            self._arrivals.popleft()
        lost = 1 - len(self._arrivals) / HZ
        if now - self._begun > 1 and lost > c.max_loss:
            self.stop(Cause.LOSS, now, f"{100 * lost:.0f} % of the states in the last second")

    def ready(self, now: float) -> None:
        """Trip unless the robot may stand up: enough states, a right clock, lying still and level."""
        state, c = self.state, self.config
        if (
            state is None
            or self._begun is None
            or len(self._arrivals) < (1 - c.max_loss) * HZ * (now - self._begun) - 5
        ):
            self.stop(Cause.SILENT, now, f"{len(self._arrivals)} states in {now - (self._begun or now):.1f} s")
            return
        ran = (state.tick - self._first_tick) % TICKS / TICK_HZ
        if abs(ran / (now - self._begun) - 1) > CLOCK_TOLERANCE:
            self.stop(Cause.CLOCK, now, f"it ran {ran:.2f} s in {now - self._begun:.2f} s")
        tilt = _tilt(state.sample.quat_xyzw) if state.sample.quat_xyzw is not None else 180.0
        if tilt > READY_TILT:
            self.stop(Cause.TILT, now, f"{tilt:.0f} degrees before it stands up")
        if (fastest := np.abs(state.sample.v).max()) > READY_SPEED:
            self.stop(Cause.NOT_AT_REST, now, f"a joint moves at {fastest:.1f} rad/s")
        if self.landing:
            self.stop(self.landing.cause, now, self.landing.detail)

    def allow(self, fresh: JointCommand | None, now: float) -> JointCommand | None:
        """What may be sent: `fresh`, brought within all limits; without a new one the last, held; None for damping.

        Position and torque (of the PD at the newest state too) within the limits, targets and feed-forward torques
        changing no faster than allowed.
        """
        if self.trip or self.state is None:
            return None
        if self._last and now - self._fresh > self.config.hold:
            self.stop(Cause.LATE, now, f"no command for {1e3 * (now - self._fresh):.0f} ms")
            return None
        if fresh is None:
            if self._last is None:
                return None
            return replace(self._last, v=np.zeros_like(self._last.v))
        numbers = {"q": fresh.q, "v": fresh.v, "tau": fresh.tau, "kp": fresh.kp, "kd": fresh.kd}
        for name, x in numbers.items():
            if not np.isfinite(x).all() or (name in ("kp", "kd") and (x < 0).any()):
                self.stop(Cause.NUMBER, now, f"{name} of {self.robot.joint_names[_first_bad(name, x)]}")
                return None
        s, robot, c = self.state.sample, self.robot, self.config
        last_q = self._last.q if self._last else s.q
        dt = min(max(now - self._fresh, 1 / HZ), c.hold)
        q = np.clip(fresh.q, robot.lower, robot.upper)
        q = last_q + np.clip(q - last_q, -c.max_joint_rate * dt, c.max_joint_rate * dt)
        v = np.clip(fresh.v, -robot.velocity, robot.velocity)
        self._feed_forward += np.clip(fresh.tau - self._feed_forward, -c.max_torque_rate * dt, c.max_torque_rate * dt)
        pd = fresh.kp * (q - s.q) + fresh.kd * (v - s.v)
        tau = np.clip(pd + self._feed_forward, -robot.effort, robot.effort) - pd
        self._last, self._fresh = JointCommand(q=q, v=v, tau=tau, kp=fresh.kp, kd=fresh.kd), now
        return self._last

    def _posture(self, q: Array, quat_xyzw: Array, now: float) -> None:
        tilt = _tilt(quat_xyzw)
        self._persist(Cause.TILT, tilt > self.config.max_tilt, "by {:.0f} degrees", tilt, now)
        if not self.upright:
            return
        model, data = self.robot.model, self._data
        pin.framesForwardKinematics(model, data, np.concatenate([np.zeros(3), quat_xyzw, q]))
        height = data.oMf[self._base].translation[2] - min(data.oMf[foot].translation[2] for foot in self._feet)
        low = height < self._least_height
        self._persist(Cause.HEIGHT, low, "{:.2f} m over the lowest foot", height, now)

    def _land(self, cause: Cause, now: float, detail: str) -> None:
        if self.landing is None:
            self.landing = Trip(cause, now - self._origin, detail)

    def _joint(self, cause: Cause, excess: Array, x: Array, unit: str, now: float) -> None:
        worst = int(excess.argmax())
        self._persist(cause, excess[worst] > 0, f"{self.robot.joint_names[worst]} {{:.2f}} {unit}", x[worst], now)

    def _persist(self, cause: Cause, bad: bool, detail: str, value: float, now: float) -> None:
        if self._lasting(cause, bad):
            self.stop(cause, now, detail.format(value))

    def _lasting(self, cause: Cause, bad: bool) -> bool:
        self._in_a_row[cause] = self._in_a_row.get(cause, 0) + 1 if bad else 0
        return self._in_a_row[cause] >= PERSISTENT


def _tilt(quat_xyzw: Array) -> float:
    """Degrees between the body's z axis and the vertical."""
    x, y, _, _ = quat_xyzw.tolist()
    return degrees(acos(max(-1.0, min(1.0, 1 - 2 * (x * x + y * y)))))


def _first_bad(name: str, x: Array) -> int:
    return int(np.argmax(~np.isfinite(x) | ((x < 0) & (name in ("kp", "kd")))))
