"""A ray-caster over triangle meshes in Warp (CPU or GPU): needs no OpenGL and no display.

One ray a sample, one shadow ray to one sun, ambient light from the sky, a textured ground plane z = 0. World frame:
metres, z up. Cameras: OpenCV convention, pixel centres at integer coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import warp as wp

from slomo.mesh import vertex_normals
from slomo.raycast_kernel import LightStruct, cast

SKY, GROUND = -1, 0  # ids of what is no part

GROUNDS = ("none", "meadow", "tiles")


@dataclass(frozen=True)
class Part:
    """A coloured mesh that moves as one.

    Attributes:
        vertices: (V, 3) m, in the part's own frame.  triangles: (F, 3).
        colors: (V, 3) or (3,) sRGB in [0, 1].
        id: positive number of the part in `Image.ids`; parts may share one.
        grain: relative contrast of a fine texture fixed to `vertices`.  grain_size: m, its cell.
        smooth: interpolate normals over shared vertices; else each triangle is flat.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    id: int = 1
    grain: float = 0.0
    grain_size: float = 0.01
    smooth: bool = True


@dataclass(frozen=True)
class Light:
    """The world around the parts.

    Attributes:
        sun: direction to the sun (need not be a unit vector).  sun_strength, ambient: irradiance, 1 = full white.
        ground: "none", "meadow" (grass, earth, leaves) or "tiles" (metre squares).  ground_scale: size of its texture.
        zenith, horizon: sRGB of the sky.  hills: height of far hills, in radians.  fog: m, where 63 % is haze.
    """

    sun: tuple[float, float, float] = (0.4, -0.5, 0.9)
    sun_strength: float = 0.85
    ambient: float = 0.45
    ground: str = "meadow"
    ground_scale: float = 1.0
    zenith: tuple[float, float, float] = (0.38, 0.56, 0.82)
    horizon: tuple[float, float, float] = (0.80, 0.86, 0.90)
    hills: float = 0.0
    fog: float = 60.0


@dataclass(frozen=True)
class Image:
    """A rendered frame of H x W pixels with S samples each (S = supersample squared).

    Attributes:
        rgb: (H, W, 3) uint8, mean over the samples.
        ids: (H, W, S) part id, 0 = ground, -1 = sky.
        depth: (H, W, S) m along the optical axis, inf in the sky.
        points: (H, W, S, 3) m, world point that the ray hit (arbitrary in the sky).
        faces: (H, W, S) triangle that was hit, counted from the first of the first part; -1 for none.
        weights: (H, W, S, 3) barycentric weights of the triangle's corners there.
    """

    rgb: np.ndarray
    ids: np.ndarray
    depth: np.ndarray = field(repr=False)
    points: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)

    def mask(self, id: int) -> np.ndarray:
        """(H, W) bool: at least half of the pixel's samples see part `id`."""
        return (self.ids == id).mean(-1) >= 0.5


class _Hits(NamedTuple):
    """Linear colour (n, 3), id, depth, point (n, 3), face and barycentric u, v (n, 2) of n rays."""

    rgb: np.ndarray
    ids: np.ndarray
    depth: np.ndarray
    points: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


def _linear(srgb) -> np.ndarray:
    return np.asarray(srgb, np.float32) ** 2.2


