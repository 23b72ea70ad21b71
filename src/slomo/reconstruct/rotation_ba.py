"""Cameras that only turn: rotations and focal length from background tracks, without any structure.

Pairwise bundle adjustment of a panorama (Brown and Lowe, IJCV 2007, section 4): a point seen at x_i must be seen at
pi(K R_j^T R_i K^-1 x_i) in frame j. Solved by Levenberg-Marquardt with Huber weights, rotations perturbed on the right.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class RotationFit:
    """Result.

    Attributes:
        R_world_cam: (N, 3, 3), the first one the identity.
        focal: px.  focal_std: px, one standard deviation; infinite when the rotations leave it unobservable.
        residual: (P,) px, length of each pair's residual.
    """

    R_world_cam: np.ndarray
    focal: float
    focal_std: float
    residual: np.ndarray


def fit_rotations(
    which: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    count: int,
    *,
    center: np.ndarray,
    focal: float,
    refine_focal: bool,
    iterations: int = 40,
    huber: float = 0.5,
) -> RotationFit:
    """Fit rotations of `count` frames to correspondences.

    Args:
        which: (P, 2) frames of each pair.  first, second: (P, 2) px.
        center: (2,) px, principal point.  focal: px, start (and result when not `refine_focal`).
        huber: px, where the loss turns linear.
    """
    R = np.tile(np.eye(3), (count, 1, 1))
    x, y = first - center, second - center
    i, j = which.T
    damping, cost = 1e-3, np.inf
    best = (R, focal)
    for _ in range(iterations):
        residual, jacobian = _linearise(R, focal, x, y, i, j)
        length = np.linalg.norm(residual, axis=-1)
        weight = np.minimum(1.0, huber / np.maximum(length, 1e-9))
        new_cost = float(np.where(length < huber, 0.5 * length**2, huber * (length - 0.5 * huber)).sum())
        if new_cost < cost:
            done = cost - new_cost < 1e-7 * new_cost
            best, cost, damping = (R, focal), new_cost, damping / 5
            hessian, gradient = _normal_equations(residual, jacobian, weight, i, j, count)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
        free = np.arange(3, 3 * count + int(refine_focal))  # the first rotation is the gauge
        H = hessian[np.ix_(free, free)]
        step = np.zeros(3 * count + 1)
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(len(free)), gradient[free])
        R = best[0] @ Rotation.from_rotvec(step[:-1].reshape(-1, 3)).as_matrix()
        focal = best[1] * float(np.exp(np.clip(step[-1], -0.3, 0.3)))
    R, focal = best
    residual, jacobian = _linearise(R, focal, x, y, i, j)
    length = np.linalg.norm(residual, axis=-1)
    std = np.inf
    if refine_focal:
        weight = np.minimum(1.0, huber / np.maximum(length, 1e-9))
        H, _ = _normal_equations(residual, jacobian, weight, i, j, count)
        sigma = 1.4826 * float(np.median(abs(residual)))
        # Correspondences of one track are not independent: counted as if every track gave ten of them.
        covariance = np.linalg.pinv(H[3:, 3:], rcond=1e-14) * max(sigma, 0.05) ** 2 * 10
        std = focal * float(np.sqrt(max(covariance[-1, -1], 0.0)))
    return RotationFit(R, focal, std, length)


def rotation_between(R_world: np.ndarray, focal: float, center: np.ndarray, seen: np.ndarray, now: np.ndarray):
    """R_world_cam of a frame that sees at `now` (P, 2) px what a frame with `R_world` (3, 3) sees at `seen` (P, 2) px:
    robust Kabsch on viewing rays."""
    a = _rays(seen - center, focal) @ R_world.T
    b = _rays(now - center, focal)
    weight = np.ones(len(a))
    R = R_world
    for _ in range(8):
        U, _, Vt = np.linalg.svd((a * weight[:, None]).T @ b)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        error = np.linalg.norm(a - b @ R.T, axis=-1) * focal
        weight = 1.0 / np.maximum(error, 0.3)
    return R


def _rays(x: np.ndarray, focal: float) -> np.ndarray:
    rays = np.column_stack([x, np.full(len(x), focal)])
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _linearise(R, focal, x, y, i, j):
    """Residuals (P, 2) px and their derivatives (P, 2, 7) by the turn of frame i, of frame j, and log focal."""
    ray = np.column_stack([x / focal, np.ones(len(x))])
    Rij = np.swapaxes(R[j], 1, 2) @ R[i]
    d = np.einsum("pab,pb->pa", Rij, ray)
    z = np.maximum(d[:, 2], 1e-3)
    u = d[:, :2] / z[:, None]
    projection = np.zeros((len(x), 2, 3))
    projection[:, 0, 0] = projection[:, 1, 1] = focal / z
    projection[:, :, 2] = -focal * u / z[:, None]
    jacobian = np.empty((len(x), 2, 7))
    jacobian[:, :, :3] = -projection @ Rij @ _skew(ray)
    jacobian[:, :, 3:6] = projection @ _skew(d)
    by_focal = np.einsum("pab,pb->pa", Rij, np.column_stack([-x / focal, np.zeros(len(x))]))
    jacobian[:, :, 6] = np.einsum("pab,pb->pa", projection, by_focal) + focal * u
    return focal * u - y, jacobian


def _skew(v: np.ndarray) -> np.ndarray:
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - np.swapaxes(out, 1, 2)


def _normal_equations(residual, jacobian, weight, i, j, count):
    """J^T W J and J^T W r over 3 parameters a frame and log focal last."""
    size = 3 * count + 1
    H, g = np.zeros((size, size)), np.zeros(size)
    # Thousands of correspondences share a pair of frames: they are summed before they are put in their places.
    order = np.lexsort((j, i))
    i, j, jacobian = i[order], j[order], jacobian[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(i) != 0) | (np.diff(j) != 0)])
    weighted = jacobian * weight[order, None, None]
    blocks = np.add.reduceat(np.swapaxes(weighted, 1, 2) @ jacobian, starts, axis=0)
    slopes = np.add.reduceat((weighted * residual[order, :, None]).sum(1), starts, axis=0)
    for a, b, block, slope in zip(i[starts], j[starts], blocks, slopes, strict=True):
        columns = np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3, size - 1]
        H[np.ix_(columns, columns)] += block
        g[columns] += slope
    return H, g
