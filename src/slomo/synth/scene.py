"""What surrounds the animal in a rendered clip: light, far boxes, near clutter, and the person with the camera."""

import numpy as np

from slomo.raycast import Light, Part, intrinsics, look_at
from slomo.synth.gait import smooth_random

ANIMAL, FAR, NEAR = 1, 2, 3  # part ids
CAMERAS = ("follow", "orbit", "pan", "static")
HFOV = np.radians(50)


def box(x: float, y: float, half: tuple[float, float, float], yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and triangles (12, 3) of a box on the ground at (x, y) m."""
    corner = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (0, 2)]) * half
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return corner @ R.T + [x, y, 0], np.array(faces)


def surroundings(path: np.ndarray, eye: np.ndarray, size: float, *, clutter: bool, seed: int) -> dict[str, Part]:
    """Boxes far behind the animal; with `clutter` also posts between 1 and 3 body sizes from it.

    Args:
        path: (T, 2) m of the animal.  eye: (T, 2) m of the camera.  size: m, the animal's height.
    """
    rng = np.random.default_rng([seed, 4])
    parts: dict[str, Part] = {}

    def place(name: str, radius: tuple[float, float], half: tuple[float, float, float], clear: float, id: int) -> None:
        for _ in range(100):
            a, r = rng.uniform(0, 2 * np.pi), size * rng.uniform(*radius)
            xy = path[len(path) // 2] + r * np.array([np.cos(a), np.sin(a)])
            # Clear of the animal, of the camera, and of the view between them.
            between = path[:, None] + np.linspace(0, 1.1, 12)[:, None] * (eye - path)[:, None]
            if np.linalg.norm(between - xy, axis=-1).min() > clear + np.hypot(half[0], half[1]):
                break
        else:
            return
        v, f = box(xy[0], xy[1], half, rng.uniform(0, np.pi))
        color = np.array(
            [(0.50, 0.38, 0.28), (0.60, 0.58, 0.54), (0.45, 0.25, 0.20), (0.35, 0.42, 0.35)][rng.integers(4)]
        )
        parts[name] = Part(v, f, color * rng.uniform(0.8, 1.2), id, grain=0.7, grain_size=0.05 * size, smooth=False)

    for i in range(14):
        half = size * np.array([rng.uniform(0.3, 1.3), rng.uniform(0.3, 1.3), rng.uniform(0.3, 1.2)])
        place(f"far{i}", (9, 22), tuple(half), 3.5 * size, FAR)
    for i in range(10 if clutter else 0):
        half = size * np.array([0.06, 0.06, rng.uniform(0.6, 1.4)])
        place(f"near{i}", (1.0, 4.5), tuple(half), 0.35 * size, NEAR)
    return parts


def light(size: float, toward: float, seed: int) -> Light:
    """Sun (behind the camera's shoulder), sky and meadow for an animal of `size` m seen from azimuth `toward` (rad)."""
    rng = np.random.default_rng([seed, 5])
    a = toward + rng.uniform(0.3, 1.1) * rng.choice([-1, 1])
    s = size / 0.56
    sun = (np.cos(a), np.sin(a), rng.uniform(0.8, 1.5))
    return Light(sun=sun, sun_strength=1.1, ambient=0.55, ground_scale=s, hills=0.10, fog=90 * s)


def camera(
    mode: str,
    target: np.ndarray,
    t: np.ndarray,
    *,
    length: float,
    view: float,
    size: tuple[int, int],
    shake: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) px and T_world_cam (T, 4, 4).

    Args:
        mode: "follow" walks along with 75 % of the animal's motion, "orbit" also goes around it at 10 degrees a second,
            "pan" stands and turns, "static" is on a tripod.
        target: (T, 3) m, the animal's middle.  t: (T,) s.  length: m, nose to tail.
        view: rad, from which side: 0 = its left flank, positive towards its front.  shake: 1 = a hand, 0 = a tripod.
    """
    rng = np.random.default_rng([seed, 6])
    K = intrinsics(*size, hfov=HFOV)
    travel = target[-1, :2] - target[0, :2]
    heading = np.arctan2(travel[1], travel[0]) if np.linalg.norm(travel) > 0.2 * length else 0.0
    # The animal fills 60 % of the picture's width; a tripod must also see the whole way.
    along = abs(np.cos(view)) * np.linalg.norm(travel) if mode == "static" else 0.0
    distance = (length + along) / (2 * np.tan(HFOV / 2) * 0.60)
    middle = target[len(t) // 2]
    carried = {"follow": 0.75, "orbit": 0.75, "pan": 0.0, "static": 0.0}[mode]
    smooth = np.array([np.polyval(np.polyfit(t, x, min(3, len(t) - 1)), t) for x in target.T]).T
    centre = middle + carried * (smooth - middle)
    rate = np.radians(10) if mode == "orbit" else np.radians(3) if mode == "follow" else 0.0
    angle = heading + np.pi / 2 - view + rate * (t - t[len(t) // 2])
    height = target[:, 2].mean() + distance * 0.22
    eye = centre + distance * np.stack([np.cos(angle), np.sin(angle), 0 * t], 1)
    eye[:, 2] = height
    hand = shake * (0.0 if mode == "static" else 1.0)
    eye += 0.012 * length * hand * smooth_random(rng, t, 0.6, 3)
    lag = middle + (0.0 if mode == "static" else 0.9) * (smooth - middle)
    gaze = lag + 0.010 * distance * hand * smooth_random(rng, t, 0.5, 3)
    roll = 0.006 * hand * smooth_random(rng, t, 0.8, 1)[:, 0]
    T = np.stack([look_at(e, g) for e, g in zip(eye, gaze, strict=True)])
    c, s, z, o = np.cos(roll), np.sin(roll), 0 * roll, 1 + 0 * roll
    T[:, :3, :3] = T[:, :3, :3] @ np.stack([c, -s, z, s, c, z, z, z, o], 1).reshape(-1, 3, 3)
    return K, T