class Scene:
    """Parts in one bounding-volume hierarchy, moved frame by frame.

    Args:
        parts: name -> part.
        light: sun, sky and ground.
        device: a Warp device; None is the GPU when there is one, else the CPU.
    """

    def __init__(self, parts: Mapping[str, Part], light: Light | None = None, *, device: str | None = None):
        light = light or Light()
        self.device = wp.get_device(device)
        vertices, triangles, colors, ids, grain = [], [], [], [], []
        self._slices: dict[str, slice] = {}
        self._triangles: dict[str, np.ndarray] = {}
        n = 0
        for name, part in parts.items():
            v, f = np.asarray(part.vertices, np.float32), np.asarray(part.triangles, np.int32)
            c = np.broadcast_to(np.asarray(part.colors, np.float32), v.shape)
            self._triangles[name] = f
            if not part.smooth:
                v, c, f = v[f.ravel()], c[f.ravel()], np.arange(3 * len(f), dtype=np.int32).reshape(-1, 3)
            self._slices[name] = slice(n, n + len(v))
            vertices.append(v)
            triangles.append(f + n)
            colors.append(_linear(c))
            ids.append(np.full(len(f), part.id, np.int32))
            grain.append(np.tile(np.array([[part.grain, part.grain_size]], np.float32), (len(f), 1)))
            n += len(v)
        self._flat = {name for name, part in parts.items() if not part.smooth}
        self._local = np.concatenate(vertices)
        self._world = self._local.copy()
        self._faces = np.concatenate(triangles)
        self._local_normals = vertex_normals(self._local, self._faces)
        self._world_normals = self._local_normals.copy()
        with wp.ScopedDevice(self.device):
            self._colors = wp.array(np.concatenate(colors), dtype=wp.vec3)
            self._rest = wp.array(self._local, dtype=wp.vec3)
            self._ids = wp.array(np.concatenate(ids), dtype=int)
            self._grain = wp.array(np.concatenate(grain), dtype=wp.vec2)
            self._indices = wp.array(self._faces.ravel(), dtype=int)
        self._moves = 0
        self._build()
        self._light = LightStruct()
        sun = np.asarray(light.sun, float)
        self._light.sun = wp.vec3(*(sun / np.linalg.norm(sun)))
        self._light.sun_strength, self._light.ambient = light.sun_strength, light.ambient
        self._light.ground, self._light.ground_scale = GROUNDS.index(light.ground), light.ground_scale
        self._light.zenith, self._light.horizon = wp.vec3(*_linear(light.zenith)), wp.vec3(*_linear(light.horizon))
        self._light.hills, self._light.fog = light.hills, light.fog

    def corners(self, name: str) -> tuple[int, np.ndarray]:
        """The number of a part's first triangle in `Image.faces`, and its triangles' corners (F, 3) in its vertices."""
        vertices = self._slices[name]
        mine = (self._faces[:, 0] >= vertices.start) & (self._faces[:, 0] < vertices.stop)
        return int(np.flatnonzero(mine)[0]), self._faces[mine] - vertices.start

    def _build(self) -> None:
        with wp.ScopedDevice(self.device):
            self._mesh = wp.Mesh(wp.array(self._world, dtype=wp.vec3), self._indices)
            self._normals = wp.array(self._world_normals, dtype=wp.vec3)

    def move(self, poses: Mapping[str, np.ndarray]) -> None:
        """Move parts. Args: poses: name -> T_world_part (4, 4), which may stretch, or vertices (V, 3) in the world."""
        for name, pose in poses.items():
            s = self._slices[name]
            if pose.shape == (4, 4):
                self._world[s] = self._local[s] @ pose[:3, :3].T + pose[:3, 3]
                self._world_normals[s] = self._local_normals[s] @ np.linalg.inv(pose[:3, :3])
            else:
                f = self._triangles[name]
                self._world[s] = pose[f.ravel()] if name in self._flat else pose
                local = np.arange(3 * len(f)).reshape(-1, 3) if name in self._flat else f
                self._world_normals[s] = vertex_normals(self._world[s], local)
        # A tree that is only refitted keeps the layout of an old pose, and rays may then take a hundred times longer.
        if self._moves % 16 == 0:
            self._build()
        else:
            self._mesh.points.assign(self._world)
            self._normals.assign(self._world_normals)
            self._mesh.refit()
        self._moves += 1

    def render(self, K: np.ndarray, T_world_cam: np.ndarray, size: Sequence[int], *, supersample: int = 1) -> Image:
        """Cast supersample^2 rays a pixel. Args: K (3, 3) px; T_world_cam (4, 4); size (width, height) px."""
        width, height = size
        hits = self._cast(K, T_world_cam, width, np.arange(width * height), supersample)
        shape = (height, width, supersample**2)
        rgb = _display(hits.rgb.reshape(*shape, 3).mean(2))
        weights = np.concatenate([hits.uv, 1 - hits.uv.sum(1, keepdims=True)], 1).reshape(*shape, 3)
        points = hits.points.reshape(*shape, 3)
        ids, depth, faces = hits.ids.reshape(shape), hits.depth.reshape(shape), hits.faces.reshape(shape)
        return Image(rgb, ids, depth, points, faces, weights)

    def picture(self, K: np.ndarray, T_world_cam: np.ndarray, size: Sequence[int]) -> np.ndarray:
        """(H, W, 3) uint8 RGB for the eye: one ray a pixel, four where the picture has an edge. Args as `render`."""
        width, height = size
        hits = self._cast(K, T_world_cam, width, np.arange(width * height), 1)
        rgb, ids = hits.rgb.reshape(height, width, 3), hits.ids.reshape(height, width)
        shade = np.clip(rgb, 0, 1).mean(-1) ** (1 / 2.2)
        edge = np.zeros((height, width), bool)
        for axis in (0, 1):
            step = (np.abs(np.diff(shade, axis=axis)) > 0.06) | (np.diff(ids, axis=axis) != 0)
            grow = [(0, 0), (0, 0)]
            for grow[axis] in ((0, 1), (1, 0)):
                edge |= np.pad(step, grow)
        again = np.flatnonzero(edge)
        if len(again):
            rgb[edge] = self._cast(K, T_world_cam, width, again, 2).rgb.reshape(-1, 4, 3).mean(1)
        return _display(rgb)

    def _cast(self, K: np.ndarray, T_world_cam: np.ndarray, width: int, pixels: np.ndarray, side: int) -> "_Hits":
        """side^2 samples of each of the pixels."""
        n = len(pixels) * side**2
        with wp.ScopedDevice(self.device):
            rgb, points = (wp.empty(n, dtype=wp.vec3) for _ in range(2))  # pyright: ignore[reportArgumentType]
            ids, depth = wp.empty(n, dtype=int), wp.empty(n, dtype=float)
            faces, uv = wp.empty(n, dtype=int), wp.zeros(n, dtype=wp.vec2)  # pyright: ignore[reportArgumentType]
            wp.launch(
                cast,
                dim=n,
                inputs=[self._mesh.id, self._normals, self._colors, self._rest, self._ids, self._grain]
                + [wp.mat33(T_world_cam[:3, :3].ravel()), wp.vec3(*T_world_cam[:3, 3])]
                + [wp.vec2(K[0, 0], K[1, 1]), wp.vec2(K[0, 2], K[1, 2]), width]
                + [wp.array(pixels.astype(np.int32), dtype=int), side, self._light],
                outputs=[rgb, ids, depth, points, faces, uv],
            )
        return _Hits(rgb.numpy(), ids.numpy(), depth.numpy(), points.numpy(), faces.numpy(), uv.numpy())


def _display(linear: np.ndarray) -> np.ndarray:
    """uint8 sRGB (by its approximation, gamma 2.2)."""
    return (np.clip(linear, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) T_world_cam at `eye` (3,) looking at `target` (3,), upright."""
    z = np.asarray(target, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    T[:3, 3] = eye
    return T


def intrinsics(width: int, height: int, *, hfov: float) -> np.ndarray:
    """(3, 3) px, principal point in the middle. Args: hfov: horizontal field of view, rad."""
    f = width / 2 / np.tan(hfov / 2)
    return np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]])
