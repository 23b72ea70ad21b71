"""Ground of flat steps: the plane z = 0 and axis-aligned boxes on it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slomo.errors import InvalidData


@dataclass(frozen=True)
class Box:
    """A box from the ground up to `height` (m), over [x_min, x_max] x [y_min, y_max] (m, world)."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float
    height: float

    def __post_init__(self):
        if not (self.x_min < self.x_max and self.y_min < self.y_max and self.height > 0):
            raise InvalidData(f"needs x_min < x_max, y_min < y_max and height > 0, got {self}", where="terrain box")


@dataclass(frozen=True)
class Terrain:
    """The highest box under a point, else 0."""

    boxes: tuple[Box, ...] = ()

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Ground height (m) under points. Args: xy (..., 2 or more) m, world. Returns (...)."""
        xy = np.asarray(xy, float)
        z = np.zeros(xy.shape[:-1])
        for b in self.boxes:
            on = (xy[..., 0] >= b.x_min) & (xy[..., 0] <= b.x_max) & (xy[..., 1] >= b.y_min) & (xy[..., 1] <= b.y_max)
            z = np.where(on, np.maximum(z, b.height), z)
        return z

    def to_json(self) -> dict[str, Any]:
        """The content of `terrain.json`."""
        return {"boxes": [vars(b) for b in self.boxes]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Terrain":
        """Inverse of `to_json`. Raises `InvalidData` on unknown or missing names."""
        return cls.from_boxes(data.get("boxes", ()))

    @classmethod
    def from_boxes(cls, boxes: Iterable[Mapping[str, float]]) -> "Terrain":
        """From mappings with the fields of `Box`."""
        try:
            return cls(tuple(Box(**{k: float(v) for k, v in b.items()}) for b in boxes))
        except TypeError:
            raise InvalidData(
                "a box has unknown or missing fields", where="terrain", valid=Box.__annotations__
            ) from None
