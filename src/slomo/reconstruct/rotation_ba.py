"""Cameras that only turn: rotations and focal length from background tracks, without any structure.

Pairwise bundle adjustment of a panorama (Brown and Lowe, IJCV 2007, section 4): a point seen at x_i must be seen at
pi(K R_j^T R_i K^-1 x_i) in frame j. Solved by Levenberg-Marquardt with Huber weights, rotations perturbed on the right.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.reconstruct.pairwise import minimise


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
) -> RotationFit:
    """Fit rotations of `count` frames to correspondences. Without any, no frame turns.

    Args:
        which: (P, 2) frames of each pair.  first, second: (P, 2) px.
        center: (2,) px, principal point.  focal: px, start (and result when not `refine_focal`).
    """
    if len(which) == 0:
        return RotationFit(np.tile(np.eye(3), (count, 1, 1)), focal, np.inf, np.zeros(0))
    x, y = first - center, second - center
    i, j = which.T

    def move(state, step):
        R, focal = state
        turned = R @ Rotation.from_rotvec(step[:-1].reshape(-1, 3)).as_matrix()
        return turned, focal * float(np.exp(np.clip(step[-1], -0.3, 0.3)))

    found = minimise(
        (np.tile(np.eye(3), (count, 1, 1)), focal),
        lambda state: _linearise(state[0], state[1], x, y, i, j),
        move,
        i,
        j,
        count,
        np.arange(3, 3 * count + int(refine_focal)),  # the first rotation is the gauge
    )
    R, focal = found.state
    std = np.inf
    if refine_focal:
        sigma = 1.4826 * float(np.median(abs(found.residual)))
        # Correspondences of one track are not independent: counted as if every track gave ten of them.
        covariance = np.linalg.pinv(found.hessian[3:, 3:], rcond=1e-14) * max(sigma, 0.05) ** 2 * 10
        std = focal * float(np.sqrt(max(covariance[-1, -1], 0.0)))
    return RotationFit(R, focal, std, np.linalg.norm(found.residual, axis=-1))


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
    jacobian[:, :, :3] = -projection @ Rij @ skew(ray)
    jacobian[:, :, 3:6] = projection @ skew(d)
    by_focal = np.einsum("pab,pb->pa", Rij, np.column_stack([-x / focal, np.zeros(len(x))]))
    jacobian[:, :, 6] = np.einsum("pab,pb->pa", projection, by_focal) + focal * u
    return focal * u - y, jacobian


def skew(v: np.ndarray) -> np.ndarray:
    """Matrices (P, 3, 3) of the cross product with v (P, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - np.swapaxes(out, 1, 2)
