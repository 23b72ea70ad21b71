"""Camera motion, focal length and ground of a clip: which model holds is measured, and named.

- "static": the background does not move.
- "panning": the camera turns about its centre; rotations alone explain the background.
- "moving": there is parallax; structure from motion.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation, Slerp

from slomo.reconstruct import certainty, rotation_ba, sfm
from slomo.reconstruct.camera_world import GUESSED_SCALE, CameraPath, moving, turning
from slomo.reconstruct.tracked_path import IN_FRONT, Epipolar, track_path
from slomo.reconstruct.tracks import Tracks, background_tracks

Pairs = tuple[np.ndarray, np.ndarray, np.ndarray]  # of correspondences, see Tracks.pairs

_STATIC_PX = 0.7  # px, background displacement below which a camera stands still (at 640 px; noise of the tracks)
_PARALLAX_PX = 0.5  # px, residual of the turning camera over a second and more, above which there is parallax
_LEAST_CORNERS = 12  # in a frame, in the median, below which the background says nothing about the camera
_LEAST_SHARED = 8  # corners that two frames must have in common for the turn between them to be known
_MOST_KEYS = 120  # key frames that are enough for any clip, as long as none is farther from the next than this:
_KEY_GAP = 0.5  # s
_MOST_GUESSED = 0.05  # part of the frames whose camera may be interpolated without a word
_AGREES = 1.3  # of its epipolar cost, up to which bundle adjustment with other corners has kept it
_MOST_PAIRS = 24_000  # correspondences for a turning camera, drawn from those there are


@dataclass(frozen=True)
class CameraSettings:
    """What the stage's configuration says, in px of the decoded frames. See `CameraConfig`."""

    focal: float
    focal_std: float
    refine_focal: bool
    key_every: int
    features: int
    overlap: int
    seed: int


def estimate_camera(
    frames: np.ndarray, masks: np.ndarray, t: np.ndarray, settings: CameraSettings, progress
) -> CameraPath:
    """Camera of (T, H, W, 3) uint8 RGB frames at times t (T,) s whose subject is masked (T, H, W) bool."""
    h, w = frames.shape[1:3]
    center = np.array([(w - 1) / 2, (h - 1) / 2])
    tracks = background_tracks(frames, masks, progress=lambda f: progress.update(0.15 * f, "tracking the background"))
    corners = _corners(tracks, len(frames))
    report: dict[str, Any] = {"background_corners": int(np.median(corners)), "fallback": None}
    if report["background_corners"] < _LEAST_CORNERS:
        report |= {"mode": "static", "fallback": "the background shows too few corners to follow"}
        report |= {"reprojection_error_px": None, "focal_observed": False}
        progress.note("camera: taken as static, because the background shows too few corners to follow")
        return turning(
            frames, masks, np.tile(np.eye(3), (len(frames), 1, 1)), settings.focal, settings.focal_std, center, report
        )

    shown = np.flatnonzero(corners >= _LEAST_SHARED)
    keys, gaps = _key_frames(t, shown, settings.key_every)
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
        turned = fit  # the search for the path begins with the focal length that is set
        if fit.focal != settings.focal:
            turned = _fit_turning(pairs, len(keys), center, replace(settings, refine_focal=False))
        structure = _structure(frames, masks, t, tracks, shown, turned.R_world_cam, settings, report, progress)
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


def _key_frames(
    t: np.ndarray, shown: np.ndarray, every: int, most: int = _MOST_KEYS
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Key frames of frames at t (T,) s: each n-th, sparser where there would be very many, or the nearest of those in
    which the background is `shown` (F,); and the gaps between them, counted in key frames, over which tracks are
    compared: from one to the next up to two seconds."""
    step = float(t[1] - t[0])
    every = max(every, min(-(-len(t) // most), int(_KEY_GAP / step)))
    second = max(1, round(1.0 / step / every))
    gaps = tuple(sorted({1, 3, max(1, second // 2), second, 2 * second}))
    wanted = np.array(sorted({*range(0, len(t), every), len(t) - 1}))
    return np.unique(shown[np.searchsorted((shown[1:] + shown[:-1]) / 2, wanted)]), gaps


def _structure(
    frames,
    masks,
    t,
    tracks: Tracks,
    shown: np.ndarray,
    turning_R: np.ndarray,
    s: CameraSettings,
    report: dict[str, Any],
    progress,
) -> sfm.Structure | None:
    """Structure from motion of the key frames: from the path that the tracks give, and where that is in doubt, from a
    pair of frames too, once more with twice as many of them where they were thinned: what explains the tracks better.
    None when too few are placed. The report says how many, and which it is. A structure is kept in a checkpoint."""
    if (saved := progress.load()) is not None:
        structure = sfm.Structure.of(saved)
        report |= {"key_frames": int(saved["key_frames"]), "key_frames_registered": len(structure.frames)}
        report["structure_start"] = "tracks" if saved["from_tracks"] else "pair"
        return structure
    h, w = frames.shape[1:3]
    center = np.array([(w - 1) / 2, (h - 1) / 2])
    keys, gaps = _key_frames(t, shown, s.key_every)

    def solve(keys: np.ndarray, focal: float, path: np.ndarray | None = None) -> sfm.Structure | None:
        return sfm.reconstruct_structure(
            frames,
            masks,
            keys,
            focal=focal,
            refine_focal=s.refine_focal,
            features=s.features,
            overlap=s.overlap,
            seed=s.seed,
            path=path,
            waiting=partial(_waiting, progress, 1.5 * len(keys)),
        )

    def done(structure: sfm.Structure, keys: np.ndarray, start: str) -> sfm.Structure:
        report.update(key_frames=len(keys), key_frames_registered=len(structure.frames), structure_start=start)
        more = {"key_frames": np.array(len(keys)), "from_tracks": np.array(start == "tracks")}
        progress.save(structure.arrays() | more)
        return structure

    placed, explained, path = None, np.inf, None
    if (epipolar := Epipolar(tracks, keys, gaps, center, s.seed)).least_shared >= _LEAST_CORNERS:
        refine = s.refine_focal
        path = track_path(epipolar, tracks, keys, center, s.focal, s.seed, turning_R, refine_focal=refine)
    if path is not None:
        if path.in_front > IN_FRONT and (structure := solve(keys, path.focal, path.T_world_cam)):
            explained = epipolar.cost(structure.T_world_cam, structure.focal)
            placed = structure if explained < _AGREES * path.cost else None
        if placed and path.agreed:
            return done(placed, keys, "tracks")
    tried = 0
    for most in (_MOST_KEYS, 2 * _MOST_KEYS):
        more, _ = _key_frames(t, shown, s.key_every, most)
        if len(more) == tried:
            break
        tried = len(more)
        mapped = solve(more, s.focal)
        report |= {"key_frames": tried, "key_frames_registered": 0 if mapped is None else len(mapped.frames)}
        if mapped is not None and len(mapped.frames) >= sfm.ENOUGH * tried:
            compared = Epipolar(tracks, mapped.frames, gaps, center, s.seed)
            if explained < compared.cost(mapped.T_world_cam, mapped.focal) and placed:
                break
            return done(mapped, more, "pair")
    return done(placed, keys, "tracks") if placed else None


def _waiting(progress, usual: float, took: float) -> None:
    """The share of structure from motion's work that is done can only be guessed, from the s that it takes usually."""
    progress.update(0.2 + 0.6 * took / (took + usual), "structure from motion")


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
