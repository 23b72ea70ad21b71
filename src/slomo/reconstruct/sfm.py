"""Structure from motion by COLMAP (Schönberger and Frahm, CVPR 2016) on masked key frames, in a process of its own.

The process (`python -m slomo.reconstruct.colmap DIR`) keeps pycolmap and OpenCV, which do not load together, apart.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import StageFailed

_CRASHED = (-signal.SIGSEGV, -signal.SIGABRT)
_PREFIX = "slomo-sfm-"  # of folders for temporary files; the id of the process that made it follows

ENOUGH = 0.6  # part of the key frames that a model must hold to be used


@dataclass(frozen=True)
class Structure:
    """A sparse reconstruction of some frames; world frame and scale are arbitrary.

    Attributes:
        frames: (N,) int, the registered frames, increasing.
        T_world_cam: (N, 4, 4) OpenCV convention.
        focal: px.
        points: (P, 3).
        observations: (M, 2) int rows (place in `frames`, point).  xy: (M, 2) px, pixel centres at integers.
        error_px: mean reprojection error.
        least_angle: degrees, least angle between rays at which points were accepted.
    """

    frames: np.ndarray
    T_world_cam: np.ndarray
    focal: float
    points: np.ndarray
    observations: np.ndarray
    xy: np.ndarray
    error_px: float
    least_angle: float

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "Structure":
        """From the arrays of the same names; numbers are arrays without axes."""
        values = {f.name: np.asarray(arrays[f.name]) for f in fields(cls)}
        plain: dict[str, Any] = {k: v if v.ndim else float(v) for k, v in values.items()}
        return cls(**plain)

    def arrays(self) -> dict[str, np.ndarray]:
        """What `of` makes it from."""
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """(P,) each: the places in `frames` of the first and the last frame that sees each point."""
        frame, point = self.observations.T
        first, last = np.full(len(self.points), len(self.frames) - 1), np.zeros(len(self.points), int)
        np.minimum.at(first, point, frame)
        np.maximum.at(last, point, frame)
        return first, last


@contextlib.contextmanager
def workspace() -> Iterator[Path]:
    """A folder in which features and matches stay from one `reconstruct_structure` to the next."""
    _remove_orphans()
    with tempfile.TemporaryDirectory(prefix=f"{_PREFIX}{os.getpid()}-") as folder:
        yield Path(folder)


def reconstruct_structure(
    frames: np.ndarray,
    masks: np.ndarray,
    keys: np.ndarray,
    *,
    focal: float,
    refine_focal: bool,
    features: int,
    overlap: int,
    seed: int = 0,
    threads: int = 1,
    path: np.ndarray | None = None,
    folder: Path | None = None,
    waiting: Callable[[float], None] = lambda seconds: None,
) -> Structure | None:
    """Cameras of the frames `keys` and sparse points of what is not masked; None when COLMAP finds no model or crashes.

    Args:
        frames: (T, H, W, 3) uint8 RGB.  masks: (T, H, W) bool, left out.
        focal: px, start, kept when not `refine_focal`.  features: per frame.  overlap: frames matched with each.
        threads: of COLMAP after its features; with more than one, each run gives slightly other numbers.
        path: (N, 4, 4) cameras of `keys` that are known but for a little; without, they are found.
        folder: of `workspace`, for several models of the same key frames, which are known by their number; features and
            matches are the first one's. Without, it is the call's own.
        waiting: called twice a second with the seconds that it has taken; what it raises ends the process.

    Raises:
        StageFailed: the process failed.
    """
    with workspace() if folder is None else contextlib.nullcontext(folder) as kept:
        root = kept / str(len(keys))
        if not root.exists():
            _write(root, frames, masks, keys)
        height, width = frames.shape[1:3]
        job = {
            "focal": focal,
            "center": [width / 2, height / 2],
            "refine_focal": refine_focal,
            "features": features,
            "overlap": overlap,
            "seed": seed,
            "threads": threads,
            "path": None if path is None else {_name(k): T.tolist() for k, T in zip(keys, path, strict=True)},
        }
        (root / "job.json").write_text(json.dumps(job))
        (root / "out.npz").unlink(missing_ok=True)
        status = _run([sys.executable, "-P", "-m", "slomo.reconstruct.colmap", str(root)], root / "errors.txt", waiting)
        if status in _CRASHED:  # COLMAP does on some pictures of a few textures; killed is another thing
            return None
        if status:
            last = ((root / "errors.txt").read_text().strip().splitlines() or ["no message"])[-1]
            raise StageFailed(f"structure from motion ended with status {status}: {last}", where="camera")
        if not (root / "out.npz").exists():
            return None
        with np.load(root / "out.npz") as z:
            return Structure.of({k: z[k] for k in z.files})


def _write(root: Path, frames: np.ndarray, masks: np.ndarray, keys: np.ndarray) -> None:
    """The pictures and what of them is free of the subject."""
    import cv2

    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    around = np.ones((9, 9), np.uint8)
    for k in keys:
        cv2.imwrite(str(root / "images" / _name(k)), frames[k][..., ::-1])
        free = 255 - 255 * cv2.dilate(masks[k].astype(np.uint8), around)
        cv2.imwrite(str(root / "masks" / f"{_name(k)}.png"), free)


def _name(key: int) -> str:
    return f"{key:06d}.png"


def _run(command: list[str], errors: Path, waiting: Callable[[float], None]) -> int:
    """Exit status of a process. The terminal's signals end it too: `waiting` is asked once more after its end."""
    began = time.monotonic()
    with open(errors, "wb") as f:
        process = subprocess.Popen(command, stdout=f, stderr=f)
    try:
        while process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.5)
            waiting(time.monotonic() - began)
        return process.returncode
    finally:
        process.kill()
        process.wait()


def _remove_orphans() -> None:
    """Remove what killed processes left in the folder for temporary files."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        owner = folder.name.removeprefix(_PREFIX).split("-")[0]
        if owner.isdecimal() and not _alive(int(owner)):
            shutil.rmtree(folder, ignore_errors=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # of another user
    return True
