"""Where a subject goes: its path on the ground, size and heading of travel from the boxes of its masks and the camera.

Depth comes from the lowest mask row on the ground, size from the box's height: both hold when an animal turns.
"""

from dataclasses import dataclass

import numpy as np

from slomo.pinhole import Intrinsics, ground_points

Array = np.ndarray


@dataclass(frozen=True)
class GroundPath:
    """World units; T frames of the clip, F of which were looked at.

    Attributes:
        middle: (T, 2) the subject's place on the ground.
        height: of the subject, the median over the frames that show all of it.
        velocity: (T, 2) per s.
        noise: (F, 2) what the smooth path leaves of the measured places, where there are any; else 0.
    """

    middle: Array
    height: float
    velocity: Array
    noise: Array

    def heading(self, t: Array, slow: float) -> Array:
        """(T,) rad, continuous: the way of travel; where the subject is slower than about `slow` (per s) it is taken
        from the times when it moves."""
        speed = np.linalg.norm(self.velocity, axis=1)
        w = (speed / slow) ** 2 / (1 + (speed / slow) ** 2) + 1e-3
        width = 0.3 * len(t) / max(t[-1] - t[0], 1e-6)
        unit = whittaker(self.velocity / np.maximum(speed, 1e-9)[:, None], w, width)
        return np.unwrap(np.arctan2(unit[:, 1], unit[:, 0]))


def whittaker(y: Array, weight: Array, smoothness: float) -> Array:
    """(T, D) smoothed y (T, D): least squares with squared second differences (Whittaker 1923), made robust by Cauchy
    reweighting. `smoothness` in frames is about the half width of the kernel."""
    T = len(y)
    D = np.diff(np.eye(T), 2, axis=0)
    penalty = smoothness**4 * D.T @ D + 1e-9 * np.eye(T)
    w = weight.astype(float)
    for _ in range(4):
        x = np.linalg.solve(np.diag(w) + penalty, w[:, None] * y)
        r = np.linalg.norm(y - x, axis=1)
        scale = 2.0 * max(np.median(r[weight > 0.1]) if (weight > 0.1).any() else 0.0, 1e-9)
        w = weight / (1 + (r / scale) ** 2)
    return x


def mask_box(mask: Array) -> tuple[int, int, int, int]:
    """First and last column and row u0, v0, u1, v1 px of a mask (H, W) bool, which must not be empty."""
    u, v = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    return int(u[0]), int(v[0]), int(u[-1]), int(v[-1])


def ground_path(
    t: Array, at: Array, K: Intrinsics, T_world_cam: Array, box: Array, *, quality: Array, empty: Array
) -> GroundPath:
    """The path of a subject.

    Args:
        t: (T,) s of all frames; at: (F,) the frames with boxes.
        K: of the pictures that the boxes are in.  T_world_cam: (T, 4, 4), world z up, the ground at z = 0.
        box: (F, 4) px, as `mask_box` has them.
        quality: (F,) of the masks, in [0, 1].  empty: (F,) bool, frames without a subject; not all of them.
    """
    u0, v0, u1, v1 = box.T
    whole = (v1 < K.height - 2) & ~empty
    centred = (u0 > 0) & (u1 < K.width - 1)
    ground = np.array([ground_points(K, T_world_cam[k], np.array((a + b) / 2), np.array(c + 0.5))
                       for k, a, b, c in zip(at, u0, u1, v1, strict=True)])  # fmt: skip
    known = np.isfinite(ground).all(1) & ~empty
    if not known.any():
        # Feet never below the horizon: no depth from the ground; put the subject at twice the camera's height.
        mid = T_world_cam[at, :2, 3] + 4 * T_world_cam[at, :2, 2]
        ground = np.concatenate([mid, np.zeros((len(mid), 1))], 1)
        known = ~empty
    weight = known * quality * np.where(whole, 1.0, 0.02) * np.where(centred, 1.0, 0.1)
    near = np.linalg.norm(ground - T_world_cam[at, :3, 3], axis=1)
    weight = weight * np.where(near < 30 * np.median(near[known]), 1.0, 0.0) + 1e-4 * known
    dt = float(np.median(np.diff(t[at]))) if len(at) > 1 else 1.0
    path = whittaker(np.where(known[:, None], ground[:, :2], 0.0), weight, 0.25 / dt)
    # Size of an upright thing of box height at that depth.
    cam = T_world_cam[at]
    depth = np.einsum("fi,fi->f", np.concatenate([path, np.zeros((len(path), 1))], 1) - cam[:, :3, 3], cam[:, :3, 2])
    level = np.linalg.norm(cam[:, :2, 2], axis=1).clip(0.3)
    tall = (v1 - v0 + 1) * depth / K.fy / level
    usable = whole & known & (v0 > 0)
    full = np.stack([np.interp(t, t[at], path[:, i]) for i in range(2)], 1)
    v = np.gradient(full, t, axis=0)
    step = max(1, round(0.15 * len(t) / max(t[-1] - t[0], 1e-6)))
    v = np.stack([np.convolve(np.pad(v[:, i], step, "edge"), np.ones(2 * step + 1) / (2 * step + 1), "valid")
                  for i in range(2)], 1)  # fmt: skip
    noise = np.where((known & whole & centred)[:, None], ground[:, :2] - path, 0.0)
    return GroundPath(full, float(np.median(tall[usable if usable.any() else known])), v, noise)
