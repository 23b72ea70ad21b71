"""A ray-caster over triangle meshes in Warp (CPU or GPU): needs no OpenGL and no display.

One ray a sample, one shadow ray to one sun, ambient light from the sky, a textured ground plane z = 0. World frame: metres,
z up. Cameras: OpenCV convention, pixel centres at integer coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR  # Warp greets on stdout otherwise, where only results belong
wp.set_module_options({"enable_backward": False})

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
    """

    rgb: np.ndarray
    ids: np.ndarray
    depth: np.ndarray = field(repr=False)
    points: np.ndarray = field(repr=False)

    def mask(self, id: int) -> np.ndarray:
        """(H, W) bool: at least half of the pixel's samples see part `id`."""
        return (self.ids == id).mean(-1) >= 0.5


@wp.struct
class _Light:
    sun: wp.vec3
    sun_strength: float
    ambient: float
    ground: int
    ground_scale: float
    zenith: wp.vec3
    horizon: wp.vec3
    hills: float
    fog: float


@wp.func
def _hash(x: int, y: int, z: int) -> float:
    h = wp.uint32(x) * wp.uint32(73856093) ^ wp.uint32(y) * wp.uint32(19349663) ^ wp.uint32(z) * wp.uint32(83492791)
    h = (h ^ (h >> wp.uint32(15))) * wp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> wp.uint32(12))) * wp.uint32(0x297A2D39)
    h = h ^ (h >> wp.uint32(15))
    return float(h >> wp.uint32(8)) / 16777216.0


@wp.func
def _noise(p: wp.vec3) -> float:
    """Value noise in [0, 1], cell 1."""
    i, j, k = int(wp.floor(p[0])), int(wp.floor(p[1])), int(wp.floor(p[2]))
    u, v, w = p[0] - float(i), p[1] - float(j), p[2] - float(k)
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    a = wp.lerp(
        wp.lerp(_hash(i, j, k), _hash(i + 1, j, k), u), wp.lerp(_hash(i, j + 1, k), _hash(i + 1, j + 1, k), u), v
    )
    i2, j2, k2 = i, j, k + 1
    b = wp.lerp(
        wp.lerp(_hash(i2, j2, k2), _hash(i2 + 1, j2, k2), u),
        wp.lerp(_hash(i2, j2 + 1, k2), _hash(i2 + 1, j2 + 1, k2), u),
        v,
    )
    return wp.lerp(a, b, w)


@wp.func
def _fade(footprint: float, cell: float) -> float:
    """1 where a texture of this cell is resolved, 0 where it would alias."""
    return wp.clamp(1.6 - 1.6 * footprint / cell, 0.0, 1.0)


@wp.func
def _leaf(p: wp.vec3, cell: float, layer: int) -> wp.vec3:
    """One oval leaf or pebble in each cell: (coverage 0 or 1, random, random)."""
    i, j = int(wp.floor(p[0] / cell)), int(wp.floor(p[1] / cell))
    r = _hash(i, j, layer + 2)
    x = p[0] / cell - float(i) - 0.35 - 0.3 * _hash(i, j, layer)
    y = p[1] / cell - float(j) - 0.35 - 0.3 * _hash(i, j, layer + 1)
    a = 6.2832 * _hash(i, j, layer + 3)
    u, v = wp.cos(a) * x + wp.sin(a) * y, wp.cos(a) * y - wp.sin(a) * x
    inside = wp.where(u * u * 9.0 + v * v * 60.0 < 0.8 * _hash(i, j, layer + 4), 1.0, 0.0)
    return wp.vec3(inside, r, _hash(i, j, layer + 5))


@wp.func
def _meadow(p: wp.vec3, footprint: float) -> wp.vec3:
    earth = wp.smoothstep(0.45, 0.62, 0.6 * _noise(p * 1.3) + 0.4 * _noise(p * 4.1))
    c = wp.lerp(wp.vec3(0.075, 0.125, 0.032), wp.vec3(0.17, 0.115, 0.065), earth)
    c = c * (1.0 + 0.8 * _fade(footprint, 0.11) * (_noise(p * 9.0) - 0.5))
    c = c * (1.0 + 1.0 * _fade(footprint, 0.035) * (_noise(p * 29.0) - 0.5))
    c = c * (1.0 + 0.9 * _fade(footprint, 0.012) * (_noise(p * 83.0) - 0.5))
    a = _leaf(p, 0.045, 11)
    f = a[0] * _fade(footprint, 0.03) * wp.where(a[1] < 0.7, 1.0, 0.0)
    c = wp.lerp(c, c * (0.45 + 2.2 * a[2]), f)
    b = _leaf(p, 0.19, 31)
    g = b[0] * _fade(footprint, 0.1) * wp.where(b[1] < 0.75, 1.0, 0.0)
    return wp.lerp(c, wp.lerp(wp.vec3(0.30, 0.19, 0.06), wp.vec3(0.36, 0.35, 0.32), b[2]) * (0.5 + 0.9 * b[1]), g)


