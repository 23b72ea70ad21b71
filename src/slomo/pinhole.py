"""The pinhole camera: intrinsics, and what its pixels see of the ground."""

from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point in pixels of a picture of width x height; pixel centres at integers."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def ground_points(K: Intrinsics, T_world_cam: Array, u: Array, v: Array) -> Array:
    """World points on z = 0 that pixels u, v see; NaN for pixels that look at or above the horizon."""
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u, float)], -1) @ T_world_cam[:3, :3].T
    down = np.where(rays[..., 2] < -1e-3, rays[..., 2], np.nan)
    return T_world_cam[:3, 3] + rays * (-T_world_cam[2, 3] / down)[..., None]
