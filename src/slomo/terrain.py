"""Ground: the plane z = 0 and, where they are, boxes, slopes and a height field instead of it.

Where several cover a place the highest one counts. Everything is a function of x and y (m, world).
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray


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
class Slope:
    """A plane z = height + slope_x (x - x_min) + slope_y (y - y_min) over a rectangle; m, slopes dz/dx and dz/dy."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float
    height: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0

    def __post_init__(self):
        values = (self.height, self.slope_x, self.slope_y)
        if not (self.x_min < self.x_max and self.y_min < self.y_max and np.all(np.isfinite(values))):
            raise InvalidData(f"needs x_min < x_max, y_min < y_max, finite slopes, got {self}", where="terrain slope")


@dataclass(frozen=True)
class HeightField:
    """Heights z (rows along x, columns along y; m) on a grid of `spacing` (m) from (x_min, y_min), bilinear between."""

    x_min: float
    y_min: float
    spacing: float
    z: tuple[tuple[float, ...], ...]

    def __post_init__(self):
        try:
            grid = np.array(self.z, float)
        except (TypeError, ValueError):
            grid = np.zeros(0)
        if grid.ndim != 2 or min(grid.shape) < 2 or not np.all(np.isfinite(grid)) or not self.spacing > 0:
            raise InvalidData("needs spacing > 0 and at least 2 x 2 finite heights", where="terrain field")
        rows: list[list[float]] = grid.tolist()  # pyright: ignore[reportAssignmentType]
        object.__setattr__(self, "z", tuple(tuple(row) for row in rows))

    def sample(self, xy: Array) -> tuple[Array, Array, Array]:
        """Height (...), its gradient (..., 2) and whether the field covers the points (..., 2 or more)."""
        grid = np.array(self.z)
        s = (xy[..., :2] - [self.x_min, self.y_min]) / self.spacing
        inside = np.all((s >= 0) & (s <= np.array(grid.shape) - 1), axis=-1)
        cell = np.clip(np.floor(s).astype(int), 0, np.array(grid.shape) - 2)
        part: Array = np.clip(s - cell, 0, 1)
        a, b = part[..., 0], part[..., 1]
        i, j = cell[..., 0], cell[..., 1]
        z00, z01, z10, z11 = grid[i, j], grid[i, j + 1], grid[i + 1, j], grid[i + 1, j + 1]
        z = (1 - a) * ((1 - b) * z00 + b * z01) + a * ((1 - b) * z10 + b * z11)
        dx = ((1 - b) * (z10 - z00) + b * (z11 - z01)) / self.spacing
        dy = ((1 - a) * (z01 - z00) + a * (z11 - z10)) / self.spacing
        return z, np.stack([dx, dy], axis=-1), inside


@dataclass(frozen=True)
class Terrain:
    """The highest of what covers a point, else the plane z = 0."""

    boxes: tuple[Box, ...] = ()
    slopes: tuple[Slope, ...] = ()
    field: HeightField | None = None

    def height(self, xy: Array) -> Array:
        """Ground height (m) under points. Args: xy (..., 2 or more) m, world. Returns (...)."""
        return self._surface(xy)[0]

    def normal(self, xy: Array) -> Array:
        """Unit normal (..., 3) of the ground under points (..., 2 or more)."""
        n = np.concatenate([-self._surface(xy)[1], np.ones((*np.shape(xy)[:-1], 1))], axis=-1)
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    def planes(self, xy: Array) -> Array:
        """(..., 4) the plane under each point f: unit normal n and offset d (m), so that its gap is n . f - d."""
        xy = np.asarray(xy, float)
        z, slope = self._surface(xy)
        n = np.concatenate([-slope, np.ones((*xy.shape[:-1], 1))], axis=-1)
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        d = np.sum(n[..., :2] * xy[..., :2], axis=-1) + n[..., 2] * z
        return np.concatenate([n, d[..., None]], axis=-1)

    def _surface(self, xy: Array) -> tuple[Array, Array]:
        """Height (...) and gradient (..., 2)."""
        xy = np.asarray(xy, float)
        z, slope = np.full(xy.shape[:-1], -np.inf), np.zeros((*xy.shape[:-1], 2))

        def cover(height: Array | float, gradient: Array | list[float], on: Array) -> None:
            nonlocal z
            higher = on & (height > z)
            slope[higher] = np.broadcast_to(gradient, slope.shape)[higher]
            z = np.where(higher, height, z)

        for b in self.boxes:
            cover(b.height, [0.0, 0.0], _inside(b, xy))
        for s in self.slopes:
            rise = s.height + s.slope_x * (xy[..., 0] - s.x_min) + s.slope_y * (xy[..., 1] - s.y_min)
            cover(rise, [s.slope_x, s.slope_y], _inside(s, xy))
        if self.field is not None:
            cover(*self.field.sample(xy))
        return np.where(np.isfinite(z), z, 0.0), slope

    def to_json(self) -> dict[str, Any]:
        """The content of `terrain.json`."""
        out: dict[str, Any] = {"boxes": [vars(b) for b in self.boxes]}
        if self.slopes:
            out["slopes"] = [vars(s) for s in self.slopes]
        if self.field is not None:
            out["field"] = vars(self.field)
        return out

    @classmethod
    def load(cls, path: Path) -> "Terrain":
        """Read a file of the form of `terrain.json`. Raises `InvalidData`."""
        try:
            data = json.loads(path.read_text())
        except OSError as e:
            raise InvalidData(e.strerror or "cannot be read", where=path) from None
        except (json.JSONDecodeError, UnicodeDecodeError) as e:
            raise InvalidData(f"is not JSON ({e})", where=path) from None
        try:
            return cls.from_json(data)
        except InvalidData as e:
            raise InvalidData(str(e), where=path) from None

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Terrain":
        """Inverse of `to_json`. Raises `InvalidData` on unknown or missing names."""
        known = [f.name for f in fields(cls)]
        if not isinstance(data, Mapping) or set(data) - set(known):
            raise InvalidData("has unknown entries", where="terrain", valid=known)
        if not all(isinstance(data.get(name, []), list | tuple) for name in ("boxes", "slopes")):
            raise InvalidData("boxes and slopes are lists", where="terrain")
        field = data.get("field")
        return cls(
            boxes=tuple(_make(Box, b) for b in data.get("boxes", ())),
            slopes=tuple(_make(Slope, s) for s in data.get("slopes", ())),
            field=None if field is None else _make(HeightField, field),
        )


def _inside(area: Box | Slope, xy: Array) -> Array:
    x, y = xy[..., 0], xy[..., 1]
    return (x >= area.x_min) & (x <= area.x_max) & (y >= area.y_min) & (y <= area.y_max)


def _make(kind: Any, values: Mapping[str, Any]) -> Any:
    names = [f.name for f in fields(kind)]
    try:
        return kind(**{k: v if k == "z" else float(v) for k, v in values.items()})
    except (TypeError, ValueError, AttributeError):
        raise InvalidData(
            f"a {kind.__name__.lower()} has unknown, missing or wrong entries", where="terrain", valid=names
        ) from None