@wp.func
def _tiles(p: wp.vec3, footprint: float) -> wp.vec3:
    x, y = p[0] - wp.floor(p[0]), p[1] - wp.floor(p[1])
    even = wp.abs(wp.mod(wp.floor(p[0]) + wp.floor(p[1]), 2.0))
    c = wp.lerp(0.30, 0.36, even) * (1.0 + 0.06 * (_noise(p * 23.0) - 0.5))
    edge = wp.min(wp.min(x, 1.0 - x), wp.min(y, 1.0 - y))
    line = (1.0 - wp.smoothstep(0.004, 0.006 + footprint, edge)) * wp.clamp(0.03 / (footprint + 0.005), 0.0, 1.0)
    return wp.vec3(c, c * 1.01, c * 1.04) * (1.0 - 0.45 * line)


@wp.func
def _sky(d: wp.vec3, L: _Light) -> wp.vec3:
    up = wp.clamp(d[2], 0.0, 1.0)
    c = wp.lerp(L.horizon, L.zenith, wp.sqrt(up))
    c = c * (
        1.0 + 0.35 * (_noise(wp.vec3(d[0] / (up + 0.15), d[1] / (up + 0.15), 0.0) * 3.0) - 0.5) * wp.min(6.0 * up, 1.0)
    )
    if L.hills > 0.0:
        a = wp.atan2(d[1], d[0]) * 6.0
        ridge = L.hills * (0.35 + 0.8 * _noise(wp.vec3(a, 0.0, 0.0)) + 0.25 * _noise(wp.vec3(5.0 * a, 3.0, 0.0)))
        if d[2] < ridge:
            tree = 0.55 + 0.9 * _noise(wp.vec3(a * 15.0, d[2] * 160.0, 7.0))
            c = wp.lerp(L.horizon, wp.vec3(0.06, 0.10, 0.07) * tree, 0.65 * wp.smoothstep(-0.02, 0.05, d[2]))
    return c


@wp.kernel
def _cast(
    mesh: wp.uint64,
    normals: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3),
    rest: wp.array(dtype=wp.vec3),
    face_id: wp.array(dtype=int),
    face_grain: wp.array(dtype=wp.vec2),
    R: wp.mat33,
    origin: wp.vec3,
    focal: wp.vec2,
    centre: wp.vec2,
    width: int,
    L: _Light,
    rgb: wp.array(dtype=wp.vec3),
    ids: wp.array(dtype=int),
    depth: wp.array(dtype=float),
    points: wp.array(dtype=wp.vec3),
):
    n = wp.tid()
    px, py = float(n % width), float(n // width)
    ray = wp.vec3((px - centre[0]) / focal[0], (py - centre[1]) / focal[1], 1.0)
    d = wp.normalize(R * ray)
    far = float(1.0e6)
    id = int(-1)
    t = float(far)
    if L.ground > 0 and d[2] < -1.0e-5 and origin[2] > 0.0:
        t = -origin[2] / d[2]
        id = 0
    albedo = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 1.0)
    q = wp.mesh_query_ray(mesh, origin, d, t)
    if q.result:
        t = q.t
        id = face_id[q.face]
        a, b, c = wp.mesh_get_index(mesh, 3 * q.face), wp.mesh_get_index(mesh, 3 * q.face + 1), 0
        c = wp.mesh_get_index(mesh, 3 * q.face + 2)
        w = 1.0 - q.u - q.v
        albedo = colors[a] * q.u + colors[b] * q.v + colors[c] * w
        normal = wp.normalize(normals[a] * q.u + normals[b] * q.v + normals[c] * w)
        g = face_grain[q.face]
        if g[0] > 0.0:
            r = (rest[a] * q.u + rest[b] * q.v + rest[c] * w) / g[1]
            f = _fade(t / focal[0], g[1])
            albedo = albedo * (1.0 + g[0] * (f * (_noise(r) - 0.5) + (_noise(r * 0.23) - 0.5)))
        if wp.dot(normal, d) > 0.0:
            normal = -normal
    p = origin + d * t
    if id == 0:
        footprint = t / focal[0] / wp.sqrt(wp.max(-d[2], 0.02)) / L.ground_scale
        if L.ground == 1:
            albedo = _meadow(p / L.ground_scale, footprint)
        else:
            albedo = _tiles(p / L.ground_scale, footprint)
    color = _sky(d, L)
    if id >= 0:
        light = L.ambient * (0.65 + 0.35 * normal[2])
        facing = wp.dot(normal, L.sun)
        if facing > 0.0 and not wp.mesh_query_ray_anyhit(mesh, p + normal * (1.0e-3 + 2.0e-4 * t), L.sun, 100.0):
            light += L.sun_strength * facing
        haze = 1.0 - wp.exp(-t / L.fog)
        color = wp.lerp(albedo * light, L.horizon, haze * haze)
    rgb[n] = color
    ids[n] = id
    depth[n] = wp.where(id < 0, wp.inf, t / wp.length(ray))
    points[n] = p


