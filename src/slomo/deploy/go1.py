"""What the Go1 says and is told, in the robot model's joint order and in SI units, to and from its wire format."""

import re
from dataclasses import dataclass

import numpy as np

from slomo.deploy import wire
from slomo.errors import UsageError
from slomo.robot import Robot
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorSample

Array = np.ndarray

MOTOR_JOINTS = tuple(f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf"))
FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
N = len(MOTOR_JOINTS)
TICK_HZ = 1e6
TICKS = 1 << 32
_GO1 = re.compile(r"go1([-_]|$)")  # names of a Go1, or of a variant of it: go1-arm
DAMPING_KD = 3.0  # N m s/rad, with which Unitree's own examples let a Go1 down
# Slots of motors that a Go1 does not have, in which the twin reports where it truly is (see `truth`).
_TRUTH = slice(N, N + 4)
_TRUTH_MODE = 0x54


@dataclass(frozen=True)
class RobotState:
    """One LowState.

    Attributes:
        sample: what the controller may see.
        tick: of the robot's clock, 1/TICK_HZ, wraps at TICKS.
        temperature: (nj,) degrees C, of the motors.
        foot_force: (C,) the robot's own unit, in the order of the robot's feet.
        battery: %, charge.
        buttons: names of the remote's buttons that are pressed.
    """

    sample: SensorSample
    tick: int
    temperature: Array
    foot_force: Array
    battery: int
    buttons: frozenset[str]


class Go1:
    """The wire's motors and feet by name in a robot's order.

    Raises:
        UsageError: the robot is no Go1.
    """

    def __init__(self, robot: Robot, *, scrambled: bool = False):
        # The maker's other robots have joints and feet of the same names, and other limits: the name has to tell.
        if not _GO1.match(robot.name):
            raise UsageError(
                f"no wire format for {robot.name!r}", where="--robot", valid=("go1",),
                todo="a robot.toml of your own for a Go1 has a name that begins with go1-",
            )  # fmt: skip
        if set(robot.joint_names) != set(MOTOR_JOINTS) or set(robot.foot_names) != set(FEET):
            raise UsageError(
                "its joints or feet are not those of a Go1", where=robot.name, valid=(*MOTOR_JOINTS, *FEET),
            )  # fmt: skip
        self.scrambled = scrambled
        self._motor = np.array([MOTOR_JOINTS.index(name) for name in robot.joint_names])
        self._foot = np.array([FEET.index(name) for name in robot.foot_names])
        self._joint = np.argsort(self._motor)

    def state(self, data: bytes, t: float) -> RobotState:
        """The robot's state in a datagram that came in at t (s).

        Raises:
            wire.Rejected: no whole LowState, or numbers in it that are not finite.
        """
        message = wire.decode(data, wire.LOW_STATE, scrambled=self.scrambled)
        motor = message["motor"][self._motor]
        numbers = [motor["q"], motor["dq"], message["gyro"], message["acceleration"], message["quat_wxyz"]]
        if not all(np.isfinite(x).all() for x in numbers):
            raise wire.Rejected("number")
        q, v, gyro, acceleration, quat = (x.astype(float) for x in numbers)
        norm = np.linalg.norm(quat)
        pressed = int.from_bytes(message["remote"][2:4].tobytes(), "little")
        return RobotState(
            sample=SensorSample(
                t=t, q=q, v=v, tau=motor["tau"] * wire.MOTOR_STATE_UNIT["tau"], gyro=gyro, acceleration=acceleration,
                quat_xyzw=quat[[1, 2, 3, 0]] / norm if 0.9 < norm < 1.1 else None,
            ),
            tick=int(message["tick"]),
            temperature=motor["temperature"].astype(float),
            foot_force=message["foot_force"][self._foot].astype(float),
            battery=int(message["soc"]),
            buttons=frozenset(name for bit, name in enumerate(wire.BUTTONS) if pressed >> bit & 1),
        )  # fmt: skip

    def state_datagram(self, state: RobotState, *, body: tuple[Array, Array] | None = None) -> bytes:
        """Inverse of `state`, for the twin. Args: body: its true position (3,) m and quat_xyzw (4,)."""
        message = wire.new(wire.LOW_STATE)
        motor, sample = message["motor"][:N], state.sample
        motor["mode"] = wire.SERVO
        motor["q"], motor["dq"] = sample.q[self._joint], sample.v[self._joint]
        motor["tau"] = wire.to_counts(sample.tau[self._joint], wire.MOTOR_STATE_UNIT["tau"])
        motor["q_raw"], motor["dq_raw"] = motor["q"], motor["dq"]
        motor["temperature"] = state.temperature[self._joint]
        message["gyro"], message["acceleration"] = sample.gyro, sample.acceleration
        quat = sample.quat_xyzw if sample.quat_xyzw is not None else np.zeros(4)
        message["quat_wxyz"] = quat[[3, 0, 1, 2]]
        message["foot_force"] = wire.to_counts(state.foot_force[np.argsort(self._foot)], 1)
        message["soc"], message["tick"] = state.battery, state.tick % TICKS
        pressed = sum(1 << wire.BUTTONS.index(name) for name in state.buttons)
        message["remote"][2:4] = list(pressed.to_bytes(2, "little"))
        if body is not None:
            slots = message["motor"][_TRUTH]
            slots["mode"] = _TRUTH_MODE
            slots["q"], slots["dq"] = np.append(body[0], 0), body[1]
        return wire.encode(message, scrambled=self.scrambled)

    def command_datagram(self, command: JointCommand) -> bytes:
        """A LowCmd in servo mode. The command's numbers are finite; what the format cannot hold is saturated."""
        message = wire.new(wire.LOW_CMD)
        motor, order = message["motor"][:N], self._joint
        motor["mode"] = wire.SERVO
        motor["q"], motor["dq"] = command.q[order], command.v[order]
        for name, x in (("tau", command.tau), ("Kp", command.kp), ("Kd", command.kd)):
            motor[name] = wire.to_counts(x[order], wire.MOTOR_CMD_UNIT[name])
        return wire.encode(message, scrambled=self.scrambled)

    def damping_datagram(self) -> bytes:
        """A LowCmd that holds no position and brakes every motor by DAMPING_KD, in servo mode, so that it does not rest
        on what the firmware makes of the mode DAMPING."""
        message = wire.new(wire.LOW_CMD)
        motor = message["motor"][:N]
        motor["mode"], motor["q"] = wire.SERVO, wire.POSITION_STOP
        motor["Kd"] = wire.to_counts(DAMPING_KD, wire.MOTOR_CMD_UNIT["Kd"])
        return wire.encode(message, scrambled=self.scrambled)

    def off_datagram(self) -> bytes:
        """A LowCmd with every motor in the mode DAMPING, the last one of a run."""
        message = wire.new(wire.LOW_CMD)
        motor = message["motor"][:N]
        motor["mode"], motor["q"], motor["dq"] = wire.DAMPING, wire.POSITION_STOP, wire.VELOCITY_STOP
        return wire.encode(message, scrambled=self.scrambled)

    def command(self, data: bytes) -> JointCommand | None:
        """What a LowCmd asks of the motors, for the twin: None for damping by the motors' own mode.

        A motor in servo mode with POSITION_STOP has kp 0, one with VELOCITY_STOP kd 0.

        Raises:
            wire.Rejected: no whole LowCmd, an unknown mode, modes that differ, or numbers that are not finite.
        """
        message = wire.decode(data, wire.LOW_CMD, scrambled=self.scrambled)
        motor = message["motor"][self._motor]
        modes = set(motor["mode"].tolist())
        if modes == {wire.DAMPING}:
            return None
        if modes != {wire.SERVO}:
            raise wire.Rejected("mode")
        if not (np.isfinite(motor["q"]).all() and np.isfinite(motor["dq"]).all()):
            raise wire.Rejected("number")
        q, v = motor["q"].astype(float), motor["dq"].astype(float)
        tau, kp, kd = (motor[name] * wire.MOTOR_CMD_UNIT[name] for name in ("tau", "Kp", "Kd"))
        if (kp < 0).any() or (kd < 0).any():
            raise wire.Rejected("gain")
        free, still = np.abs(q) >= 0.99 * wire.POSITION_STOP, np.abs(v) >= 0.99 * wire.VELOCITY_STOP
        return JointCommand(
            q=np.where(free, 0, q),
            v=np.where(still, 0, v),
            tau=tau,
            kp=np.where(free, 0, kp),
            kd=np.where(still, 0, kd),
        )


def truth(data: bytes) -> tuple[Array, Array] | None:
    """Root link's true position (3,) m and quat_xyzw (4,) in a twin's LowState; None from a robot.

    For the evaluation of a run alone: no controller sees it.
    """
    slots = np.frombuffer(data, wire.LOW_STATE)[0]["motor"][_TRUTH]
    if not (slots["mode"] == _TRUTH_MODE).all():
        return None
    return slots["q"][:3].astype(float), slots["dq"].astype(float)
