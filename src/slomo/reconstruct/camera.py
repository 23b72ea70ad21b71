"""Camera motion, focal length and ground of a clip: which model holds is measured, and named.

- "static": the background does not move.
- "panning": the camera turns about its centre; rotations alone explain the background.
- "moving": there is parallax; structure from motion.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation, Slerp

from slomo.reconstruct import certainty, rotation_ba
from slomo.reconstruct.camera_world import GUESSED_SCALE, CameraPath, CameraSettings, moving, turning
from slomo.reconstruct.moving_camera import LEAST_CORNERS, find_structure, key_frames
from slomo.reconstruct.tracks import Tracks, background_tracks

Pairs = tuple[np.ndarray, np.ndarray, np.ndarray]  # of correspondences, see Tracks.pairs

_STATIC_PX = 0.7  # px, background displacement below which a camera stands still (at 640 px; noise of the tracks)
_PARALLAX_PX = 0.5  # px, residual of the turning camera over a second and more, above which there is parallax
_LEAST_SHARED = 8  # corners that two frames must have in common for the turn between them to be known
_MOST_GUESSED = 0.05  # part of the frames whose camera may be interpolated without a word
_MOST_PAIRS = 24_000  # correspondences for a turning camera, drawn from those there are


def estimate_camera(
    frames: np.ndarray, masks: np.ndarray, t: np.ndarray, settings: CameraSettings, progress
) -> CameraPath:
    """Camera of (T, H, W, 3) uint8 RGB frames at times t (T,) s whose subject is masked (T, H, W) bool."""
    h, w = frames.shape[1:3]
    center = np.array([(w - 1) / 2, (h - 1) / 2])
    tracks = background_tracks(frames, masks, progress=lambda f: progress.update(0.15 * f, "tracking the background"))
    corners = _corners(tracks, len(frames))
    report: dict[str, Any] = {"background_corners": int(np.median(corners)), "fallback": None}
    if report["background_corners"] < LEAST_CORNERS:
        report |= {"mode": "static", "fallback": "the background shows too few corners to follow"}
        report |= {"reprojection_error_px": None, "focal_observed": False}
        progress.note("camera: taken as static, because the background shows too few corners to follow")
        return turning(
            frames, masks, np.tile(np.eye(3), (len(frames), 1, 1)), settings.focal, settings.focal_std, center, report
        )

    shown = np.flatnonzero(corners >= _LEAST_SHARED)
    keys, gaps = key_frames(t, shown, settings.key_every)
    pairs = tracks.pairs(gaps, keys)
    breaks = _breaks(pairs[0], t[keys])
    report["background_motion_px"] = motion = _background_motion(tracks, shown)
    if motion < _STATIC_PX * max(h, w) / 640:
        report |= {"mode": "static", "reprojection_error_px": motion, "focal_observed": False}
        progress.note(f"camera: static (the background moves by {motion:.2f} px)")
        _name_breaks(breaks, report, progress)
        return turning(
            frames, masks, np.tile(np.eye(3), (len(frames), 1, 1)), settings.focal, settings.focal_std, center, report
        )

    pairs = _drawn(pairs, settings.seed)
    fit = _fit_turning(pairs, len(keys), center, settings)
    parallax, limit = _wide_residual(pairs[0], gaps, fit), _PARALLAX_PX * max(h, w) / 640
    report |= {"parallax_px": parallax, "parallax_limit_px": limit}
    progress.update(0.2, f"residual of a turning camera {parallax:.2f} px")
    if parallax > limit:
        turned = fit  # of the focal length that is set, with which the search for the path begins
        if fit.focal != settings.focal:
            turned = _fit_turning(pairs, len(keys), center, replace(settings, refine_focal=False))
        structure = find_structure(frames, masks, t, tracks, shown, turned, fit, settings, report, progress)
        if structure is not None:
            progress.note(
                f"camera: moving (structure from motion, {len(structure.frames)} of {report['key_frames']} key frames, "
                f"{structure.error_px:.2f} px, focal {structure.focal:.0f} px)"
            )
            report["focal_observed"] = settings.refine_focal
            std = certainty.focal_std(structure, center) if settings.refine_focal else settings.focal_std
            path = moving(frames, masks, structure, std, center, report)
            for at in path.report["scale_breaks"]:
                progress.note(
                    f"camera: the path broke at {t[at['after_frame']]:.1f} s into parts of unlike scale (times "
                    f"{at['times']:.2g}), and was mended by the height over the ground"
                )
            if path.report["scale_source"] == GUESSED_SCALE:
                _name(report, progress, "no ground is seen under the camera", ": its height is a guess")
            if (guessed := len(frames) - path.report["frames_measured"]) > _MOST_GUESSED * len(frames):
                what = f"the camera of {guessed} of {len(frames)} frames is interpolated"
                _name(report, progress, what, ": structure from motion does not reach them")
            return path
        what = f"structure from motion placed {report['key_frames_registered']} of {report['key_frames']} key frames"
        _name(report, progress, what, f"; a turning camera is used instead, which is off by {parallax:.2f} px")
    else:
        progress.note(f"camera: panning (a turning camera explains the background to {parallax:.2f} px)")
    _name_breaks(breaks, report, progress)
    R = _all_rotations(tracks, keys, fit, center, len(frames))
    report |= {
        "mode": "panning",
        "reprojection_error_px": float(np.median(fit.residual)) if len(fit.residual) else None,
        "focal_observed": bool(fit.focal_std < 0.15 * fit.focal and settings.refine_focal),
    }
    std = fit.focal_std if report["focal_observed"] else settings.focal_std
    return turning(frames, masks, R, fit.focal, std, center, report)


def _name(report: dict[str, Any], progress, what: str, more: str) -> None:
    """Say in the report and on the screen (there with `more`) what does not work."""
    report["fallback"] = f"{report['fallback']}; {what}" if report["fallback"] else what
    progress.note(f"camera: {what}{more}")


def _name_breaks(breaks: np.ndarray, report: dict[str, Any], progress) -> None:
    """Say where key frames have nothing to do with those before them, if they do."""
    if len(breaks):
        times = f"at {breaks[0]:.1f} s" if len(breaks) == 1 else f"{len(breaks)} times, first at {breaks[0]:.1f} s"
        what = f"the background's tracks break {times}"
        _name(report, progress, what, ": how the camera before is turned against the one after is not known")


def _breaks(which: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Times, of those of the key frames t (N,) s, from which on no chain of key frames that share tracks leads back to
    the one before; `which` as of `Tracks.pairs`."""
    N = len(t)
    shared = np.bincount(which @ [N, 1], minlength=N * N).reshape(N, N)
    _, part = connected_components(shared >= _LEAST_SHARED, directed=False)
    return t[1:][part[1:] != part[:-1]]


