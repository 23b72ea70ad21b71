"""One run from end to end: controller, twin, link and log put together, and taken apart again."""

import contextlib
import gc
import multiprocessing
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slomo.deploy.approach import with_approach
from slomo.deploy.brain import Brain, InProcess, OwnProcess, Task, prefer
from slomo.deploy.config import Config
from slomo.deploy.drive import Drive, Result
from slomo.deploy.go1 import Go1
from slomo.deploy.link import LOOPBACK, Clock, Link, Muted, UdpLink, WallClock, is_loopback, resolve
from slomo.deploy.log import Log
from slomo.deploy.postures import STEP, Postures
from slomo.deploy.stops import Stops
from slomo.deploy.twin import Twin, TwinConfig, serve
from slomo.deploy.virtual import VirtualLink
from slomo.errors import Interrupted, SlomoError, UsageError
from slomo.motion import Reference
from slomo.robot import Robot, load_robot
from slomo.store import plain
from slomo.terrain import Terrain
from slomo.track.joint_space import JointSpace
from slomo.track.stage import Config as TrackConfig

Array = np.ndarray

TRANSPORTS = ("twin", "go1-udp")
TWIN_STARTS = 30.0  # s


@dataclass(frozen=True)
class Plan:
    """What is to be performed, by whom, how.

    Attributes:
        robot: name or path.
        reference, terrain: of `optimize`.  world: the ground of a twin of its own.
        track, deploy: parameters.
        identity: what `stage.identity` says of all this.
    """

    robot: str
    reference: Reference
    terrain: Terrain
    world: Terrain
    track: TrackConfig
    deploy: Config
    identity: dict[str, Any]

    @property
    def task(self) -> Task:
        return Task(self.robot, self.reference, self.terrain, self.track, self.deploy.rest)


@dataclass(frozen=True)
class Way:
    """How the robot is reached.

    Attributes:
        transport: "twin" (the one that listens on `port` of this computer, else one of its own) or "go1-udp".
        address, port: of the robot.  local_port: to send from; 0 for any.
        confirmed: the address that the user has confirmed, or that is only listened to (`dry`).
        scrambled: the check sum is.
        dry: nothing is sent: to a twin in virtual time, or from a robot only heard.
        realtime: ask the system for priority.
    """

    transport: str
    address: str
    port: int
    local_port: int
    confirmed: str | None = None
    scrambled: bool = False
    dry: bool = False
    realtime: bool = True


def check_way(
    transport: str, host: str | None, *, confirm: Callable[[str], bool], dry: bool = False, **rest: Any
) -> Way:
    """The way to the robot, confirmed where it leads out of this computer.

    Args:
        host: None for this computer.
        confirm: asks the user about an address.  dry: nothing will be sent there, so that nothing is asked.

    Raises:
        UsageError: an unknown transport, a host for the twin, no address, or not confirmed.
    """
    if transport not in TRANSPORTS:
        raise UsageError(f"no transport {transport!r}", where="--transport", valid=TRANSPORTS)
    address = resolve(host) if host is not None else LOOPBACK
    confirmed = None
    if not is_loopback(address):
        if transport == "twin":
            raise UsageError("a twin is in this computer", where="--robot-address", todo="use --transport go1-udp")
        if not dry and not confirm(address):
            raise UsageError(f"{address} was not confirmed, nothing was sent", where="--robot-address")
        confirmed = address
    return Way(transport=transport, address=address, confirmed=confirmed, dry=dry, **rest)


def perform(plan: Plan, way: Way, path: Path, *, stops: Stops, say: Callable[[str], None]) -> Result:
    """Stand up, play the motion, lie down; everything goes into the log at `path`.

    Raises:
        SlomoError: something could not be started, or it was stopped before; the robot has not been told anything then.
    """

    def go_on() -> None:
        if why := stops():
            what = f"stopped before the robot was told anything ({why[1]})"
            raise Interrupted(stops.number, what) if stops.number else SlomoError(what, where="deploy")

    robot = load_robot(plan.robot)
    go1 = Go1(robot, scrambled=way.scrambled)
    with contextlib.ExitStack() as stack:
        say("compiling the controller")
        virtual = way.dry and way.transport == "twin"
        brain: Brain = (
            InProcess(plan.task) if virtual else OwnProcess(InProcess, plan.task, realtime=way.realtime, waiting=go_on)
        )
        stack.callback(brain.close)
        link, clock = _reach(plan, way, robot, stack, say, virtual=virtual)
        stack.callback(link.close)
        go_on()
        priority = stack.enter_context(priority_of(way.realtime and not virtual))
        header = {
            "started": time.time(), "transport": way.transport, "address": f"{way.address}:{way.port}",
            "dry_run": way.dry, "priority": priority, "track": plain(plan.track), **plan.identity,
        }  # fmt: skip
        log = Log(path, header)
        stack.callback(log.close)
        drive = Drive(robot, link, clock, brain, log, config=plan.deploy, go1=go1, stopped=stops, say=say)
        return drive.run()


def _reach(
    plan: Plan, way: Way, robot: Robot, stack: contextlib.ExitStack, say: Callable[[str], None], *, virtual: bool
) -> tuple[Link, Clock]:
    if virtual:
        twin = Twin(robot, plan.world, lying(plan, robot), config=TwinConfig(), scrambled=way.scrambled)
        link = VirtualLink(twin)
        say("dry run: on a twin in virtual time, nothing is sent")
        return link, link
    if way.transport == "twin" and _free(way.port):
        say(f"no twin on port {way.port}; starting one")
        stack.enter_context(own_twin(plan, way))
    local = way.local_port if way.transport == "go1-udp" else 0
    link: Link = UdpLink((way.address, way.port), local=local, confirmed=way.confirmed)
    if way.dry:
        say("dry run: only listening, nothing is sent")
        link = Muted(link)
    return link, WallClock()


def lying(plan: Plan | None, robot: Robot) -> Array:
    """(nq,) the pose from which a twin lies down: folded up, at the place where the motion (if any) begins."""
    q = robot.q_nominal
    if plan is not None:
        reference = with_approach(plan.reference, robot, terrain=plan.terrain, track=plan.track, rest=plan.deploy.rest)
        q = JointSpace(robot).pose(reference.q[0])
    descent = Postures(robot).descent(q)
    q = np.concatenate([q[:7], descent.joints[-1]])
    q[2] -= STEP * (len(descent.joints) - 1)
    return q


@contextlib.contextmanager
def own_twin(plan: Plan, way: Way) -> Iterator[None]:
    """A twin in a process of its own, gone at the end."""
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_twin, args=(plan, way, ready, os.getpid()), daemon=True)
    process.start()
    try:
        if not ready.wait(TWIN_STARTS):
            raise SlomoError(f"did not start within {TWIN_STARTS:.0f} s", where="twin")
        yield
    finally:
        process.terminate()
        process.join()


def _twin(plan: Plan, way: Way, ready: Any, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    robot = load_robot(plan.robot)
    twin = Twin(robot, plan.world, lying(plan, robot), config=TwinConfig(), scrambled=way.scrambled)
    with priority_of(way.realtime):
        serve(twin, LOOPBACK, way.port, until=lambda: os.getppid() != parent, say=lambda text: ready.set())


def _free(port: int) -> bool:
    """Whether nobody listens on a UDP port of this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


@contextlib.contextmanager
def priority_of(realtime: bool) -> Iterator[str]:
    """No garbage collection inside the block, and, if possible, priority; yields which."""
    gc.collect()
    gc.disable()
    real = realtime and prefer(50)
    try:
        yield "realtime" if real else "ordinary"
    finally:
        if real:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        gc.enable()
