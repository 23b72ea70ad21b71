"""The twin: a MuJoCo Go1 behind the Go1's wire format, with the motors' PD, torque limits and a watchdog on its side.

`Twin` is told the time and has no clock or socket of its own; `serve` puts it on a UDP port in real time.
"""

import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from slomo.deploy.config import HZ
from slomo.deploy.go1 import DAMPING_KD, TICK_HZ, Go1, RobotState
from slomo.deploy.link import BUFFER, LONGEST
from slomo.deploy.wire import Rejected
from slomo.errors import SlomoError
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.actuators import Motors
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorErrors, SensorSample, SimulatedSensors
from slomo.track.simulation import Simulation

Array = np.ndarray

MOTOR_HZ = 1000
WATCHDOG = 0.1  # s without a command, after which the motors are damped
RELEASE = 2.0  # s without a command, after which another client may take over
BEHIND = 0.2  # s, most that is caught up when the process was held up


@dataclass(frozen=True)
class TwinConfig:
    """How good the twin's sensors are, and what else it reports.

    Attributes:
        noise: whether the sensors have the biases, noise and delay of `track.sensors.SensorErrors`.
        friction: of the ground.
        battery: %.  temperature: degrees C, of the motors.
        seed: of biases and noise.
    """

    noise: bool = True
    friction: float = 0.8
    battery: int = 90
    temperature: float = 35.0
    seed: int = 0


class Twin:
    """The robot and what its firmware does.

    It obeys the first client that sends a whole command and no other until that one has been silent for RELEASE, and
    sends it a state every 1 / HZ s.

    Args:
        lying: (nq,) pose in which it is let down, under damping, before it takes commands.

    Attributes:
        client: (address, port) that it obeys, or None.
        counts: "accepted", "foreign", reasons of `wire.Rejected`, "watchdog".
        buttons: pressed on its remote.
    """

    def __init__(self, robot: Robot, terrain: Terrain, lying: Array, *, config: TwinConfig, scrambled: bool = False):
        self.config, self.robot = config, robot
        self.simulation = Simulation(robot, terrain, friction=config.friction, timestep=1 / MOTOR_HZ)
        self.client: tuple[str, int] | None = None
        self.counts: Counter[str] = Counter()
        self.buttons: frozenset[str] = frozenset()
        self.command: JointCommand | None = None
        self._go1 = Go1(robot, scrambled=scrambled)
        nj = len(robot.joint_names)
        errors = SensorErrors() if config.noise else SensorErrors(*[0.0] * len(fields(SensorErrors)))
        self._sensors = SimulatedSensors(nj, seed=config.seed, errors=errors)
        self._motors = Motors(robot)
        self._heard = -np.inf
        self._tau = np.zeros(nj)
        self._steps, self._origin = 0, 0.0
        self.simulation.reset(lying)
        for _ in range(MOTOR_HZ):
            self._step()
        self._steps = 0

    @property
    def damped(self) -> bool:
        """Whether nothing but damping acts on the motors."""
        return self.command is None or not (self.command.kp.any() or self.command.tau.any())

    def begin(self, now: float) -> None:
        """Its clock starts at `now` (s)."""
        self._origin = now - self._steps / MOTOR_HZ

    def receive(self, data: bytes, source: tuple[str, int], now: float) -> None:
        """A datagram. Never raises, whatever the bytes."""
        if self.client not in (None, source) and now - self._heard < RELEASE:
            self.counts["foreign"] += 1
            return
        try:
            self.command = self._go1.command(data)
        except Rejected as reason:
            self.counts[str(reason)] += 1
            return
        self.counts["accepted"] += 1
        self.client, self._heard = source, now

    def advance(self, now: float) -> list[bytes]:
        """Simulate up to `now` (s); the states that it sends meanwhile, if there is a client."""
        sent = []
        if now - self._origin - self._steps / MOTOR_HZ > BEHIND:
            self.counts["held up"] += 1
            self.begin(now)
        while (self._steps + 1) / MOTOR_HZ <= now - self._origin + 1e-9:
            if self.command is not None and self._origin + self._steps / MOTOR_HZ - self._heard > WATCHDOG:
                self.counts["watchdog"] += 1
                self.command = None
            self._step()
            if self._steps % (MOTOR_HZ // HZ) == 0 and self.client is not None:
                sent.append(self._state())
        return sent

    def _step(self) -> None:
        """The motors' PD, on their own encoders, for one step of the simulation; without a command they brake."""
        q, v, c = self.simulation.q[7:] + self._sensors.q_bias, self.simulation.v[6:], self.command
        asked = -DAMPING_KD * v if c is None else c.kp * (c.q - q) + c.kd * (c.v - v) + c.tau
        self._tau = self._motors.limited(asked, v)
        self.simulation.step(self._tau)
        self._steps += 1

    def _state(self) -> bytes:
        """What the sensors say now, and where the robot truly is."""
        q, v, t = self.simulation.q, self.simulation.v, self._steps / MOTOR_HZ
        sample = self._sensors.read(SensorSample(t, q[7:], v[6:], self._tau, v[3:6], self.simulation.acceleration))
        state = RobotState(
            sample=replace(sample, quat_xyzw=q[3:7]),
            tick=round(self._steps * TICK_HZ / MOTOR_HZ),
            temperature=np.full(len(v) - 6, self.config.temperature),
            foot_force=self.simulation.contacts()[0][:, 2],
            battery=self.config.battery,
            buttons=self.buttons,
        )
        return self._go1.state_datagram(state, body=(q[:3], q[3:7]))


def serve(twin: Twin, host: str, port: int, *, until: Callable[[], bool], say: Callable[[str], None]) -> None:
    """Run the twin in real time on a UDP port, until told otherwise.

    Raises:
        SlomoError: the port is in use.
    """
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        try:
            server.bind((host, port))
        except OSError as e:
            raise SlomoError(f"cannot listen on {host}:{port} ({e.strerror})", where="--port") from None
        say(f"listening on {host}:{server.getsockname()[1]}")
        client, warned = None, 0
        start = time.monotonic()
        twin.begin(start)
        k = 0
        while not until():
            k = max(k + 1, int((time.monotonic() - start) * HZ))
            server.settimeout(max(start + k / HZ - time.monotonic(), 1e-4))
            while time.monotonic() < start + k / HZ:
                try:
                    data, source = server.recvfrom(LONGEST)
                except (TimeoutError, ConnectionError):
                    break
                twin.receive(data, source, time.monotonic())
                server.settimeout(max(start + k / HZ - time.monotonic(), 1e-4))
            for datagram in twin.advance(time.monotonic()):
                if twin.client:
                    server.sendto(datagram, twin.client)
            if twin.client != client:
                client = twin.client
                say(f"obeys {client[0]}:{client[1]}" if client else "obeys nobody")
            if twin.counts["watchdog"] > warned:
                warned = twin.counts["watchdog"]
                say(f"watchdog: no command for {WATCHDOG:.1f} s, damping")
