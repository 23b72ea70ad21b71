"""The reference replayed, as a baseline: its joint angles by inverse kinematics, and PD; nothing else is looked at.

The PD is stiffer than under a controller, for it has to carry the robot, too. With the reference's forces as
feed-forward it falls sooner, before it has walked: a walking body is never in balance on its standing feet, and forces
that do not see where it is tip it over.
"""

import time
from dataclasses import dataclass

import numpy as np

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain
from slomo.track.mpc import MpcConfig
from slomo.track.plan import Plan

Array = np.ndarray


STIFFER = (4.0, 2.0)  # times the PD's kp and kd: of 2 to 6 times kp, what lasted longest on a cat's walk


@dataclass(frozen=True)
class Replay(Plan):
    """A plan that no measurement changes."""

    def feedback(self, t: float, q: Array, v: Array) -> Array:
        """(C, 3) N: none."""
        return np.zeros((len(self.u_max) // 3, 3))


class OpenLoop:
    """A planner that always has the same plan: the reference.

    Args: as of `mpc.Mpc`; of the config nothing counts.
    """

    def __init__(self, model: PointFootModel, reference: Reference, *, terrain: Terrain, config: MpcConfig):
        self.reference = r = reference
        self._plan = Replay(
            t=r.t, q=r.q, v=r.v, u=r.u, lam=r.lam, gains=np.zeros((0, 0, 0)), u_max=model.u_max.ravel(), status=0,
            defect=0.0, seconds=0.0,
        )  # fmt: skip

    def reset(self) -> None:
        """Nothing to forget."""

    def warm_up(self) -> float:
        """As `mpc.Mpc.warm_up`."""
        start = time.perf_counter()
        self._plan.at(float(self._plan.t[0]))
        return time.perf_counter() - start

    def step(self, t: float, q: Array, v: Array, *, shift: Array | float = 0.0) -> Plan:
        """The reference."""
        return self._plan
