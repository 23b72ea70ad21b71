"""Gravity and the ground plane: from sparse points where the camera moves, from vertical lines where it only turns."""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.reconstruct.certainty import fit_plane, plane_std

_LEAST_LIKELY = 2e-3  # of `_likely`: a camera that looks down by 68 degrees, or is rolled by 35


@dataclass(frozen=True)
class Plane:
    """The plane {x: normal . x = offset} in the world of the sparse points.

    Attributes:
        inliers: (P,) bool, points on it.  support: their share of all weight.
        tilt_std: rad, standard deviation of the normal's direction, see `certainty.plane_std`.
    """

    normal: np.ndarray
    offset: float
    inliers: np.ndarray
    support: float
    tilt_std: float


def find_ground(
    points: np.ndarray, weights: np.ndarray, axes: np.ndarray, centers: np.ndarray, *, seed: int = 0
) -> Plane | None:
    """RANSAC for the ground: below all cameras, seen at a likely pitch and roll, with most points on it. None where
    there is no such plane.

    Args:
        points: (P, 3) sparse points.  weights: (P,) how near each lies to where the subject stands.
        axes: (3, 3) mean R_world_cam (columns right, down, forward).  centers: (T, 3) camera centres.
    """
    if len(points) < 20:
        return None
    rng = np.random.default_rng(seed)
    up, origin = -axes[:, 1], centers.mean(0)
    distance = np.linalg.norm(points - origin, axis=-1)
    tolerance = 0.006 * distance  # depth of a sparse point is the less certain the farther it is
    best, best_score = None, 0.0
    chance = weights / weights.sum()
    for _ in range(1500):
        a, b, c = points[rng.choice(len(points), 3, replace=False, p=chance)]
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal)
        if size < 1e-9 * distance.max() ** 2:
            continue
        normal /= size * np.sign(normal @ up or 1.0)
        if not _may_be_ground(normal, float(normal @ a), axes, centers):
            continue
        height = points @ normal - normal @ a
        # What hangs below the ground speaks against it (table tops have floor under them), though less than what lies
        # on it speaks for it: shining floors mirror the room.
        score = weights[abs(height) < tolerance].sum() - 0.5 * weights[height < -4 * tolerance].sum()
        score *= _likely(axes.T @ normal)
        if score > best_score:
            best, best_score = (normal, float(normal @ a)), score
    if best is None:
        return None
    normal, offset = best
    for _ in range(5):
        on = abs(points @ normal - offset) < 1.5 * tolerance
        if on.sum() < 8:
            return None
        fitted, mean = fit_plane(points[on], (weights / tolerance**2)[on])
        normal = fitted * np.sign(fitted @ up or 1.0)
        offset = float(normal @ mean)
    # With other points, the plane may have turned away from what was drawn.
    if not _may_be_ground(normal, offset, axes, centers):
        return None
    on = abs(points @ normal - offset) < 1.5 * tolerance
    std = plane_std(points[on], (weights / tolerance**2)[on], normal)
    return Plane(normal, offset, on, float(weights[on].sum() / weights.sum()), std)


def _may_be_ground(normal: np.ndarray, offset: float, axes: np.ndarray, centers: np.ndarray) -> bool:
    """Whether the plane {x: normal . x = offset} lies below all cameras (T, 3), and is no wall seen from the front."""
    return bool(np.all(centers @ normal > offset)) and _likely(axes.T @ normal) > _LEAST_LIKELY


def _likely(up: np.ndarray) -> float:
    """How likely this up (3,), camera frame, is by the prior of pitch and roll, widened twofold; 1 at best."""
    pitch, roll = np.arcsin(np.clip(-up[2], -1, 1)), np.arctan2(-up[0], -up[1])
    return float(np.exp(-0.125 * (((pitch - PITCH_PRIOR) / PITCH_STD) ** 2 + (roll / (2 * ROLL_STD)) ** 2)))


@dataclass(frozen=True)
class Gravity:
    """Up in the frame of one camera that does not move, as pitch and roll.

    Attributes:
        up: (3,) unit vector, camera frame (OpenCV: y down, z forward).
        pitch, roll: rad; pitch is how far the camera looks down.  pitch_std, roll_std: one standard deviation.
        lines: number of line segments that agree with it.
    """

    up: np.ndarray
    pitch: float
    roll: float
    pitch_std: float
    roll_std: float
    lines: int


# Hand-held footage of an animal looks down on it: prior of pitch and roll (rad), mean and standard deviation.
PITCH_PRIOR, PITCH_STD = np.radians(12.0), np.radians(8.0)
ROLL_STD = np.radians(2.5)
# The camera's height in heights of the subject: a cat seen standing up is 5, a horse or a person under 1; mean and
# standard deviation of the logarithm.
LOG_HEIGHT, LOG_HEIGHT_STD = np.log(1.3), 0.8


