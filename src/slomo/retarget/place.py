"""The robot's body, hips, points and hands, from the paths of its soles: everything within reach."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from slomo.retarget.soles import RobotBody
from slomo.retarget.subject import Hands
from slomo.robot import Robot

Array = np.ndarray
_LONGEST, _SHORTEST = 0.97, 1.1  # of the joints' reach: what planning leaves of it (see `pointfoot`)
_EASE = 0.1  # s, over which the body gives way to what legs can reach


@dataclass(frozen=True)
class Reach:
    """Least and greatest distance (S,) m of a sole from its root."""

    least: Array
    most: Array

    @classmethod
    def of(cls, body: RobotBody) -> "Reach":
        return cls(_SHORTEST * body.reach[:, 0], _LONGEST * body.reach[:, 1])


def body_height(
    z: Array, xy: Array, R: Rotation, soles: Array, standing: Array, body: RobotBody, *, dt: float
) -> Array:
    """Height (T,) m of the middle between the hips, changed where a standing sole would be out of reach.

    Args:
        z: (T,) m wanted.  xy: (T, 2) m, the same point.  soles: (T, S, 3) m.  standing: (T, S) bool.  dt: s.
    """
    reach = Reach.of(body)
    hips = np.stack([R.apply(r - body.root) for r in body.roots], axis=1)
    across = np.linalg.norm(xy[:, None] + hips[..., :2] - soles[..., :2], axis=2)
    tall = np.sqrt(np.maximum(reach.most**2 - across**2, (0.5 * reach.most) ** 2)) + soles[..., 2] - hips[..., 2]
    low = np.sqrt(np.maximum(reach.least**2 - across**2, 0.0)) + soles[..., 2] - hips[..., 2]
    ceiling = np.where(standing, tall, np.inf).min(axis=1)
    floor = np.where(standing, np.maximum(low, 0.4 * body.leg + soles[..., 2] - hips[..., 2]), -np.inf).max(axis=1)
    n = 2 * round(_EASE / dt) | 1
    for limit, extreme, widest in ((floor, np.maximum, maximum_filter1d), (ceiling, np.minimum, minimum_filter1d)):
        change = widest(extreme(z, limit) - z, n, mode="nearest")
        z = z + gaussian_filter1d(change, _EASE / dt / 2, mode="nearest")
    return z


def within_reach(soles: Array, hips: Array, standing: Array, ground: Array, body: RobotBody) -> tuple[Array, Array]:
    """Soles (T, S, 3) m that swing, drawn to what their legs reach; and which ones were drawn (T, S) bool."""
    reach = Reach.of(body)
    leg = soles - hips
    length = np.linalg.norm(leg, axis=2)
    wanted = np.clip(length, reach.least, reach.most)
    drawn = (wanted != length) & ~standing
    moved = hips + leg * (wanted / np.maximum(length, 1e-9))[..., None]
    moved[..., 2] = np.maximum(moved[..., 2], ground)
    return np.where(drawn[..., None], moved, soles), drawn


def points_of(soles: Array, pointing: Array, robot: Robot, body: RobotBody) -> Array:
    """(T, C, 3) m: each sole's points, toe and heel level and apart as on the robot; hands are left at 0."""
    out = np.zeros((len(soles), len(robot.limbs), 3))
    ahead = np.stack([np.cos(pointing), np.sin(pointing), np.zeros_like(pointing)], axis=2)
    for s, points in enumerate(body.points):
        for c, sign in zip(points, (0.5, -0.5) if body.length else (0.0,), strict=True):
            out[:, c] = soles[:, s] + sign * body.length * ahead[:, s]
    return out


def hands_of(hands: Hands | None, base: Array, R: Rotation, robot: Robot, body: RobotBody) -> tuple[Array, Array]:
    """(T, H, 3) m and confidence (T, H) of the robot's hands; one that was never seen hangs as in the nominal pose."""
    columns = list(body.hands)
    at = np.broadcast_to(robot.nominal_feet[columns], (len(base), len(columns), 3)).copy()
    confidence = np.zeros((len(base), len(columns)))
    if hands is not None:
        known = np.any(hands.confidence > 0, axis=0)
        least, most = robot.leg_reach[columns].T
        offset = hands.offset * (_LONGEST * most)[:, None]
        length = np.linalg.norm(offset, axis=2)
        offset *= (np.clip(length, _SHORTEST * least, _LONGEST * most) / np.maximum(length, 1e-9))[..., None]
        at[:, known] = (robot.nominal_hips[columns] + offset)[:, known]
        confidence[:, known] = hands.confidence[:, known]
    return base[:, None] + np.einsum("tij,tcj->tci", R.as_matrix(), at), confidence
