"""`Terrain` in MuJoCo: the same surface, to be stood on."""

from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from slomo.terrain import HeightField, Slope, Terrain

DEPTH = 1.0  # m, how thick slopes and height fields are below their lowest point
FINER = 4  # times as many points of a height field
FAR = 1000.0  # m, where the ground ends if it has a hole


def add_ground(spec: mujoco.MjSpec, terrain: Terrain, *, friction: float, **geom: Any) -> None:
    """Floor, boxes, slopes and height field, as fixed geometries.

    The floor is the plane z = 0; where a slope or a height field goes below it, the floor has a hole of its outline.

    Args:
        friction: Coulomb coefficient.  geom: further attributes of each geometry (contype, conaffinity, solref).
    """
    common = {"friction": [friction, 0.005, 1e-4], **geom}
    add = spec.worldbody.add_geom
    patches = [*terrain.boxes, *terrain.slopes, *([_Outline(terrain.field)] if terrain.field else [])]
    if min((_corners(s)[:, 2].min() for s in terrain.slopes), default=0.0) < 0 or (
        terrain.field and np.min(terrain.field.z) < 0
    ):
        for i, (x0, x1, y0, y1) in enumerate(_around(patches)):
            size = [(x1 - x0) / 2, (y1 - y0) / 2, DEPTH / 2]
            centre = [(x0 + x1) / 2, (y0 + y1) / 2, -DEPTH / 2]
            add(name=f"floor{i}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=size, **common)
    else:
        add(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **common)
    for i, b in enumerate(terrain.boxes):
        size = [(b.x_max - b.x_min) / 2, (b.y_max - b.y_min) / 2, b.height / 2]
        centre = [(b.x_min + b.x_max) / 2, (b.y_min + b.y_max) / 2, b.height / 2]
        add(name=f"box{i}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=size, **common)
    for i, s in enumerate(terrain.slopes):
        top = _corners(s)
        bottom = np.column_stack([top[:, :2], np.full(4, top[:, 2].min() - DEPTH)])
        spec.add_mesh(name=f"slope{i}", uservert=np.vstack([top, bottom]).ravel())
        add(name=f"slope{i}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"slope{i}", **common)
    if terrain.field is not None:
        _add_field(spec, terrain.field, common)


def _add_field(spec: mujoco.MjSpec, field: HeightField, common: dict[str, Any]) -> None:
    # MuJoCo has two triangles between four points, a terrain's surface is bilinear: on finer points they are alike.
    rows, columns = (FINER * (n - 1) + 1 for n in np.shape(field.z))
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1) * field.spacing / FINER
    z, _, _ = field.sample(grid * (1 - 1e-12) + [field.x_min, field.y_min])
    half = field.spacing / FINER * (np.array(z.shape) - 1) / 2
    # MuJoCo scales the heights to 0..1 of the size's third number; a flat field needs some.
    spec.add_hfield(
        name="field", nrow=z.shape[1], ncol=z.shape[0], userdata=(z.T - z.min()).ravel(),
        size=[*half, max(np.ptp(z), 1e-6), DEPTH],
    )  # fmt: skip
    spec.worldbody.add_geom(
        name="field", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field",
        pos=[field.x_min + half[0], field.y_min + half[1], z.min()], **common,
    )  # fmt: skip


class _Outline:
    """The rectangle of a height field, named as a box's."""

    def __init__(self, field: HeightField):
        rows, columns = np.shape(field.z)
        self.x_min, self.y_min = field.x_min, field.y_min
        self.x_max, self.y_max = field.x_min + field.spacing * (rows - 1), field.y_min + field.spacing * (columns - 1)


def _corners(s: Slope) -> np.ndarray:
    """(4, 3) m, of the slope's surface."""
    x, y = (a.ravel() for a in np.meshgrid([s.x_min, s.x_max], [s.y_min, s.y_max]))
    return np.column_stack([x, y, s.height + s.slope_x * (x - s.x_min) + s.slope_y * (y - s.y_min)])


def _around(patches: list[Any]) -> list[tuple[float, float, float, float]]:
    """Rectangles (x_min, x_max, y_min, y_max) that cover the plane but for the patches."""
    xs = sorted({-FAR, FAR, *(e for p in patches for e in (p.x_min, p.x_max))})
    ys = sorted({-FAR, FAR, *(e for p in patches for e in (p.y_min, p.y_max))})
    cells = [(x0, x1, y0, y1) for x0, x1 in pairwise(xs) for y0, y1 in pairwise(ys)]
    return [
        (x0, x1, y0, y1)
        for x0, x1, y0, y1 in cells
        if not any(p.x_min <= x0 and x1 <= p.x_max and p.y_min <= y0 and y1 <= p.y_max for p in patches)
    ]