def gravity_from_lines(
    frames: np.ndarray, masks: np.ndarray, R_world_cam: np.ndarray, focal: float, center: np.ndarray
) -> Gravity:
    """Most probable pitch and roll given line segments that may be vertical, where the subject stands, and the prior.

    Every image of a vertical line spans, with the camera's centre, a plane that contains up: normal . up = 0. The
    segments' angular errors are taken as a mixture of a Gaussian (0.6 degrees) and clutter, maximised over a grid. The
    subject's feet are on the ground, so they are below the horizon, and by how much of its height is part of the prior.

    Args:
        frames: (N, H, W, 3) uint8 RGB, a few of them.  masks: (N, H, W) bool.  R_world_cam: (N, 3, 3); the world is
            the frame in which the result is expressed.
    """
    normals, lengths = [], []
    for frame, mask, R in zip(frames, masks, R_world_cam, strict=True):
        n, length = _upright_segments(frame, mask, focal, center)
        normals.append(n @ R.T)
        lengths.append(length)
    normals, lengths = np.concatenate(normals), np.concatenate(lengths) / max(1, len(frames))
    pitch, roll = np.meshgrid(
        np.radians(np.arange(-20, 50.5, 0.5)), np.radians(np.arange(-15, 15.25, 0.25)), indexing="ij"
    )
    grid = np.stack([-np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll), -np.sin(pitch)], -1)
    sigma, clutter = np.radians(0.6), 0.03
    log = -0.5 * ((pitch - PITCH_PRIOR) / PITCH_STD) ** 2 - 0.5 * (roll / ROLL_STD) ** 2
    log = log + _subject_log_likelihood(grid, masks, R_world_cam, focal, center)
    if len(normals):
        error = np.arcsin(np.clip(grid @ normals.T, -1, 1)) / sigma
        # A segment counts by its length in tenths of the picture's height; fifty of them say no more than ten do.
        weight = lengths / (0.1 * frames.shape[1])
        weight *= min(1.0, 10.0 / max(weight.sum(), 1e-9))
        log = log + np.log(clutter + np.exp(-0.5 * error**2)) @ weight
    p = np.exp(log - log.max())
    p /= p.sum()
    mean = float((p * pitch).sum()), float((p * roll).sum())
    peak = np.unravel_index(p.argmax(), p.shape)
    up = grid[peak]
    agree = int((abs(np.arcsin(np.clip(normals @ up, -1, 1))) < 2 * sigma).sum()) if len(normals) else 0
    return Gravity(
        up=up,
        pitch=float(pitch[peak]),
        roll=float(roll[peak]),
        pitch_std=float(np.sqrt((p * (pitch - mean[0]) ** 2).sum())),
        roll_std=float(np.sqrt((p * (roll - mean[1]) ** 2).sum())),
        lines=agree,
    )


def _subject_log_likelihood(
    up: np.ndarray, masks: np.ndarray, R_world_cam: np.ndarray, focal: float, center: np.ndarray
) -> np.ndarray:
    """(...) for up (..., 3): how likely the camera's height is, seen against the subject's, by the median frame."""
    logs = []
    for mask, R in zip(masks, R_world_cam, strict=True):
        rows, columns = np.nonzero(mask)
        if len(rows) < 50:
            continue
        top, bottom = np.quantile(rows, [0.0, 1.0])
        if bottom >= len(mask) - 2:
            continue  # the feet are cut off
        u = np.median(columns[rows >= bottom - 0.05 * (bottom - top)])
        foot, head = (R @ [(u - center[0]) / focal, (v - center[1]) / focal, 1.0] for v in (bottom, top))
        down, rise = -(up @ foot), up @ head
        # The head is as far away along the ground as the foot, which is 1 below the camera.
        away = [np.sqrt(np.maximum(ray @ ray - (up @ ray) ** 2, 1e-9)) for ray in (foot, head)]
        size = 1.0 + rise * away[0] / away[1] / np.maximum(down, 1e-3)
        logs.append(np.where(down > 1e-3, -np.log(np.maximum(size, 1e-3)), -10.0))
    if not logs:
        return np.zeros(up.shape[:-1])
    return -0.5 * ((np.median(logs, axis=0) - LOG_HEIGHT) / LOG_HEIGHT_STD) ** 2


def _upright_segments(frame: np.ndarray, mask: np.ndarray, focal: float, center: np.ndarray):
    """Normals (L, 3), camera frame, of the planes through long segments within 25 degrees of the image's vertical, and
    their lengths (L,) px."""
    gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    found = cv2.createLineSegmentDetector().detect(gray)[0]
    if found is None:
        return np.zeros((0, 3)), np.zeros(0)
    ends = found.reshape(-1, 2, 2).astype(float)
    middle = ends.mean(1).round().astype(int)
    away = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8))
    outside = away[middle[:, 1].clip(0, gray.shape[0] - 1), middle[:, 0].clip(0, gray.shape[1] - 1)] == 0
    d = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(d, axis=-1)
    keep = outside & (length > 0.05 * gray.shape[0]) & (abs(d[:, 0]) < np.tan(np.radians(25)) * abs(d[:, 1]))
    rays = np.concatenate([(ends - center) / focal, np.ones((*ends.shape[:2], 1))], -1)
    normal = np.cross(rays[:, 0], rays[:, 1])[keep]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12), length[keep]
