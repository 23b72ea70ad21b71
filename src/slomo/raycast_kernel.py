"""The Warp kernel of the ray-caster: rays, procedural textures, light. Used through `slomo.raycast`."""

# Warp's kernel language is Python in syntax only.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false
# pyright: reportGeneralTypeIssues=false

import warp as wp

from slomo import quiet_warp

quiet_warp.init()
wp.set_module_options({"enable_backward": False})


@wp.struct
class LightStruct:
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
def _sky(d: wp.vec3, L: LightStruct) -> wp.vec3:
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
def cast(
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
    pixels: wp.array(dtype=int),
    side: int,
    L: LightStruct,
    rgb: wp.array(dtype=wp.vec3),
    ids: wp.array(dtype=int),
    depth: wp.array(dtype=float),
    points: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=int),
    uv: wp.array(dtype=wp.vec2),
):
    """Sample n % side^2 of pixel `pixels[n // side^2]`: samples lie on a side x side grid over the pixel."""
    n = wp.tid()
    pixel, k = pixels[n // (side * side)], n % (side * side)
    px = float(pixel % width) + (float(k % side) + 0.5) / float(side) - 0.5
    py = float(pixel // width) + (float(k // side) + 0.5) / float(side) - 0.5
    ray = wp.vec3((px - centre[0]) / focal[0], (py - centre[1]) / focal[1], 1.0)
    d = wp.normalize(R * ray)
    id = int(-1)  # noqa: RUF046, UP018 (a literal would be a constant to Warp)
    t = float(1.0e6)  # noqa: UP018
    if L.ground > 0 and d[2] < -1.0e-5 and origin[2] > 0.0:
        t = -origin[2] / d[2]
        id = 0
    albedo = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 1.0)
    q = wp.mesh_query_ray(mesh, origin, d, t)
    faces[n] = -1
    if q.result:
        t = q.t
        faces[n] = q.face
        uv[n] = wp.vec2(q.u, q.v)
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