def _corners(tracks: Tracks, T: int) -> np.ndarray:
    """(T,) corners followed in each frame; those seen in one frame only do not count."""
    long = np.bincount(tracks.track)[tracks.track] > 1 if len(tracks.track) else np.zeros(0, bool)
    return np.bincount(tracks.frame[long], minlength=T)


def _background_motion(tracks: Tracks, shown: np.ndarray) -> float:
    """px, the median over tracks in the frames `shown` (F,) of how far each gets from where it began; tracks that last
    long count alone."""
    order = np.lexsort((tracks.frame, tracks.track))
    order = order[np.isin(tracks.frame[order], shown)]
    ids, start, length = np.unique(tracks.track[order], return_index=True, return_counts=True)
    if len(ids) == 0:
        return 0.0
    xy = tracks.xy[order]
    away = np.linalg.norm(xy - np.repeat(xy[start], length, axis=0), axis=-1)
    far = np.maximum.reduceat(away, start)
    return float(np.median(far[length >= np.quantile(length, 0.7)]))


def _drawn(pairs: Pairs, seed: int) -> Pairs:
    """As many of the correspondences as are of use."""
    if len(pairs[0]) <= _MOST_PAIRS:
        return pairs
    drawn = np.sort(np.random.default_rng(seed).choice(len(pairs[0]), _MOST_PAIRS, replace=False))
    return pairs[0][drawn], pairs[1][drawn], pairs[2][drawn]


def _fit_turning(pairs: Pairs, count: int, center: np.ndarray, s: CameraSettings) -> rotation_ba.RotationFit:
    options = {"center": center, "focal": s.focal}
    fit = rotation_ba.fit_rotations(*pairs, count, refine_focal=s.refine_focal, **options)
    if s.refine_focal and not fit.focal_std < 0.15 * fit.focal:
        fit = rotation_ba.fit_rotations(*pairs, count, refine_focal=False, **options)
    return fit


def _wide_residual(which: np.ndarray, gaps: tuple[int, ...], fit: rotation_ba.RotationFit) -> float:
    """px, median residual of pairs that lie a second or more apart (the widest gap there is, if none do)."""
    gap = which[:, 1] - which[:, 0]
    wide = gap >= min(*gaps[-2:], gap.max(initial=1))
    return float(np.median(fit.residual[wide])) if wide.any() else 0.0


def _all_rotations(
    tracks: Tracks, keys: np.ndarray, fit: rotation_ba.RotationFit, center: np.ndarray, T: int
) -> np.ndarray:
    """(T, 3, 3): the key frames' rotations, and those between from what they share with the nearest key frame; where
    that is next to nothing, on the way from the frame before to the one after."""
    rows = tracks.rows_by_frame(T)
    R = np.tile(np.eye(3), (T, 1, 1))
    R[keys] = fit.R_world_cam
    known = np.isin(np.arange(T), keys)
    for t in np.flatnonzero(~known):
        n = int(abs(keys - t).argmin())
        a, b = rows[keys[n]], rows[t]
        _, i, j = np.intersect1d(tracks.track[a], tracks.track[b], assume_unique=True, return_indices=True)
        if len(i) >= _LEAST_SHARED:
            seen, now = tracks.xy[a[i]], tracks.xy[b[j]]
            R[t] = rotation_ba.rotation_between(fit.R_world_cam[n], fit.focal, center, seen, now)
            known[t] = True
    at, lost = np.flatnonzero(known), np.flatnonzero(~known)
    R[lost] = Slerp(at, Rotation.from_matrix(R[at]))(lost.clip(at[0], at[-1])).as_matrix()
    return R
