"""The planners that a controller can have."""

from typing import Protocol

import numpy as np

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain
from slomo.track.convex_mpc import ConvexMpc
from slomo.track.mpc import Mpc, MpcConfig
from slomo.track.open_loop import OpenLoop
from slomo.track.plan import Plan

Array = np.ndarray


class Planner(Protocol):
    """Makes a plan from the state, at every tick."""

    reference: Reference

    def reset(self) -> None:
        """Forget the past."""
        ...

    def warm_up(self) -> float:
        """Compile what `step` needs; returns the seconds."""
        ...

    def step(self, t: float, q: Array, v: Array, *, shift: Array | float = 0.0) -> Plan:
        """Plan from the measured state, as `mpc.Mpc.step`."""
        ...


PLANNERS = {"ci-mpc": Mpc, "convex-mpc": ConvexMpc, "open-loop": OpenLoop}


def make_planner(
    name: str, model: PointFootModel, reference: Reference, *, terrain: Terrain, config: MpcConfig
) -> Planner:
    """The planner of that name, one of `PLANNERS`, for a reference in the world in which `terrain` is."""
    return PLANNERS[name](model, reference, terrain=terrain, config=config)
