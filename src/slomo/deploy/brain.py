"""The tracking controller, as the loop sees it: in this process, or in one of its own.

On a robot it runs in its own, so that the supervisor goes on when a plan takes long, hangs or kills its process.
"""

import gc
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Protocol

import numpy as np

from slomo.deploy.approach import with_approach
from slomo.errors import SlomoError
from slomo.motion import Reference
from slomo.terrain import Terrain
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorSample
from slomo.track.stage import Config

Array = np.ndarray

READY_SECONDS = 180.0  # for imports and compilation


@dataclass(frozen=True)
class Motion:
    """What the loop must know of the motion.

    Attributes:
        first, last: (nq,) poses in which it begins and ends.
        start, end: s, on the reference's clock, with the lead-in.
        lowest: m, lowest height of the base over the lowest foot.
    """

    first: Array
    last: Array
    start: float
    end: float
    lowest: float


@dataclass(frozen=True)
class Reply:
    """A command and what it came from.

    Attributes:
        t: s, on the reference's clock, for which it was asked.
        q: (nq,) and v: (nv,), the estimated state.
        mpc_t: s, mpc_ms: wall time, mpc_status: of the last plan.
    """

    t: float
    command: JointCommand
    q: Array
    v: Array
    mpc_t: float
    mpc_ms: float
    mpc_status: int


class Died(Exception):
    """The controller's process has ended; the text says what it said last."""


class Brain(Protocol):
    """Something that turns samples into commands."""

    motion: Motion

    def start(self, sample: SensorSample) -> None:
        """The robot stands at rest in about the first pose."""
        ...

    def ask(self, t: float, samples: list[SensorSample]) -> None:
        """Ask for a command for time t (s); the samples are new since the last call, on the same clock."""
        ...

    def answer(self, wait: float) -> Reply | None:
        """The command that was asked for last; if it is not there within `wait` (s), an earlier one that has not been
        given yet, or None. Raises `Died`."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Task:
    """Everything that a controller is made from; can be sent to another process. rest: see `with_approach`."""

    robot: str
    reference: Reference
    terrain: Terrain
    config: Config
    rest: float

    def make(self):
        """The controller, compiled."""
        from slomo.robot import load_robot
        from slomo.track.controller import Controller

        robot = load_robot(self.robot)
        reference = with_approach(self.reference, robot, terrain=self.terrain, track=self.config, rest=self.rest)
        controller = Controller(robot, reference, terrain=self.terrain, config=self.config)
        controller.warm_up()
        return controller


class InProcess:
    """The controller here: deterministic, for virtual time and for study."""

    def __init__(self, task: Task):
        self._controller = c = task.make()
        height = c.reference.q[:, 2] - c.reference.points[..., 2].min(axis=1)
        self.motion = Motion(
            first=c.first_pose, last=c.joints.pose(c.reference.q[-1]), start=float(c.reference.t[0]),
            end=float(c.reference.t[-1]), lowest=float(height.min()),
        )  # fmt: skip
        self._reply: Reply | None = None

    def start(self, sample: SensorSample) -> None:
        self._controller.start(sample)

    def ask(self, t: float, samples: list[SensorSample]) -> None:
        c = self._controller
        for sample in samples:
            c.sense(sample)
        command, plan = c.command(t), c.plan
        assert plan is not None
        self._reply = Reply(t, command, *c.estimate(t), float(plan.t[0]), 1e3 * plan.seconds, plan.status)

    def answer(self, wait: float) -> Reply | None:
        reply, self._reply = self._reply, None
        return reply

    def close(self) -> None: ...


class OwnProcess:
    """The controller in a process of its own, started here and gone with this one.

    Args:
        make: makes the brain there; a top-level function, or a `Task`'s.
        realtime: ask the system to run it before ordinary processes.
        waiting: called again and again until it is ready; may raise.

    Raises:
        SlomoError: it did not get ready.
    """

    def __init__(
        self,
        make: Callable[..., Brain],
        *args,
        realtime: bool = True,
        waiting: Callable[[], None] = lambda: None,
    ):
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, make, args, realtime), daemon=True)
        self._process.start()
        theirs.close()
        try:
            self.motion = self._wait(waiting)
        except BaseException:
            self.close()
            raise
        self._asked = -np.inf

    def _wait(self, waiting: Callable[[], None]) -> Motion:
        until = time.monotonic() + READY_SECONDS
        while not self._pipe.poll(0.1):
            waiting()
            if time.monotonic() > until:
                raise SlomoError(f"not ready after {READY_SECONDS:.0f} s", where="controller")
        try:
            return self._receive()
        except Died as e:
            raise SlomoError(f"did not start: {e}", where="controller") from None

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def start(self, sample: SensorSample) -> None:
        self._send((None, [sample]))

    def ask(self, t: float, samples: list[SensorSample]) -> None:
        self._asked = t
        self._send((t, samples))

    def answer(self, wait: float) -> Reply | None:
        newest, until = None, time.monotonic() + wait
        while (newest is None or newest.t < self._asked) and self._pipe.poll(max(0.0, until - time.monotonic())):
            newest = self._receive()
        return newest

    def close(self) -> None:
        self._pipe.close()
        self._process.join(0.2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _send(self, message: tuple[float | None, list[SensorSample]]) -> None:
        try:
            self._pipe.send(message)
        except OSError:
            raise Died("it is gone") from None

    def _receive(self):
        try:
            message = self._pipe.recv()
        except (EOFError, OSError):
            raise Died("it is gone") from None
        if isinstance(message, str):
            raise Died(message)
        return message


def _serve(pipe: Connection, make: Callable[..., Brain], args: tuple, realtime: bool) -> None:
    """The other process: tell the motion, then answer. Samples of questions that have piled up are all taken, but only
    the last of them is answered."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that holds the robot
    try:
        brain = make(*args)
        gc.collect()
        gc.freeze()
        gc.disable()
        if realtime:
            prefer(40)
        pipe.send(brain.motion)
        while True:
            t, samples = pipe.recv()
            while t is not None and pipe.poll():
                later, more = pipe.recv()
                t, samples = (later, samples + more) if later is not None else (None, more)
            if t is None:
                brain.start(samples[-1])
                continue
            brain.ask(t, samples)
            pipe.send(brain.answer(0))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as e:
        last = traceback.extract_tb(e.__traceback__)[-1]
        pipe.send(f"{type(e).__name__}: {e} ({os.path.basename(last.filename)}:{last.lineno})")


def prefer(priority: int) -> bool:
    """Ask the system to run this process before all ordinary ones; whether it does (it needs the right to)."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def on_clock(sample: SensorSample, shift: float) -> SensorSample:
    """The sample on a clock that shows `shift` (s) more."""
    return replace(sample, t=sample.t + shift)
