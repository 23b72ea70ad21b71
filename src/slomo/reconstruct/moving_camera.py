"""Structure from motion of a clip: which of several starts leads to the cameras that explain the tracks best."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from slomo.reconstruct import sfm
from slomo.reconstruct.camera_world import CameraSettings
from slomo.reconstruct.rotation_ba import RotationFit
from slomo.reconstruct.tracked_path import IN_FRONT, Epipolar, TrackedPath, track_path
from slomo.reconstruct.tracks import Tracks

LEAST_CORNERS = 12  # in a frame, in the median, below which the background says nothing about the camera
_MOST_KEYS = 120  # key frames that are enough for any clip, as long as none is farther from the next than this:
_KEY_GAP = 0.5  # s
_AGREES = 1.3  # of its epipolar cost, up to which bundle adjustment with other corners has kept it
# Two structures are the same whose epipolar costs and focal lengths are so near (costs: the one over the other).
_SAME_COST, _SAME_FOCAL = 0.95, 0.01


def key_frames(
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


def find_structure(
    frames: np.ndarray,
    masks: np.ndarray,
    t: np.ndarray,
    tracks: Tracks,
    shown: np.ndarray,
    turned: RotationFit,
    freed: RotationFit,
    s: CameraSettings,
    report: dict[str, Any],
    progress,
) -> sfm.Structure | None:
    """Structure from motion of the key frames: from the paths that the tracks give, and where those are in doubt, from
    a pair of frames too, once more with twice as many of them where they were thinned: what explains the tracks better.
    None when too few are placed. The report says how many, and which it is. A structure is kept in a checkpoint.

    Args:
        frames: (T, H, W, 3) uint8 RGB.  masks: (T, H, W) bool.  t: (T,) s.  tracks: of the background.
        shown: (F,) frames that show enough of it.
        turned: turning camera of the key frames with the focal length of the settings.  freed: with any.
    """
    if (saved := progress.load()) is not None:
        structure = sfm.Structure.of(saved)
        report |= {"key_frames": int(saved["key_frames"]), "key_frames_registered": len(structure.frames)}
        report["structure_start"] = "tracks" if saved["from_tracks"] else "pair"
        return structure
    with sfm.workspace() as folder:
        found = _found(folder, frames, masks, t, tracks, shown, turned, freed, s, report, progress)
    if found is None:
        return None
    structure, keys, start = found
    report.update(key_frames=len(keys), key_frames_registered=len(structure.frames), structure_start=start)
    more = {"key_frames": np.array(len(keys)), "from_tracks": np.array(start == "tracks")}
    progress.save(structure.arrays() | more)
    return structure


def _found(
    folder: Path, frames, masks, t, tracks: Tracks, shown, turned, freed, s: CameraSettings, report, progress
) -> tuple[sfm.Structure, np.ndarray, str] | None:
    """A structure, its key frames, and what it began with: "tracks" or "pair"."""
    h, w = frames.shape[1:3]
    center = np.array([(w - 1) / 2, (h - 1) / 2])
    keys, gaps = key_frames(t, shown, s.key_every)
    began, usual = time.monotonic(), 1.5 * len(keys)

    def waiting(_: float) -> None:
        """The share of the work that is done can only be guessed, from the seconds that it takes usually."""
        took = time.monotonic() - began
        progress.update(0.2 + 0.6 * took / (took + usual), "structure from motion")

    def solve(keys: np.ndarray, path: TrackedPath | None = None) -> sfm.Structure | None:
        return sfm.reconstruct_structure(
            frames,
            masks,
            keys,
            focal=path.focal if path else s.focal,
            refine_focal=s.refine_focal,
            features=s.features,
            overlap=s.overlap,
            seed=s.seed,
            path=path.T_world_cam if path else None,
            folder=folder,
            waiting=waiting,
        )

    placed, explained, agreed = None, np.inf, False
    if (epipolar := Epipolar(tracks, keys, gaps, center, s.seed)).least_shared >= LEAST_CORNERS:
        free = freed if s.refine_focal else None
        for path in track_path(epipolar, tracks, keys, center, s.focal, s.seed, turned.R_world_cam, freed=free):
            if not (path.in_front > IN_FRONT and (structure := solve(keys, path))):
                continue
            cost = epipolar.cost(structure.T_world_cam, structure.focal)
            if placed:
                agreed = _same(placed, explained, structure, cost)
            if cost < min(explained, _AGREES * path.cost):
                placed, explained, agreed = structure, cost, agreed or path.agreed
        if placed and agreed:
            return placed, keys, "tracks"
    tried = 0
    for most in (_MOST_KEYS, 2 * _MOST_KEYS):
        more, _ = key_frames(t, shown, s.key_every, most)
        if len(more) == tried:
            break
        tried = len(more)
        mapped = solve(more)
        report |= {"key_frames": tried, "key_frames_registered": 0 if mapped is None else len(mapped.frames)}
        if mapped is not None and len(mapped.frames) >= sfm.ENOUGH * tried:
            compared = Epipolar(tracks, mapped.frames, gaps, center, s.seed)
            if explained < compared.cost(mapped.T_world_cam, mapped.focal) and placed:
                break
            return mapped, more, "pair"
    return (placed, keys, "tracks") if placed else None


def _same(a: sfm.Structure, cost_a: float, b: sfm.Structure, cost_b: float) -> bool:
    near = min(cost_a, cost_b) > _SAME_COST * max(cost_a, cost_b)
    return near and abs(math.log(a.focal / b.focal)) < _SAME_FOCAL
