"""The reference replayed, as a baseline: its joint angles by inverse kinematics, PD, its forces; the base is not looked
at."""

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain
from slomo.track.mpc import MpcConfig
from slomo.track.plan import Plan

Array = np.ndarray


@dataclass(frozen=True)
class Replay(Plan):
    """A plan that no measurement changes."""

    def feedback(self, t: float, q: Array, v: Array) -> Array:
        """(C, 3) N: the plan's forces as they are in the body's frame, turned into the world by where the body is.

        The joint layer turns them back by the same rotation, so that the joints get torques that do not depend on it.
        """
        p = self.at(t)
        turn = Rotation.from_quat(q[3:7]) * Rotation.from_quat(p.quat_xyzw).inv()
        return np.clip(turn.apply(p.u), -self.u_max.reshape(-1, 3), self.u_max.reshape(-1, 3))


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
