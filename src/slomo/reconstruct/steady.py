"""A camera's tremble, taken back by the background's optical flow.

A camera whose rotation is a little wrong in every frame (interpolated between key frames, taken from a gyroscope, or
simply noisy) makes the subject jump, and a fit explains the jumps by the body. Between two frames the flow of the
background tells the rotation far better than that. How far the turns are believed follows from the clip: errors that
are independent from frame to frame make differences of which neighbours cancel, anything else does not.
"""

import numpy as np
from scipy.linalg import eigh_tridiagonal, solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from slomo.pinhole import Intrinsics

Array = np.ndarray

MOST_CELLS = 600  # background cells of a frame pair that are looked at
LEAST_CELLS = 40  # with fewer, a pair tells nothing
FLOW_PX = 1.0  # flow errors from which on a cell counts less and less, px of a picture 600 px wide
SOFTER = (16, 8, 4, 2, 1, 1)  # times that, in the rounds of reweighted least squares: at first nobody is an outlier
SLOW = 10.0  # frames, over which what turns have in common is no tremble but what depths that are not known do to them
LEAST_PAIRS = 8
MOST_SD = 4.0  # of a turn, robust standard deviations: larger ones are cut to that where variances are estimated
RATIOS = np.geomspace(1e-4, 10, 31)  # of the variance of all else to that of the tremble
LIKELIER = 5.0  # nats that tremble has to be the likelier explanation by


def steadied(T_world_cam: Array, K: Intrinsics, flow: Array, background: Array) -> Array:
    """(T, 4, 4) the cameras with their rotations steadied; the same where the flow shows no tremble.

    Args:
        T_world_cam: (T, 4, 4), z up, the ground at z = 0. K: of the pictures.
        flow: (T-1, h, w, 2) px of the pictures, frame t -> t+1, on a grid over them. background: (T-1, h, w) bool.
    """
    W = T_world_cam[:, :3, :3]
    turns, told = np.zeros((len(flow), 3)), np.zeros(len(flow), bool)
    for k in range(len(flow)):
        v, u = np.nonzero(background[k])
        if len(v) < LEAST_CELLS:
            continue
        some = np.linspace(0, len(v) - 1, min(len(v), MOST_CELLS)).astype(int)
        v, u = v[some], u[some]
        h, w = background[k].shape
        seen = np.stack([(u + 0.5) * K.width / w - 0.5, (v + 0.5) * K.height / h - 0.5], -1)
        turns[k] = W[k + 1] @ _turn(T_world_cam[k], T_world_cam[k + 1], K, seen, np.asarray(flow[k][v, u], float))
        told[k] = True
    correction = _smoothed(turns, told)
    out = T_world_cam.copy()
    out[:, :3, :3] = Rotation.from_rotvec(correction).as_matrix() @ W
    return out


def _turn(T0: Array, T1: Array, K: Intrinsics, seen: Array, moved: Array) -> Array:
    """(3,) rad, in camera 1, by which the rotation from camera 0 to camera 1 has to be turned to agree with the flow
    `moved` (n, 2) at `seen` (n, 2) px. Depth is unknown: along the epipolar direction a cell may have moved as far as a
    thing at the camera's own height above the ground away from it would.
    """
    f = np.array([K.fx, K.fy])
    centre = np.array([K.cx, K.cy])
    rays = np.concatenate([(seen - centre) / f, np.ones((len(seen), 1))], -1)
    R10 = T1[:3, :3].T @ T0[:3, :3]
    step = T1[:3, :3].T @ (T0[:3, 3] - T1[:3, 3]) / max(float(T0[2, 3]), 1e-3)
    noise = FLOW_PX * K.width / 600
    omega, mean = np.zeros(3), 0.0
    for soft in noise * np.array(SOFTER):
        y = rays @ (Rotation.from_rotvec(omega).as_matrix() @ R10).T
        z = np.maximum(y[:, 2:], 1e-6)
        n = y[:, :2] / z
        error = (seen + moved - centre) / f - n
        # d(y / z) of a turn about each axis and of a step at unit inverse depth.
        a, b = n[:, 0], n[:, 1]
        Ju = np.stack([-a * b, 1 + a * a, -b], -1)
        Jv = np.stack([-(1 + b * b), a * b, a], -1)
        along = np.stack([step[0] - a * step[2], step[1] - b * step[2]], -1) / z
        error, along = error * f, along * f
        J = np.stack([Ju * f[0], Jv * f[1]], 1)
        # Whitened: the error along the epipolar direction has the spread of the unknown depth besides the flow's.
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        way = np.where(length > 1e-9, along / np.maximum(length, 1e-9), 0.0)
        less = 1 - noise / np.sqrt(noise**2 + length**2)
        white = lambda x, way=way, less=less: x - less[:, :, None] * way[:, :, None] * (way[:, None] @ x)  # noqa: E731
        # The last unknown is the mean of what is over the depths.
        e, A = white(error[:, :, None])[..., 0], white(np.concatenate([J, along[:, :, None]], 2))
        r = e - A[:, :, 3] * mean
        weight = 1 / (1 + (r**2).sum(-1) / soft**2) ** 2
        H = np.einsum("n,nij,nik->jk", weight, A, A) + 1e-6 * np.eye(4)
        found = np.linalg.solve(H, np.einsum("n,nij,ni->j", weight, A, e))
        omega, mean = omega + found[:3], found[3]
    return omega


def _smoothed(turns: Array, told: Array) -> Array:
    """(T, 3) rad, world frame: corrections d whose differences are minus the turns, as far as those are tremble."""
    T = len(turns) + 1
    out = np.zeros((T, 3))
    if told.sum() < LEAST_PAIRS:
        return out
    weight = gaussian_filter1d(told.astype(float), SLOW)[:, None]
    turns = turns - gaussian_filter1d(np.where(told[:, None], turns, 0.0), SLOW, axis=0) / np.maximum(weight, 1e-9)
    known = turns[told]
    most = MOST_SD * 1.4826 * np.median(np.abs(known), axis=0)
    ratio = _tremble(np.clip(known, -most, most), np.diff(np.flatnonzero(told)) == 1)
    if ratio is None:
        return out
    used, sure = np.where(told[:, None], turns, 0.0), told.astype(float)
    diagonal = np.full(T, ratio)
    diagonal[:-1] += sure
    diagonal[1:] += sure
    out[:-1] += used
    out[1:] -= used
    return solveh_banded(np.stack([np.append(0.0, -sure), diagonal]), out)


def _tremble(turns: Array, adjacent: Array) -> float | None:
    """The variance of everything else over that of the tremble, most likely for turns (n, 3) of which `adjacent` (n-1,)
    bool follow each other; None where turns that have nothing to do with each other are as likely.

    Turns that are differences of independent errors have covariance s2 D D^T, with D the differences; what else is in
    them, m2 I. Both are diagonal in the eigenvectors of D D^T, whose eigenvalues are large where a turn and the next
    one cancel.
    """
    values, vectors = eigh_tridiagonal(np.full(len(turns), 2.0), -adjacent.astype(float))
    power = (vectors.T @ turns) ** 2 + 1e-18

    def likelihood(spread: Array) -> float:
        """Of variances in proportion to `spread` (n,), the best factor taken."""
        return -1.5 * float(np.log(spread).sum()) - 1.5 * len(spread) * np.log((power / spread[:, None]).mean())

    found = [likelihood(np.maximum(values, 0) + ratio) for ratio in RATIOS]
    best = int(np.argmax(found))
    return float(RATIOS[best]) if found[best] > likelihood(np.ones(len(turns))) + LIKELIER else None
