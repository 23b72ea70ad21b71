"""How certain what a sparse reconstruction says is: its focal length, and a plane through its points."""

import numpy as np

from slomo.reconstruct.rotation_ba import skew
from slomo.reconstruct.sfm import Structure

_MOST_CAMERAS, _MOST_POINTS = 120, 1200  # that the focal length's certainty is computed from, about
# Observations are not independent, and the model (no distortion, no rolling shutter) is not exact: counted as if a
# hundredth of them were there, which is what errors of rendered clips ask for (1 to 6 px, where that says 1 to 3).
_DEPENDENT = 100.0
_BLOCKS = 8


def focal_std(structure: Structure, center: np.ndarray) -> float:
    """px, standard deviation of the focal length of a bundle adjustment with all cameras and points free.

    The points are eliminated one by one (Triggs et al., Bundle adjustment, 2000, section 6.1); the seven freedoms of
    the world frame are left out.

    Args:
        center: (2,) px, principal point.
    """
    thin = max(1, len(structure.frames) // _MOST_CAMERAS)
    image, point = structure.observations.T
    N, image = -(-len(structure.frames) // thin), np.where(image % thin == 0, image // thin, -1)
    residual, by_pose, by_focal, by_point = _linearise(structure, center)
    order = np.argsort(point, kind="stable")
    order = order[image[order] >= 0]
    ends = np.cumsum(np.bincount(point[order], minlength=len(structure.points)))[:-1]
    groups = [g for g in np.split(order, ends) if len(g) >= 3]
    used = groups[:: max(1, -(-len(groups) // _MOST_POINTS))]
    S = np.zeros((6 * N + 1, 6 * N + 1))
    for rows in used:
        m = len(rows)
        E = np.zeros((m, 2, 6 * m + 1))
        for k, r in enumerate(rows):
            E[k, :, 6 * k : 6 * k + 6] = by_pose[r]
            E[k, :, -1] = structure.focal * by_focal[r]  # by its logarithm, whose scale is that of the turns
        E = E.reshape(2 * m, -1)
        A = np.linalg.qr(by_point[rows].reshape(2 * m, 3))[0]
        E = E - A @ (A.T @ E)
        columns = np.append((6 * image[rows][:, None] + np.arange(6)).ravel(), 6 * N)
        S[np.ix_(columns, columns)] += E.T @ E
    values, vectors = np.linalg.eigh(S * (len(groups) / max(1, len(used))))
    values, vectors = values[7:], vectors[:, 7:]  # increasing: the world's turn, shift and scale come first
    sigma = 1.4826 * float(np.median(np.abs(residual)))
    variance = float((vectors[-1] ** 2 / np.maximum(values, 1e-9)).sum())
    return structure.focal * float(np.sqrt(_DEPENDENT * variance)) * max(sigma, 0.05)


def _linearise(s: Structure, center: np.ndarray):
    """Residuals (M, 2) px and their derivatives by pose (turn, shift in the camera frame), focal length and point."""
    image, point = s.observations.T
    R, c = s.T_world_cam[image, :3, :3], s.T_world_cam[image, :3, 3]
    X = np.einsum("mji,mj->mi", R, s.points[point] - c)
    z = np.maximum(X[:, 2], 1e-9)
    u = X[:, :2] / z[:, None]
    projection = np.zeros((len(X), 2, 3))
    projection[:, 0, 0] = projection[:, 1, 1] = s.focal / z
    projection[:, :, 2] = -s.focal * u / z[:, None]
    by_pose = np.concatenate([-projection @ skew(X), projection], -1)
    return s.focal * u + center - s.xy, by_pose, u, projection @ np.swapaxes(R, 1, 2)


def plane_std(points: np.ndarray, weights: np.ndarray, normal: np.ndarray) -> float:
    """rad, standard deviation of a plane's direction by the jackknife over blocks of its points, which lie in sectors
    around their middle: neighbours err together, and a floor that is bent or in two levels shows.

    Args:
        points: (P, 3) on the plane.  weights: (P,).  normal: (3,) of the plane through all of them.
    """
    mean = np.average(points, axis=0, weights=weights)
    axes = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
    angle = np.arctan2(*((points - mean) @ axes).T)
    block = np.argsort(np.argsort(angle, kind="stable"), kind="stable") * _BLOCKS // len(points)
    normals = []
    for b in range(_BLOCKS):
        rest = block != b
        if rest.sum() >= 8:
            n = fit_plane(points[rest], weights[rest])[0]
            normals.append(n * np.sign(n @ normal or 1.0))
    if len(normals) < 3:
        return np.inf
    away = np.array(normals) - np.mean(normals, axis=0)
    return float(np.sqrt((len(normals) - 1) / len(normals) * (away**2).sum()))


def fit_plane(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal (3,) and middle (3,) of the plane through points (P, 3) with the least weighted squares."""
    mean = np.average(points, axis=0, weights=weights)
    spread = (points - mean) * np.sqrt(weights)[:, None]
    return np.linalg.svd(spread, full_matrices=False)[2][2], mean
