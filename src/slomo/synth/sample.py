"""One training sample: a creature in a random scene, cropped as the networks see it, with everything known about it."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slomo.prior.crop import MARGIN, compensate
from slomo.prior.frames import SPAN
from slomo.prior.labels import Labels, toward, view_of
from slomo.raycast import Image, Light, Part, Scene, look_at
from slomo.skeleton import Skeleton
from slomo.synth.creature import Creature
from slomo.synth.moves import move
from slomo.synth.scene import box

Array = np.ndarray

SIZE = 160  # px, side of a sample
SUBJECT, OTHER = 1, 2  # ids of parts


@dataclass(frozen=True)
class _Shot:
    """K (3, 3) px of the crop, and T_world_cam (4, 4) at both times."""

    K: Array
    now: Array
    then: Array


def _shot(points: Array, rng: np.random.Generator) -> _Shot:
    """A camera whose picture is the crop around world points (V, 3): any side, 1.3 to 14 body lengths away, mostly from
    a person's height, held by hand or walking along."""
    target = (points.min(0) + points.max(0)) / 2
    size = float(np.linalg.norm(np.ptp(points, 0)))
    distance = size * np.exp(rng.uniform(np.log(1.1), np.log(9.0)))
    elevation = np.radians(rng.uniform(-8, 30) if rng.random() < 0.85 else rng.uniform(30, 60))
    azimuth = rng.uniform(0, 2 * np.pi)
    d = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    eye = target + distance * d
    eye[2] = max(eye[2], 0.06 * size)
    now = look_at(eye, target)
    roll = rng.normal(0, 0.06)
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    now[:3, :3] = now[:3, :3] @ turn
    u = (points - now[:3, 3]) @ now[:3, :3]
    u = u[:, :2] / u[:, 2:]
    low, high = u.min(0), u.max(0)
    f = SIZE / (MARGIN * (high - low).max())
    centre = (low + high) / 2
    K = np.array([[f, 0, SIZE / 2 - 0.5 - f * centre[0]], [0, f, SIZE / 2 - 0.5 - f * centre[1]], [0, 0, 1]])
    then = now.copy()
    shake = 0.0 if rng.random() < 0.2 else rng.exponential(0.012)
    then[:3, 3] += size * shake * rng.standard_normal(3) + (rng.random() < 0.4) * 0.03 * size * rng.standard_normal(3)
    R, _ = cv2.Rodrigues(0.6 * shake * rng.standard_normal(3))
    then[:3, :3] = then[:3, :3] @ R
    return _Shot(K, now, then)


def _project(shot: _Shot, T: Array, x: Array) -> Array:
    """(..., 2) crop px of world points (..., 3)."""
    y = (x - T[:3, 3]) @ T[:3, :3]
    z = np.maximum(y[..., 2:], 1e-3)
    return y[..., :2] / z * shot.K[[0, 1], [0, 1]] + shot.K[:2, 2]


def _things(points: Array, shot: _Shot, rng: np.random.Generator) -> dict[str, Part]:
    """Boxes behind the subject and, sometimes, a post in front of it."""
    out: dict[str, Part] = {}
    target = points.mean(0)
    size = float(np.linalg.norm(np.ptp(points, 0)))
    away = target[:2] - shot.now[:2, 3]
    distance = float(np.linalg.norm(away))
    ahead = away / max(distance, 1e-6)
    side = np.array([-ahead[1], ahead[0]])

    def put(name: str, along: float, across: float, half: Array) -> None:
        x, y = target[:2] + along * ahead + across * side
        v, f = box(x, y, tuple(half), rng.uniform(0, np.pi))
        color = rng.uniform(0.1, 0.9, 3) * 0.6 + 0.2 * rng.random()
        grain, cell = rng.uniform(0, 1), rng.uniform(0.02, 0.2) * size
        out[name] = Part(v, f, color, OTHER, grain=grain, grain_size=cell, smooth=False)

    for i in range(rng.integers(0, 5)):
        half = size * np.array([rng.uniform(0.05, 0.8), rng.uniform(0.05, 0.8), rng.uniform(0.1, 1.0)])
        put(f"far{i}", size * rng.uniform(1.2, 4), size * rng.uniform(-1.5, 1.5), half)
    if rng.random() < 0.15:
        at = -rng.uniform(0.75, 0.9) * min(size, 0.9 * distance)
        half = size * np.array([0.02, 0.02, 0.8]) * rng.uniform(0.5, 2.5)
        put("near", at, size * rng.uniform(-0.3, 0.3), half)
    return out


def _light(rng: np.random.Generator, size: float) -> Light:
    strength = rng.uniform(0.0, 1.4) if rng.random() < 0.8 else 0.0
    return Light(
        sun=(rng.normal(), rng.normal(), rng.uniform(0.3, 2.0)),
        sun_strength=strength,
        ambient=rng.uniform(0.2, 0.6) + (0.4 if strength == 0 else 0.0),
        ground=("meadow", "tiles")[rng.integers(2)],
        ground_scale=size * rng.uniform(0.3, 3),
        hills=rng.uniform(0, 0.2),
        fog=size * rng.uniform(15, 200),
    )


