"""Camera motion, focal length and ground of a clip: which model holds is measured, and named.

- "static": the background does not move.
- "panning": the camera turns about its centre; rotations alone explain the background.
- "moving": there is parallax; structure from motion.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.reconstruct import ground, resection, rotation_ba, sfm
from slomo.reconstruct.tracks import Tracks, background_tracks

_STATIC_PX = 0.7  # px, background displacement below which a camera stands still (at 640 px; noise of the tracks)
_PARALLAX_PX = 0.5  # px, residual of the turning camera over a second and more, above which there is parallax
_GROUND_SUPPORT = 0.08  # part of the weight of all sparse points that a plane needs to be taken for the ground


@dataclass(frozen=True)
class CameraSettings:
    """What the stage's configuration says, in px of the decoded frames. See `CameraConfig`."""

    focal: float
    refine_focal: bool
    key_every: int
    features: int
    overlap: int
    seed: int


@dataclass(frozen=True)
class CameraPath:
    """K (3, 3) px and T_world_cam (T, 4, 4), world z up, ground z = 0, mean camera height 1, and the report."""

    K: np.ndarray
    T_world_cam: np.ndarray
    report: dict[str, Any]


def estimate_camera(
    frames: np.ndarray, masks: np.ndarray, t: np.ndarray, settings: CameraSettings, progress
) -> CameraPath:
    """Camera of (T, H, W, 3) uint8 RGB frames at times t (T,) s whose subject is masked (T, H, W) bool."""
    h, w = frames.shape[1:3]
    center = np.array([(w - 1) / 2, (h - 1) / 2])
    tracks = background_tracks(frames, masks, progress=lambda f: progress.update(0.15 * f, "tracking the background"))
    keys = np.array(sorted({*range(0, len(frames), settings.key_every), len(frames) - 1}))
    second = max(1, round(1.0 / float(t[1] - t[0]) / settings.key_every))
    gaps = tuple(sorted({1, 3, max(1, second // 2), second, 2 * second}))
    if (motion := _background_motion(tracks)) < _STATIC_PX * max(h, w) / 640:
        report = {"mode": "static", "background_motion_px": motion, "focal_observed": False}
        progress.note(f"camera: static (the background moves by {motion:.2f} px)")
        R = np.tile(np.eye(3), (len(frames), 1, 1))
        return _turning(frames, masks, R, settings.focal, center, report)

    fit = _fit_turning(tracks, keys, gaps, center, settings)
    wide = _wide_residual(tracks, keys, gaps, fit)
    limit = _PARALLAX_PX * max(h, w) / 640
    report = {"background_motion_px": motion, "turning_residual_px": wide}
    progress.update(0.2, f"residual of a turning camera {wide:.2f} px")
    if wide > limit:
        structure = sfm.reconstruct_structure(
            frames,
            masks,
            keys,
            focal=settings.focal,
            refine_focal=settings.refine_focal,
            features=settings.features,
            overlap=settings.overlap,
            seed=settings.seed,
        )
        progress.update(0.8, "structure from motion")
        registered = 0 if structure is None else len(structure.frames)
        report |= {"key_frames": len(keys), "key_frames_registered": registered}
        if structure is not None and registered >= sfm.ENOUGH * len(keys):
            progress.note(
                f"camera: moving (structure from motion, {registered} of {len(keys)} key frames, "
                f"{structure.error_px:.2f} px, focal {structure.focal:.0f} px)"
            )
            return _moving(frames, masks, structure, center, report)
        progress.note(
            f"camera: structure from motion placed only {registered} of {len(keys)} key frames; "
            f"a turning camera is used instead, which is off by {wide:.2f} px"
        )
        report["structure_from_motion_failed"] = True
    else:
        progress.note(f"camera: panning (a turning camera explains the background to {wide:.2f} px)")
    R = _all_rotations(tracks, keys, fit, center, len(frames))
    observed = fit.focal_std < 0.15 * fit.focal
    report |= {
        "mode": "panning",
        "reprojection_error_px": float(np.median(fit.residual)),
        "focal_observed": bool(observed and settings.refine_focal),
        "focal_std_px": float(fit.focal_std) if np.isfinite(fit.focal_std) else None,
    }
    return _turning(frames, masks, R, fit.focal, center, report)


def _background_motion(tracks: Tracks) -> float:
    """px, the median over tracks of how far each gets from where it began; tracks that last long count alone."""
    order = np.lexsort((tracks.frame, tracks.track))
    ids, start, length = np.unique(tracks.track[order], return_index=True, return_counts=True)
    if len(ids) == 0:
        return 0.0
    xy = tracks.xy[order]
    away = np.linalg.norm(xy - np.repeat(xy[start], length, axis=0), axis=-1)
    far = np.maximum.reduceat(away, start)
    return float(np.median(far[length >= np.quantile(length, 0.7)]))


def _fit_turning(
    tracks: Tracks, keys: np.ndarray, gaps, center: np.ndarray, s: CameraSettings
) -> rotation_ba.RotationFit:
    pairs = tracks.pairs(gaps, keys)
    options = {"center": center, "focal": s.focal}
    fit = rotation_ba.fit_rotations(*pairs, len(keys), refine_focal=s.refine_focal, **options)
    if s.refine_focal and not fit.focal_std < 0.15 * fit.focal:
        fit = rotation_ba.fit_rotations(*pairs, len(keys), refine_focal=False, **options)
    return fit


def _wide_residual(tracks: Tracks, keys: np.ndarray, gaps, fit: rotation_ba.RotationFit) -> float:
    """px, median residual of pairs that lie a second or more apart (the widest gap there is, if none do)."""
    which, _, _ = tracks.pairs(gaps, keys)
    gap = which[:, 1] - which[:, 0]
    wide = gap >= min(gaps[-2] if len(gaps) > 1 else gaps[0], gap.max(initial=1))
    return float(np.median(fit.residual[wide])) if wide.any() else 0.0


def _all_rotations(
    tracks: Tracks, keys: np.ndarray, fit: rotation_ba.RotationFit, center: np.ndarray, T: int
) -> np.ndarray:
    """(T, 3, 3): the key frames' rotations, and those between from what they share with the nearest key frame."""
    by_frame = [dict(zip(tracks.track[i].tolist(), tracks.xy[i], strict=True)) for i in _rows_by_frame(tracks, T)]
    R = np.tile(np.eye(3), (T, 1, 1))
    for t in range(T):
        n = int(abs(keys - t).argmin())
        shared = sorted(by_frame[keys[n]].keys() & by_frame[t].keys())
        R[t] = fit.R_world_cam[n]
        if keys[n] != t and len(shared) >= 8:
            seen = np.array([by_frame[keys[n]][i] for i in shared])
            now = np.array([by_frame[t][i] for i in shared])
            R[t] = rotation_ba.rotation_between(fit.R_world_cam[n], fit.focal, center, seen, now)
    return R


def _rows_by_frame(tracks: Tracks, T: int) -> list[np.ndarray]:
    order = np.argsort(tracks.frame, kind="stable")
    return np.split(order, np.searchsorted(tracks.frame[order], np.arange(1, T)))


def _intrinsics(focal: float, center: np.ndarray) -> np.ndarray:
    return np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], float)


def _world_from(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) to a world with z along `up` and y along the horizontal part of `forward`."""
    z = up / np.linalg.norm(up)
    y = forward - (forward @ z) * z
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def _gravity(frames, masks, R: np.ndarray, focal: float, center: np.ndarray) -> ground.Gravity:
    some = np.unique(np.linspace(0, len(frames) - 1, 8).round().astype(int))
    return ground.gravity_from_lines(frames[some], masks[some], R[some], focal, center)


def _gravity_report(g: ground.Gravity) -> dict[str, Any]:
    return {
        "up_source": "vertical lines and prior" if g.lines >= 5 else "prior of hand-held footage",
        "up_lines": g.lines,
        "pitch_deg": float(np.degrees(g.pitch)),
        "pitch_std_deg": float(np.degrees(g.pitch_std)),
        "roll_deg": float(np.degrees(g.roll)),
        "roll_std_deg": float(np.degrees(g.roll_std)),
    }


def _turning(frames, masks, R: np.ndarray, focal: float, center: np.ndarray, report: dict[str, Any]) -> CameraPath:
    """A camera at height 1 that turns by R (T, 3, 3); the first frame's camera is the frame of R."""
    g = _gravity(frames, masks, R, focal, center)
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[:, :3, :3] = _world_from(g.up, R[0][:, 2]) @ R
    T[:, 2, 3] = 1.0
    report |= {"focal_px": float(focal), "scale_source": "camera height set to 1"} | _gravity_report(g)
    return CameraPath(_intrinsics(focal, center), T, report)


def _moving(frames, masks, structure: sfm.Structure, center: np.ndarray, report: dict[str, Any]) -> CameraPath:
    K = _intrinsics(structure.focal, center)
    path, measured = resection.camera_path(frames, structure, K)
    axes = Rotation.from_matrix(path[:, :3, :3]).mean().as_matrix()
    plane = ground.find_ground(structure.points, _near_feet(structure, masks), axes, path[:, :3, 3])
    if plane is not None and plane.support > _GROUND_SUPPORT:
        up, offset = plane.normal, plane.offset
        report |= {
            "up_source": "ground plane",
            "up_std_deg": float(np.degrees(plane.tilt_std)),
            "ground_points": int(plane.inliers.sum()),
            "ground_support": plane.support,
        }
    else:
        g = _gravity(frames, masks, np.swapaxes(path[:1, :3, :3], 1, 2) @ path[:, :3, :3], structure.focal, center)
        up = path[0, :3, :3] @ g.up
        offset = float(np.quantile(structure.points @ up, 0.02))
        report |= _gravity_report(g)
    scale = 1.0 / float((path[:, :3, 3] @ up - offset).mean())
    turn = _world_from(up, path[0, :3, 2])
    T = path.copy()
    T[:, :3, :3] = turn @ path[:, :3, :3]
    T[:, :3, 3] = scale * ((path[:, :3, 3] - path[:, :3, 3].mean(0)) @ turn.T)
    T[:, 2, 3] = scale * (path[:, :3, 3] @ up - offset)
    report |= {
        "mode": "moving",
        "reprojection_error_px": structure.error_px,
        "focal_px": structure.focal,
        "focal_observed": True,
        "frames_measured": int(measured.sum()),
        "sparse_points": len(structure.points),
        "least_angle_deg": structure.least_angle,
        "scale_source": "mean camera height over the ground set to 1",
    }
    return CameraPath(K, T, report)


def _near_feet(structure: sfm.Structure, masks: np.ndarray) -> np.ndarray:
    """(P,) weight of each sparse point: how near it is seen to the mask's lowest point, and how sure its depth is."""
    weight = np.full(len(structure.points), 0.05)
    size = 0.25 * max(masks.shape[1:])
    for n, t in enumerate(structure.frames):
        ys, xs = np.nonzero(masks[t])
        if len(ys) == 0:
            continue
        low = ys >= np.quantile(ys, 0.98)
        foot = np.array([xs[low].mean(), ys[low].mean()])
        rows = structure.observations[:, 0] == n
        near = np.exp(-0.5 * np.sum((structure.xy[rows] - foot) ** 2, axis=-1) / size**2)
        np.maximum.at(weight, structure.observations[rows, 1], near)
    return weight * np.minimum(1.0, _parallax(structure) / np.radians(2.0)) ** 2


def _parallax(structure: sfm.Structure) -> np.ndarray:
    """(P,) rad, angle between the rays to each point from the first and the last frame that see it."""
    centers = structure.T_world_cam[:, :3, 3]
    first, last = np.full(len(structure.points), len(centers) - 1), np.zeros(len(structure.points), int)
    np.minimum.at(first, structure.observations[:, 1], structure.observations[:, 0])
    np.maximum.at(last, structure.observations[:, 1], structure.observations[:, 0])
    a, b = (centers[n] - structure.points for n in (first, last))
    cosine = (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-12)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
