"""How far a reconstruction is from the truth of a rendered clip, in per cent of the animal's body length."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion
from slomo.rotation import umeyama

ROOTS = ("pelvis", "tail_base", "spine_mid")


def _at(t: np.ndarray, motion: KeypointMotion, names: list[str], tolerance: float) -> np.ndarray:
    """(len(t), len(names), 3) key points at times t, linear between frames, NaN outside or where missing."""
    out = np.full((len(t), len(names), 3), np.nan)
    inside = (t >= motion.t[0] - tolerance) & (t <= motion.t[-1] + tolerance)
    for i, name in enumerate(names):
        k = motion.index(name)
        seen = (motion.confidence[:, k] > 0).astype(float)
        ok = inside & (np.interp(t, motion.t, seen) > 1 - 1e-6)
        for c in range(3):
            out[ok, i, c] = np.interp(t[ok], motion.t, motion.positions[:, k, c])
    return out


def _swapped(X: np.ndarray, Y: np.ndarray, names: list[str], feet: list[str]) -> list[str]:
    """The left feet of pairs in X (T, N, 3) that fit the truth Y better with left and right exchanged."""
    out = []
    for left in feet:
        right = left.replace("left", "right")
        if left == right or left not in names or right not in names:
            continue
        i, j = names.index(left), names.index(right)
        own = np.linalg.norm(X[:, [i, j]] - Y[:, [i, j]], axis=-1).sum(1)
        other = np.linalg.norm(X[:, [i, j]] - Y[:, [j, i]], axis=-1).sum(1)
        if np.nanmean(other) < np.nanmean(own):
            out.append(left)
    return out


def _slide(placed: np.ndarray, names: list[str], truth: Mapping[str, Any], fps: float) -> float | None:
    stands = np.asarray(truth["foot_contact"], bool)
    feet = [(k, names.index(n)) for k, n in enumerate(map(str, truth["foot_names"])) if n in names]
    speed = np.linalg.norm(np.gradient(placed[..., :2], 1 / fps, axis=0), axis=-1)
    slid = np.concatenate([speed[stands[:, k], i] for k, i in feet]) if feet else np.zeros(0)
    slid = slid[np.isfinite(slid)]
    return float(slid.mean()) if len(slid) else None


def score(motion: KeypointMotion, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Compare key points with the arrays of a `truth.npz`; names that both have count.

    Returns:
        pa_mpjpe_percent: mean distance after a similarity alignment of each frame alone.
        w_mpjpe_percent: after one similarity alignment of the whole motion.
        foot_mpjpe_percent: the same, of the feet.
        root_path_error_percent: mean distance of the root (same alignment), in per cent of the distance that it
            travelled; None for a subject that stays within half its length.
        foot_slide_mps: mean horizontal speed of the feet (same alignment) while the true ones stand; None if none does.
        swapped: feet "front_left_paw" etc. of the pairs that lie nearer, over the whole motion, to each other's truth.
        gravity_error_degrees: angle between the two verticals in that alignment.
        matched: number of common key points.  coverage: part of the true frames with at least four of them.

    Raises:
        InvalidData: fewer than four common key points, or no common time.
    """
    true_names = [str(n) for n in truth["keypoint_names"]]
    names = [n for n in true_names if n in motion.names]
    if len(names) < 4:
        raise InvalidData("shares fewer than four key points with the truth", where="keypoints", valid=true_names)
    fps, length = float(truth["fps"]), float(truth["body_length"])
    Y = np.asarray(truth["keypoints"], float)[:, [true_names.index(n) for n in names]]
    X = _at(np.arange(len(Y)) / fps, motion, names, 0.75 / fps)
    ok = np.asarray(np.isfinite(X).all(-1) & np.isfinite(Y).all(-1))
    frames = np.flatnonzero(ok.sum(1) >= 4)
    if not len(frames):
        raise InvalidData("has no frame in common with the truth", where="keypoints")

    aligned = []
    for f in frames:
        s, R, shift = umeyama(X[f, ok[f]], Y[f, ok[f]])
        aligned.append(np.linalg.norm(s * X[f, ok[f]] @ R.T + shift - Y[f, ok[f]], axis=-1))
    s, R, shift = umeyama(X[ok], Y[ok])
    error = np.where(ok, np.linalg.norm(s * X @ R.T + shift - Y, axis=-1), np.nan)

    percent = 100 / length
    placed = s * X @ R.T + shift
    feet = [names.index(n) for n in map(str, truth["foot_names"]) if n in names]
    root = next((n for n in ROOTS if n in names), None)
    path_error = None
    if root is not None:
        k = names.index(root)
        # Nine frames smooth the body's bob away, so that the distance is the path's.
        smooth = np.stack([np.convolve(np.pad(c, 4, "edge"), np.full(9, 1 / 9), "valid") for c in Y[:, k, :2].T], 1)
        distance = float(np.linalg.norm(np.diff(smooth, axis=0), axis=1).sum())
        if distance > 0.5 * length and np.isfinite(error[:, k]).any():
            path_error = float(100 * np.nanmean(error[:, k]) / distance)
    return dict(
        pa_mpjpe_percent=float(np.concatenate(aligned).mean() * percent),
        w_mpjpe_percent=float(np.nanmean(error) * percent),
        foot_mpjpe_percent=float(np.nanmean(error[:, feet]) * percent) if feet else None,
        root_path_error_percent=path_error,
        foot_slide_mps=_slide(placed, names, truth, fps),
        swapped=_swapped(placed, Y, names, [str(n) for n in truth["foot_names"]]),
        gravity_error_degrees=float(np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))),
        matched=len(names),
        coverage=len(frames) / len(Y),
    )
