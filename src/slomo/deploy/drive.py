"""The loop that holds the robot: states in, supervisor, phases, command out, all written down, at 500 Hz."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slomo.deploy.brain import Brain, Died, Reply, on_clock
from slomo.deploy.config import HZ, Config
from slomo.deploy.go1 import Go1, RobotState, truth
from slomo.deploy.link import Clock, Link
from slomo.deploy.log import SENT, Log
from slomo.deploy.postures import Postures, blend
from slomo.deploy.receiver import Receiver
from slomo.deploy.sequence import ANSWER, ORDER, UPRIGHT, Phase, Sequence
from slomo.deploy.supervisor import CAUSES, Cause, Supervisor, Trip
from slomo.robot import Robot
from slomo.track.joint_space import JointCommand

Array = np.ndarray

PERIOD = 1 / HZ
ANSWER_BY = 0.8  # of a period: when a command must be there to be sent in it


@dataclass(frozen=True)
class Result:
    """trip: None or why the run was stopped; `counts`: datagrams; ticks: made, and missed (no time for them)."""

    trip: Trip | None
    counts: dict[str, int]
    ticks: int
    missed: int


class Drive:
    """One run.

    Args:
        stopped: asked at every tick: None, or (cause, detail) to stop for.
        say: told of every phase and trip.
    """

    def __init__(
        self,
        robot: Robot,
        link: Link,
        clock: Clock,
        brain: Brain,
        log: Log,
        *,
        config: Config,
        go1: Go1,
        stopped: Callable[[], tuple[Cause, str] | None] = lambda: None,
        say: Callable[[str], None] = lambda text: None,
    ):
        self.link, self.clock, self.brain, self.log = link, clock, brain, log
        self.config, self.stopped, self.say = config, stopped, say
        motion, postures = brain.motion, Postures(robot)
        self.sequence = Sequence(
            config, postures.descent(motion.first), postures.descent(motion.last), motion.end - motion.start
        )
        self._begin = self._next = clock.now()
        self.supervisor = Supervisor(robot, config, lowest=motion.lowest, begin=self._begin)
        self._go1, self._receiver = go1, Receiver(go1)
        self._samples: list[RobotState] = []
        self._truth = np.full(7, np.nan)
        self._reply: Reply | None = None
        self._held = False
        self._shift = 0.0  # s, from the driver's clock to the motion's
        self._ticks = self._missed = 0

    def run(self) -> Result:
        """From listening to damping. Whatever happens on the way, it ends with the robot in damping."""
        try:
            self.sequence.enter(Phase.LISTEN, self._begin, self.sequence.joints)
            while self.sequence.phase != Phase.DAMP:
                self._tick()
        except Exception as e:
            self.supervisor.stop(Cause.ERROR, self.clock.now(), f"{type(e).__name__}: {e}")
            raise
        finally:
            self._let_down()
        counts = dict(self._receiver.counts) | dict(getattr(self.link, "counts", {}))
        return Result(self.supervisor.trip, counts, self._ticks, self._missed)

    def _tick(self) -> None:
        """Wait for the next tick; see, supervise, send, write down."""
        self._wait()
        now = self.clock.now()
        self._receive()
        command = self._play(now)
        self.link.send(self._go1.command_datagram(command) if command else self._go1.damping_datagram())
        self._write(now, "servo" if command else "damping", command)

    def _wait(self) -> None:
        """Until the next tick; those for which it is too late are left out."""
        self._next += PERIOD
        skipped = max(0, int((self.clock.now() - self._next) / PERIOD))
        self._next += skipped * PERIOD
        self._missed += skipped
        self._ticks += 1
        self.clock.sleep_until(self._next)

    def _receive(self) -> None:
        for data, arrival in self.link.receive():
            if state := self._receiver.take(data, arrival):
                self.supervisor.see(state, arrival)
                self._samples.append(state)
                body = truth(data)
                self._truth = np.full(7, np.nan) if body is None else np.concatenate(body)

    def _play(self, now: float) -> JointCommand | None:
        """Supervise, go on to the next phase when it is time, and get this tick's command."""
        supervisor, sequence = self.supervisor, self.sequence
        if why := self.stopped():
            supervisor.stop(why[0], now, why[1])
        supervisor.watch(now)
        self._advance(now)
        if sequence.phase in (Phase.LISTEN, Phase.DAMP):
            return None
        wanted = sequence.posture(now)
        try:
            if sequence.phase == Phase.PLAY:
                wanted = self._controlled(now, wanted)
        except Died as e:
            supervisor.stop(Cause.DEAD, now, str(e))
        allowed = supervisor.allow(wanted, now)
        if supervisor.trip:
            self._enter(Phase.DAMP, now)
        return allowed

    def _advance(self, now: float) -> None:
        """The next phase, where it is time for one."""
        supervisor, sequence = self.supervisor, self.sequence
        state, phase = supervisor.state, sequence.phase
        if supervisor.trip:
            self._enter(Phase.DAMP, now)
        elif supervisor.landing and phase in (*UPRIGHT, Phase.RISE):
            self._enter(Phase.LOWER, now)
        elif state is None:
            sequence.since = now  # it listens from the first answer on
            if now - self._begin > ANSWER:
                supervisor.stop(Cause.SILENT, now, f"no answer within {ANSWER:.0f} s")
                self._enter(Phase.DAMP, now)
        elif sequence.over(now):
            if phase == Phase.LISTEN:
                supervisor.ready(now)
            elif phase == Phase.STAND:
                self._shift = self.brain.motion.start - now
                self.brain.start(on_clock(state.sample, self._shift))
                self._samples.clear()
            elif phase == Phase.LOWER and supervisor.landing:
                supervisor.stop(supervisor.landing.cause, now, supervisor.landing.detail)
            self._enter(Phase.DAMP if supervisor.trip else ORDER[ORDER.index(phase) + 1], now)

    def _enter(self, phase: Phase, now: float) -> None:
        if phase == self.sequence.phase:
            return
        state = self.supervisor.state
        self.sequence.enter(phase, now, state.sample.q if state else self.sequence.joints)
        self.supervisor.upright = phase in UPRIGHT
        why = self.supervisor.trip if phase == Phase.DAMP else self.supervisor.landing
        self.say(f"{now - self._begin:.2f} s: {phase}" + (f" ({why})" if why else ""))

    def _controlled(self, now: float, stand: JointCommand | None) -> JointCommand | None:
        """The controller's newest command, which at first only gradually takes over from standing."""
        samples = [on_clock(state.sample, self._shift) for state in self._samples]
        self._samples.clear()
        self.brain.ask(now + self._shift, samples)
        reply = self.brain.answer(max(0.0, self._next + ANSWER_BY * PERIOD - self.clock.now()))
        self._held = reply is None
        if reply is None:
            return None
        self._reply = reply
        share = (now - self.sequence.since) / self.config.blend
        return blend(stand, reply.command, share) if stand and share < 1 else reply.command

    def _let_down(self) -> None:
        """Damping for a while, then the motors off; nothing here may fail."""
        self.supervisor.rest()
        damping, off = self._go1.damping_datagram(), self._go1.off_datagram()
        self.sequence.enter(Phase.DAMP, self.clock.now(), self.sequence.joints)
        while not self.sequence.over(self.clock.now()):
            self.link.send(damping)
            with contextlib.suppress(Exception):
                self._wait()
                self._receive()
                self._write(self.clock.now(), "damping", None)
        self.link.send(off)
        with contextlib.suppress(Exception):
            self._write(self.clock.now(), "off", None)

    def _write(self, now: float, sent: str, command: JointCommand | None) -> None:
        r, state, reply = self.log.record, self.supervisor.state, self._reply
        r["t"], r["late"] = now - self._begin, now - self._next
        r["phase"], r["sent"] = ORDER.index(self.sequence.phase), SENT.index(sent)
        trip = self.supervisor.trip
        r["trip"], r["why"] = (1 + CAUSES.index(trip.cause), str(trip).encode()[:120]) if trip else (0, b"")
        r["reference_t"] = now + self._shift if self.sequence.phase == Phase.PLAY else np.nan
        if state:
            s = state.sample
            r["state_t"], r["tick"], r["battery"] = s.t - self._begin, state.tick, state.battery
            r["q"], r["v"], r["tau"], r["temperature"] = s.q, s.v, s.tau, state.temperature
            r["gyro"], r["acceleration"], r["foot_force"] = s.gyro, s.acceleration, state.foot_force
            r["quat_xyzw"] = np.nan if s.quat_xyzw is None else s.quat_xyzw
        r["truth"] = self._truth
        for name in ("q", "v", "tau"):
            r[f"{name}_des"] = getattr(command, name) if command else 0
        r["kp"], r["kd"] = (command.kp, command.kd) if command else (0, 0)
        if reply:
            r["q_est"], r["v_est"] = reply.q, reply.v
            r["mpc_t"], r["mpc_ms"], r["mpc_status"] = reply.mpc_t, reply.mpc_ms, reply.mpc_status
        r["held"] = self._held and self.sequence.phase == Phase.PLAY
        counts = self._receiver.counts
        r["accepted"], r["rejected"] = counts["accepted"], counts.total() - counts["accepted"]
        self.log.append()
