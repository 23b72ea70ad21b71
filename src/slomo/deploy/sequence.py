"""The phases of a run and what the joints do in those that are not the controller's."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slomo.deploy.config import Config
from slomo.deploy.postures import Descent, smooth
from slomo.track.joint_space import JointCommand

Array = np.ndarray

GRIP = 0.3  # s, in which the motors take hold of the pose that they find
ANSWER = 2.0  # s, in which the robot's first state must come


class Phase(StrEnum):
    """In this order; `DAMP` may come at any time."""

    LISTEN = "listen"
    FOLD = "fold"
    RISE = "rise"
    STAND = "stand"
    PLAY = "play"
    LOWER = "lower"
    DAMP = "damp"


ORDER = tuple(Phase)
UPRIGHT = (Phase.STAND, Phase.PLAY)


@dataclass
class Sequence:
    """Where the run is.

    Args:
        up, down: descents from the motion's first and last pose; `up` is gone through backwards.
        seconds: s, of the motion with its lead-in.

    Attributes:
        phase: and `since` (s) when; `joints` (nj,) rad: those measured when it began.
    """

    config: Config
    up: Descent
    down: Descent
    seconds: float
    phase: Phase = Phase.LISTEN
    since: float = 0.0

    def __post_init__(self):
        self.joints = self.up.joints[-1]

    def duration(self) -> float:
        """s, of the present phase."""
        c = self.config
        return {
            Phase.LISTEN: c.listen, Phase.FOLD: c.fold, Phase.RISE: c.rise, Phase.STAND: c.stand,
            Phase.PLAY: self.seconds, Phase.LOWER: c.lower, Phase.DAMP: c.damp,
        }[self.phase]  # fmt: skip

    def over(self, now: float) -> bool:
        """Whether the present phase has lasted as long as it should."""
        return now - self.since >= self.duration() - 1e-9

    def enter(self, phase: Phase, now: float, joints: Array) -> None:
        """Go on to a phase."""
        self.phase, self.since, self.joints = phase, now, joints

    def posture(self, now: float) -> JointCommand | None:
        """The command of this phase at a time (s); None for damping. While the controller plays, that of the stand."""
        c, nj = self.config, len(self.joints)
        kp, kd, zero = np.full(nj, c.stand_kp), np.full(nj, c.stand_kd), np.zeros(nj)
        part, T = now - self.since, max(self.duration(), 1e-9)
        s, rate = smooth(part / T)
        if self.phase == Phase.FOLD:
            to = self.up.joints[-1] - self.joints
            return JointCommand(self.joints + s * to, rate / T * to, zero, smooth(part / GRIP)[0] * kp, kd)
        if self.phase == Phase.RISE:
            joints, tau = self.up.at(1 - s)
            before, _ = self.up.at(1 - smooth((part - 0.01) / T)[0])
            return JointCommand(joints, (joints - before) / 0.01, smooth(part / GRIP)[0] * tau, kp, kd)
        if self.phase in UPRIGHT:
            return JointCommand(self.up.joints[0], zero, self.up.tau[0], kp, kd)
        if self.phase == Phase.LOWER:
            joints, tau = self.down.at(s)
            apart = self.joints - self.down.joints[0]  # from where the descent was thought to begin; fades away
            before, _ = self.down.at(smooth((part - 0.01) / T)[0])
            return JointCommand(joints + (1 - s) * apart, (joints - before) / 0.01 - rate / T * apart, tau, kp, kd)
        return None
