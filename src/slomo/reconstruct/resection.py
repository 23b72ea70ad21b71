"""Cameras of the frames between the key frames: sparse points followed from frame to frame, then resection (PnP)."""

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from slomo.reconstruct.sfm import Structure
from slomo.reconstruct.tracks import follow

_MIN_POINTS = 12


def camera_path(frames: np.ndarray, structure: Structure, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_world_cam (T, 4, 4) of all frames and (T,) bool, which of them were measured and not interpolated."""
    T = len(frames)
    known = dict(zip(structure.frames.tolist(), structure.T_world_cam, strict=True))
    sightings: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in range(T)]
    rows = {int(f): np.flatnonzero(structure.observations[:, 0] == n) for n, f in enumerate(structure.frames)}
    for order in (range(T), range(T - 1, -1, -1)):
        xy, ids, before = np.zeros((0, 2)), np.zeros(0, int), np.zeros((0, 0), np.uint8)
        for t in order:
            image = cv2.cvtColor(frames[t], cv2.COLOR_RGB2GRAY)
            if t in known:
                xy, ids = structure.xy[rows[t]], structure.observations[rows[t], 1]
            elif len(xy):
                xy, good = follow(before, image, xy)
                xy, ids = xy[good], ids[good]
                sightings[t].append((xy, ids))
            before = image
    for t in range(T):
        if t not in known and sightings[t]:
            xy, ids = (np.concatenate(column) for column in zip(*sightings[t], strict=True))
            guess = interpolate_poses(structure.frames, structure.T_world_cam, np.array([t]))[0]
            if (pose := _resect(structure.points[ids], xy, K, guess)) is not None:
                known[t] = pose
    measured = np.array([t in known for t in range(T)])
    at = np.flatnonzero(measured)
    return interpolate_poses(at, np.array([known[int(t)] for t in at]), np.arange(T)), measured


def _resect(points: np.ndarray, xy: np.ndarray, K: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
    """T_world_cam (4, 4) that sees `points` (P, 3) at `xy` (P, 2), or None."""
    if len(points) < _MIN_POINTS:
        return None
    inverse = np.linalg.inv(guess)
    turn, shift = Rotation.from_matrix(inverse[:3, :3]).as_rotvec(), inverse[:3, 3]
    cv2.setRNGSeed(0)
    ok, _, _, inliers = cv2.solvePnPRansac(
        points, xy.astype(float), K, None, turn.copy(), shift.copy(), useExtrinsicGuess=True, reprojectionError=2.0
    )
    if not ok or inliers is None or len(inliers) < _MIN_POINTS:
        return None
    keep = np.asarray(inliers)[:, 0].astype(int)
    # From the guess, not from RANSAC's pose: that one differs in its last bits from call to call.
    start = np.concatenate([turn, shift])
    best = least_squares(_reprojection, start, method="lm", x_scale="jac", args=(points[keep], xy[keep], K)).x
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(best[:3]).as_matrix()
    pose[:3, 3] = best[3:]
    return np.linalg.inv(pose)


def _reprojection(pose: np.ndarray, points: np.ndarray, xy: np.ndarray, K: np.ndarray) -> np.ndarray:
    """(2 P,) px by which points (P, 3) are seen off; `pose` is rotation vector and translation, world to camera."""
    seen = (Rotation.from_rotvec(pose[:3]).apply(points) + pose[3:]) @ K.T
    return (seen[:, :2] / seen[:, 2:] - xy).ravel()


def interpolate_poses(at: np.ndarray, T_world_cam: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) at increasing times `at`, interpolated at `wanted`; held constant outside."""
    out = np.tile(np.eye(4), (len(wanted), 1, 1))
    when = np.clip(wanted, at[0], at[-1])
    if len(at) == 1:
        out[:] = T_world_cam[0]
        return out
    out[:, :3, :3] = Slerp(at, Rotation.from_matrix(T_world_cam[:, :3, :3]))(when).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(when, at, T_world_cam[:, axis, 3])
    return out
