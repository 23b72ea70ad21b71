"""A deployment in virtual time with a controller that just stands, to do things to; and the pieces for real sockets."""

import random
from functools import cache
from pathlib import Path

import numpy as np

from slomo.deploy.brain import Motion, Reply
from slomo.deploy.config import Config
from slomo.deploy.drive import Drive
from slomo.deploy.go1 import Go1
from slomo.deploy.log import Log
from slomo.deploy.postures import Postures
from slomo.deploy.run import lying
from slomo.deploy.twin import Twin, TwinConfig
from slomo.deploy.virtual import DELAY, VirtualLink, perfect
from slomo.robot import load_robot
from slomo.terrain import Terrain
from slomo.track.joint_space import JointCommand

# Hurried, so that a run takes 2 s.
QUICK = Config(listen=0.2, fold=0.3, rise=0.4, stand=0.1, blend=0.1, lower=0.4, damp=0.2)
SECONDS = 0.6  # of the motion
PLAYS = QUICK.listen + QUICK.fold + QUICK.rise + QUICK.stand  # s, about when it begins
FAULT = PLAYS + 0.2  # s, when something is done to it


@cache
def go1():
    return load_robot("go1")


class Standing:
    """A controller that stands still for `seconds`."""

    def __init__(self, seconds: float = SECONDS):
        robot = go1()
        descent = Postures(robot).descent(robot.q_nominal)
        self.motion = Motion(robot.q_nominal, robot.q_nominal, -0.5, seconds - 0.5, robot.standing_height)
        zero = np.zeros(12)
        self.command = JointCommand(descent.joints[0], zero, descent.tau[0], np.full(12, 40.0), np.full(12, 1.0))
        self.started = self.asked = None

    def start(self, sample):
        self.started = sample

    def ask(self, t, samples):
        self.asked = t

    def answer(self, wait):
        return Reply(self.asked, self.command, np.zeros(19), np.zeros(18), self.asked, 0.1, 0)

    def close(self): ...


class Watched(VirtualLink):
    """Notes since when the twin's motors do nothing but brake, and does things to it at a given time."""

    def __init__(self, twin, *, at=FAULT, do=lambda link: None, **channels):
        super().__init__(twin, **channels)
        self.at, self.do, self.done = at, do, False
        self.damped_since = None

    def sleep_until(self, t):
        if not self.done and t >= self.at:
            self.done = True
            self.do(self)
        super().sleep_until(t)
        if self.now() > PLAYS:
            if not self.twin.damped:
                self.damped_since = None
            elif self.damped_since is None:
                self.damped_since = self.now()


def new_twin(**config):
    robot = go1()
    return Twin(robot, Terrain(), lying(None, robot), config=TwinConfig(**config))


def run(tmp_path: Path, *, do=lambda link: None, at=FAULT, brain=None, config=QUICK, stopped=lambda: None, **channels):
    """One run in which `do(link)` happens at `at`. Returns link, result (or exception), drive and log."""
    link = Watched(new_twin(), at=at, do=do, **channels)
    path = tmp_path / "run.log"
    log = Log(path, {}, seconds=10)
    drive = Drive(go1(), link, link, brain or Standing(), log, config=config, go1=Go1(go1()), stopped=stopped)
    try:
        result = drive.run()
    except RuntimeError as e:
        result = e
    log.close()
    return link, result, drive, path


def lossy(fraction, *, since=0.0, seed=0):
    """A channel that drops a fraction of the datagrams."""
    rng = random.Random(seed)
    return lambda data, t: [] if t >= since and rng.random() < fraction else perfect(data, t)


def late(seconds, *, since=0.0):
    """A channel whose delay is `seconds(t)`."""
    return lambda data, t: [(data, t + (seconds(t) if t >= since else DELAY), True)]
