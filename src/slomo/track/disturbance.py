"""What the world does to the robot that the plan does not know."""

import re
from dataclasses import dataclass, replace

import numpy as np

from slomo.errors import UsageError
from slomo.terrain import Terrain

Array = np.ndarray

PUSH_SECONDS = 0.1
_NUMBER = r"-?\d+(?:\.\d*)?|-?\.\d+"


@dataclass(frozen=True)
class Push:
    """A horizontal push on the trunk at the base's origin, constant for `PUSH_SECONDS`.

    Attributes:
        impulse: N s.  time: s, when it begins, on the reference's clock.
        direction: degrees, in the world from x to y.
    """

    impulse: float
    time: float
    direction: float

    @classmethod
    def parse(cls, text: str) -> "Push":
        """Of "12@1.5,90": 12 N s at 1.5 s towards +y. Raises `UsageError`."""
        m = re.fullmatch(rf"\s*({_NUMBER})\s*@\s*({_NUMBER})\s*,\s*({_NUMBER})\s*", text)
        if not m:
            raise UsageError(f"no push {text!r}", where="track.push", todo="give N s @ s , degrees: 12@1.5,90")
        return cls(*map(float, m.groups()))

    def force(self, t: float) -> Array:
        """(3,) N, world, at time t."""
        if not self.time <= t < self.time + PUSH_SECONDS:
            return np.zeros(3)
        a = np.radians(self.direction)
        return self.impulse / PUSH_SECONDS * np.array([np.cos(a), np.sin(a), 0.0])


@dataclass(frozen=True)
class Disturbance:
    """How the simulated world differs from the planned one. The defaults are no difference.

    Attributes:
        friction_scale: times the ground's friction coefficient.
        payload: kg, a box on the trunk.  mass_scale: times mass and inertia of every link.
        pushes: on the trunk.
        latency: s, more from command to motor than the actuators have anyway.
        step_height: m, added to the height of every box of the terrain.
        seed: of the sensors' biases and noise.
    """

    friction_scale: float = 1.0
    payload: float = 0.0
    mass_scale: float = 1.0
    pushes: tuple[Push, ...] = ()
    latency: float = 0.0
    step_height: float = 0.0
    seed: int = 0

    def force(self, t: float) -> Array:
        """(3,) N, world, of all pushes at time t (s)."""
        return sum((push.force(t) for push in self.pushes), np.zeros(3))

    def ground(self, terrain: Terrain) -> Terrain:
        """The terrain with its boxes `step_height` higher; one that would vanish is left out."""
        h = self.step_height
        return replace(terrain, boxes=tuple(replace(b, height=b.height + h) for b in terrain.boxes if b.height + h > 0))
