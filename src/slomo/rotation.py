"""Rotations and rigid or similarity alignment of point sets, in NumPy (SciPy's `Rotation` serves for the rest)."""

import numpy as np

Array = np.ndarray


def umeyama(
    source: Array, target: Array, *, weights: Array | None = None, scale: bool = True
) -> tuple[float, Array, Array]:
    """Similarity (s, R, p) that minimises sum w |s R source + p - target|^2 (Umeyama 1991, eqs. 40 to 42).

    Args:
        source, target: (N, 3) in any one unit.
        weights: (N,) non-negative, default 1.
        scale: False keeps s = 1 (the Kabsch problem).

    Returns:
        s, R (3, 3) with determinant +1, p (3,).
    """
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    w = w / w.sum()
    a, b = w @ source, w @ target
    X, Y = source - a, target - b
    U, S, Vt = np.linalg.svd(Y.T @ (X * w[:, None]))
    d = np.array([1.0, 1.0, 1.0 if np.linalg.det(U @ Vt) >= 0 else -1.0])
    R = (U * d) @ Vt
    variance = float(w @ (X**2).sum(1))
    s = float(S @ d) / variance if scale and variance > 0 else 1.0
    return s, R, b - s * R @ a


def kabsch(source: Array, target: Array, *, weights: Array | None = None) -> tuple[Array, Array]:
    """Rotation R (3, 3) and translation p (3,) that minimise sum w |R source + p - target|^2; as `umeyama`."""
    _, R, p = umeyama(source, target, weights=weights, scale=False)
    return R, p


def yaw(R: Array) -> Array:
    """Heading of the x axis of R (..., 3, 3) about world z, rad."""
    return np.arctan2(R[..., 1, 0], R[..., 0, 0])


def rot_z(angle: Array | float) -> Array:
    """(..., 3, 3) rotation about z by `angle` (...,) rad."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, one], -1)], -2)


def rot_zyx(yaw: Array, pitch: Array, roll: Array) -> Array:
    """(..., 3, 3) Rz(yaw) Ry(pitch) Rx(roll), rad; positive pitch turns the x axis down."""
    c, s = np.cos, np.sin
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    Ry = [[c(pitch), zero, s(pitch)], [zero, one, zero], [-s(pitch), zero, c(pitch)]]
    Rx = [[one, zero, zero], [zero, c(roll), -s(roll)], [zero, s(roll), c(roll)]]
    y, x = (np.stack([np.stack(row, -1) for row in R], -2) for R in (Ry, Rx))
    return rot_z(yaw) @ y @ x