def _linear(srgb) -> np.ndarray:
    return np.asarray(srgb, np.float32) ** 2.2


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(V, 3) area-weighted vertex normals."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    out = np.stack([np.bincount(triangles.ravel(), np.repeat(face[:, k], 3), len(vertices)) for k in range(3)], 1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-20)


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
        self._local_normals = _normals(self._local, self._faces)
        self._world_normals = self._local_normals.copy()
        with wp.ScopedDevice(self.device):
            self._colors = wp.array(np.concatenate(colors), dtype=wp.vec3)
            self._rest = wp.array(self._local, dtype=wp.vec3)
            self._ids = wp.array(np.concatenate(ids), dtype=int)
            self._grain = wp.array(np.concatenate(grain), dtype=wp.vec2)
            self._normals = wp.array(self._world_normals, dtype=wp.vec3)
            points = wp.array(self._world, dtype=wp.vec3)
            self._mesh = wp.Mesh(points, wp.array(self._faces.ravel(), dtype=int))
        self._light = _Light()
        sun = np.asarray(light.sun, float)
        self._light.sun = wp.vec3(*(sun / np.linalg.norm(sun)))
        self._light.sun_strength, self._light.ambient = light.sun_strength, light.ambient
        self._light.ground, self._light.ground_scale = GROUNDS.index(light.ground), light.ground_scale
        self._light.zenith, self._light.horizon = wp.vec3(*_linear(light.zenith)), wp.vec3(*_linear(light.horizon))
        self._light.hills, self._light.fog = light.hills, light.fog

    def move(self, poses: Mapping[str, np.ndarray]) -> None:
        """Move parts. Args: poses: name -> T_world_part (4, 4), or deformed vertices (V, 3) in the world."""
        for name, pose in poses.items():
            s = self._slices[name]
            if pose.shape == (4, 4):
                self._world[s] = self._local[s] @ pose[:3, :3].T + pose[:3, 3]
                self._world_normals[s] = self._local_normals[s] @ pose[:3, :3].T
            else:
                f = self._triangles[name]
                self._world[s] = pose[f.ravel()] if name in self._flat else pose
                local = np.arange(3 * len(f)).reshape(-1, 3) if name in self._flat else f
                self._world_normals[s] = _normals(self._world[s], local)
        self._mesh.points.assign(self._world)
        self._normals.assign(self._world_normals)
        self._mesh.refit()

    def render(self, K: np.ndarray, T_world_cam: np.ndarray, size: Sequence[int], *, supersample: int = 1) -> Image:
        """Cast the rays of one frame. Args: K (3, 3) px; T_world_cam (4, 4); size (width, height) px."""
        s, (width, height) = supersample, size
        n = width * height * s * s
        with wp.ScopedDevice(self.device):
            rgb, points = wp.empty(n, dtype=wp.vec3), wp.empty(n, dtype=wp.vec3)
            ids, depth = wp.empty(n, dtype=int), wp.empty(n, dtype=float)
            # Sample i of pixel x lies at x + (i + 1/2)/s - 1/2, which is (column - (s - 1)/2)/s.
            focal = wp.vec2(s * K[0, 0], s * K[1, 1])
            centre = wp.vec2(s * K[0, 2] + (s - 1) / 2, s * K[1, 2] + (s - 1) / 2)
            wp.launch(
                _cast,
                dim=n,
                inputs=[self._mesh.id, self._normals, self._colors, self._rest, self._ids, self._grain]
                + [wp.mat33(T_world_cam[:3, :3].ravel()), wp.vec3(*T_world_cam[:3, 3]), focal, centre, width * s]
                + [self._light],
                outputs=[rgb, ids, depth, points],
            )

        def samples(x: np.ndarray) -> np.ndarray:
            tail = x.shape[1:]
            x = x.reshape(height, s, width, s, *tail)
            return np.moveaxis(x, 1, 2).reshape(height, width, s * s, *tail)

        color = np.clip(samples(rgb.numpy()).mean(2), 0, 1) ** (1 / 2.2)
        return Image(
            (color * 255 + 0.5).astype(np.uint8),
            samples(ids.numpy()),
            samples(depth.numpy()),
            samples(points.numpy()),
        )


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
