"""Flesh: cones that bones carry, meshed as one smooth skin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from warp.geometry import IsoSurfaceMarchingCubes


@dataclass(frozen=True)
class Cone:
    """A capsule with two radii (m) that bone `bone` carries."""

    bone: int
    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float

    def along(self, x: np.ndarray) -> np.ndarray:
        """(...,) fraction of the axis that is nearest to points (..., 3)."""
        d = self.b - self.a
        return np.clip((x - self.a) @ d / max(d @ d, 1e-12), 0, 1)

    def distance(self, x: np.ndarray) -> np.ndarray:
        """(...,) m of points (..., 3) from the surface, negative inside."""
        s = self.along(x)
        return np.linalg.norm(x - self.a - s[..., None] * (self.b - self.a), axis=-1) - (
            self.ra + s * (self.rb - self.ra)
        )


def mesh(cones: Sequence[Cone], *, cell: float, blend: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m and triangles (F, 3) of the smooth union of cones, by marching cubes.

    Args:
        cell: m, of the grid.  blend: m, over which surfaces flow into each other.
    """
    ends = np.stack([e for c in cones for e in (c.a, c.b)])
    reach = max(max(c.ra, c.rb) for c in cones) + 6 * blend
    lower, upper = ends.min(0) - reach, ends.max(0) + reach
    shape = np.ceil((upper - lower) / cell).astype(int) + 1
    axes = [lower[k] + cell * np.arange(shape[k]) for k in range(3)]
    total = np.zeros(tuple(shape))
    for c in cones:
        # Farther than a few blends from its surface a cone adds nothing: only its box is evaluated.
        far = max(c.ra, c.rb) + 8 * blend
        low, high = np.minimum(c.a, c.b) - far, np.maximum(c.a, c.b) + far
        box = [slice(*np.searchsorted(axes[k], [low[k], high[k]])) for k in range(3)]
        grid = np.stack(np.meshgrid(*(axes[k][box[k]] for k in range(3)), indexing="ij"), -1)
        total[tuple(box)] += np.exp(np.clip(-c.distance(grid) / blend, -60, 60))
    field = wp.array((-blend * np.log(total + 1e-20)).astype(np.float32), dtype=float, device="cpu")
    vertices, faces = IsoSurfaceMarchingCubes.extract(
        field,  # pyright: ignore[reportArgumentType]
        0.0,
        lower=wp.vec3(*lower),
        upper=wp.vec3(*(lower + cell * (shape - 1))),
    )
    return vertices.numpy().astype(float), faces.numpy().reshape(-1, 3)


def value_noise(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(V,) smooth noise in [0, 1], cell 1, from points (V, 3)."""
    table = rng.random((32, 32, 32))
    i = np.floor(x).astype(int)
    f = x - i
    f = f * f * (3 - 2 * f)
    near, far = i % 32, (i + 1) % 32
    weight, place = [1 - f, f], [near, far]
    out = np.zeros(len(x))
    for a, b, c in np.ndindex(2, 2, 2):
        w = weight[a][:, 0] * weight[b][:, 1] * weight[c][:, 2]
        out += w * table[place[a][:, 0], place[b][:, 1], place[c][:, 2]]
    return out