def _camera_look(rgb: Array, flow: Array, rng: np.random.Generator) -> Array:
    """Motion blur, sensor noise, white balance and compression."""
    out = rgb.astype(np.float32)
    if rng.random() < 0.35:  # blur along the mean motion
        d = flow.reshape(-1, 2).mean(0) * rng.uniform(0, 0.6) + rng.normal(0, 0.7, 2)
        n = int(np.ceil(np.abs(d).max())) | 1
        if 1 < n < 31:
            kernel = np.zeros((n, n), np.float32)
            c = (n - 1) / 2
            ends = [tuple(np.round([c + s * d[0] / 2, c + s * d[1] / 2]).astype(int).tolist()) for s in (-1, 1)]
            cv2.line(kernel, ends[0], ends[1], 1.0)
            out = cv2.filter2D(out, -1, kernel / kernel.sum())
    if rng.random() < 0.4:
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.4, 1.6))
    out = out * rng.uniform(0.8, 1.2, 3) + rng.uniform(0, 9) * rng.standard_normal(out.shape, np.float32)
    out = np.clip(out, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(25, 95))])
        out = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return np.asarray(out)


def parts_of_keypoints(skeleton: Skeleton, known: Labels) -> list[set[int]]:
    """Of each key point the labels of the parts that it lies in or borders on."""
    out: list[set[int]] = [set() for _ in known.keypoints]
    for label, link, ends in zip(known.capsule_part, skeleton.capsule_link, skeleton.capsule_nodes, strict=True):
        for m in (link, *ends):
            out[m].add(int(label))
    for m, own in enumerate(out):  # a node that no capsule names, as a hip that only a thigh hangs from
        if not own:
            own |= out[skeleton.link[m]]
    return out


def _visible(node_parts: list[set[int]], parts: Array, uv: Array) -> Array:
    """(K,) whether the pixel of a key point shows a part that the key point is in."""
    u = np.round(uv).astype(int)
    inside = np.all((u >= 0) & (u < SIZE), axis=1)
    u = np.clip(u, 0, SIZE - 1)
    label = parts[u[:, 1], u[:, 0]]
    return np.array([bool(i and int(v) in own) for i, v, own in zip(inside, label, node_parts, strict=True)])


def sample(c: Creature, known: Labels, node_parts: list[set[int]], rng: np.random.Generator) -> dict[str, Any] | None:
    """The arrays of one sample (see `slomo.synth.dataset`), and `move`, its name; None when too little is visible.

    Args:
        node_parts: of each key point, the labels of the parts that it is in.
    """
    t = np.array([0.0, SPAN * rng.uniform(0.5, 1.5)]) + rng.uniform(0, 10)
    m = move(c, t, rng)
    vertices = [c.skin(m.R[i], m.nodes[i, : c.skeleton.link_count]) for i in (0, 1)]
    shot = _shot(vertices[0], rng)
    size = float(np.linalg.norm(np.ptp(vertices[0], 0)))
    grain, cell = rng.uniform(0, 0.8), rng.uniform(0.01, 0.05)
    coat = Part(vertices[0], c.triangles, c.colors(rng), SUBJECT, grain=grain, grain_size=cell)
    scene = Scene({"subject": coat} | _things(vertices[0], shot, rng), _light(rng, size), device="cpu")
    image = scene.render(shot.K, shot.now, (SIZE, SIZE))
    hit = image.ids[..., 0] == SUBJECT
    if hit.mean() < 0.03:
        return None
    first, corners = scene.corners("subject")
    face = corners[image.faces[..., 0][hit] - first]
    weights = image.weights[:, :, 0][hit]
    parts, surface = np.zeros((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE, 3), np.float32)
    parts[hit] = c.part[face[np.arange(len(face)), weights.argmax(1)]]
    surface[hit] = (c.surface[face] * weights[..., None]).sum(1)
    flow = _flow(image, hit, (vertices[1][face] * weights[..., None]).sum(1), shot)
    nodes = m.nodes[0]
    uv = _project(shot, shot.now, nodes)
    middle = (nodes[known.trunk].mean(0) - shot.now[:3, 3]) @ shot.now[:3, :3]
    azimuth, up = view_of(toward(middle) @ shot.now[:3, :3].T @ known.trunk_rotation(nodes))
    return dict(
        rgb=_camera_look(image.rgb, flow[hit], rng), mask=hit.astype(np.uint8), flow=compensate(flow, hit), parts=parts,
        surface=surface, keypoints=uv, visible=_visible(node_parts, parts, uv), azimuth=azimuth, up=up, move=m.name,
    )  # fmt: skip


def _flow(image: Image, hit: Array, then: Array, shot: _Shot) -> Array:
    """(H, W, 2) px to the later frame: the subject's points `hit` go to `then` (n, 3), everything else stands still."""
    x = image.points[:, :, 0].copy()
    sky = image.ids[..., 0] < 0
    ray = x[sky] - shot.now[:3, 3]
    x[sky] = shot.now[:3, 3] + 1e3 * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    x[hit] = then
    v, u = np.mgrid[:SIZE, :SIZE]
    return (_project(shot, shot.then, x) - np.stack([u, v], -1)).astype(np.float32)
