"""Breaks in the scale of a structure from motion, found and mended by the camera's height over the ground.

Where only plain ground is seen for a while its points do not last, and what a few of them say of how the scale before
relates to the one after is not much: each part is right by itself, with small errors, at a scale of its own. No pair
of pictures shows it (the scale is in none of them). But every part sees the ground, and in no tenth of a second does a
camera that is carried rise to twice its height, nor become twice as fast in the same moment.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.reconstruct.ground import find_ground
from slomo.reconstruct.sfm import Structure

Array = np.ndarray

_LEAST = 1.6  # times the height from one key frame to the next, from which on it is another scale
_NEAR = 5  # key frames either side of a break that say what height and speed are there
_LAYER = 0.1  # of the height: points within so much of it lie on one ground
_GROUND = 0.5  # part of the points below a camera that must do so, to tell its height
_ALIKE = 0.5  # of the change of height (logarithms): that of speed is at least so much, what goes on beside it is less


def mended(structure: Structure, weights: Array) -> tuple[Structure, list[tuple[int, float]]]:
    """The structure with the scale of its later parts throughout, and the breaks: the frame after which each lies, and
    by how many times the scale is larger after it. The structure itself where there is none.

    Args:
        weights: (P,) of the points, as `find_ground` takes them.
    """
    T = structure.T_world_cam
    axes = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    plane = find_ground(structure.points, weights, axes, T[:, :3, 3])
    if plane is None:
        return structure, []
    height, step = _heights(structure, plane.normal), np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=-1)
    centers, points, found = T[:, :3, 3].copy(), structure.points.copy(), []
    first, _ = structure.seen()
    for n in range(len(T) - 1):
        if (ratio := _ratio(height, step, n)) is not None:
            last = _last(step, n, ratio)
            # Everything before, about the last camera there: the step that leads on has the scale of what follows.
            pivot, early = centers[last].copy(), first <= last
            centers[: last + 1] = pivot + ratio * (centers[: last + 1] - pivot)
            points[early] = pivot + ratio * (points[early] - pivot)
            found.append((int(structure.frames[last]), ratio))
    if not found:
        return structure, []
    T = T.copy()
    T[:, :3, 3] = centers
    return replace(structure, T_world_cam=T, points=points), found


def _heights(structure: Structure, up: Array) -> Array:
    """(N,) of each camera above the layer in which most points lie that it sees below it, in the units of the
    structure; NaN where no layer has `_GROUND` of them."""
    out = np.full(len(structure.frames), np.nan)
    for n, T in enumerate(structure.T_world_cam):
        seen = structure.observations[structure.observations[:, 0] == n, 1]
        below = (T[:3, 3] - structure.points[seen]) @ up
        depth = np.sort(np.log(below[below > 0]))
        if len(depth):
            inside = np.searchsorted(depth, depth + _LAYER) - np.arange(len(depth))
            if inside.max() > _GROUND * len(depth):
                out[n] = np.exp(depth[inside.argmax()] + _LAYER / 2)
    return out


def _ratio(height: Array, step: Array, n: int) -> float | None:
    """By how many times the scale is larger after key frame n; None where it is the same, or nothing tells.

    Args:
        height: (N,) over the ground, NaN where it is not known.  step: (N-1,) from each key frame to the next.
    """
    if not 0 < n < len(step) - 1:
        return None
    before, after = np.log(height[max(0, n + 1 - _NEAR) : n + 1]), np.log(height[n + 1 : n + 1 + _NEAR])
    rise = float(after[0] - before[-1])
    if not abs(rise) > np.log(_LEAST):  # NaN is not, either
        return None
    steady = max(float(np.nanmax(side) - np.nanmin(side)) for side in (before, after))
    slow, fast = (float(np.median(side)) for side in (step[max(0, n - _NEAR) : n], step[n + 1 : n + 1 + _NEAR]))
    faster = np.log(max(fast, 1e-12) / max(slow, 1e-12))
    # Over a table the floor seems to rise, but nobody walks the faster for that.
    if steady > _ALIKE * abs(rise) or not _ALIKE < faster / rise < 1 / _ALIKE:
        return None
    return float(np.exp(np.nanmedian(after) - np.nanmedian(before)))


def _last(step: Array, n: int, ratio: float) -> int:
    """The last key frame of the scale before, near n, from where most points are of the other: the one for which the
    steps go on most evenly. Most points that a camera sees may be of those before it."""

    def uneven(last: int) -> float:
        near = slice(max(0, n - _NEAR), n + 1 + _NEAR)
        scaled = np.where(np.arange(len(step)) < last, ratio * step, step)[near]
        return float(np.abs(np.diff(np.log(np.maximum(scaled, 1e-12)))).sum())

    return min(range(max(1, n - 2), min(n + 3, len(step))), key=uneven)
