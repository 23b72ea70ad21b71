"""`slomo doctor`: whether this installation can do its work, and what it would use."""

import importlib
import importlib.metadata
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from slomo.errors import SlomoError

ENOUGH_DISK = 2e9  # bytes


@dataclass(frozen=True)
class Check:
    """One line of the examination; `needed` says whether slomo can work without it."""

    name: str
    ok: bool
    detail: str
    needed: bool = True


def _imports(module: str, distribution: str) -> Check:
    try:
        importlib.import_module(module)
    except Exception as e:  # a broken binary may raise anything
        return Check(distribution, False, f"cannot be imported: {e}; reinstall it")
    return Check(distribution, True, importlib.metadata.version(distribution))


def _devices() -> Check:
    import torch

    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA device, the CPU is used"
    return Check("devices", True, f"{os.cpu_count()} CPUs; {gpu}")


def _robots() -> Check:
    from slomo.pipeline import load_robot
    from slomo.robot_file import robot_folders

    bad = []
    for name in sorted(robot_folders()):
        try:
            load_robot(name)
        except SlomoError as e:
            bad.append(str(e))
    found = ", ".join(sorted(robot_folders())) or "none found"
    return Check("robots", not bad and bool(robot_folders()), "; ".join(bad) or found)


def _weights() -> Check:
    import pooch

    from slomo.reconstruct.u2net import WEIGHTS_NAME, WEIGHTS_VARIABLE, find_weights

    cached = Path(pooch.os_cache("slomo")) / WEIGHTS_NAME
    looked = f"{WEIGHTS_VARIABLE}={os.environ.get(WEIGHTS_VARIABLE, '(unset)')}, {cached}"
    try:
        path = find_weights()
    except SlomoError as e:
        return Check("weights", False, str(e))
    if path is None:
        return Check("weights", False, f"none in {looked}; run `slomo weights fetch`, or motion is used", needed=False)
    return Check("weights", True, f"{path} (looked in {looked})")


def _video() -> Check:
    import av
    from av.codec import Codec

    missing = []
    try:
        Codec("h264", "r")
    except ValueError:
        missing.append("h264 decoder")
    try:
        Codec("libx264", "w")
    except ValueError:
        missing.append("libx264 encoder")
    ffmpeg = ".".join(map(str, av.library_versions.get("libavcodec", ())))
    return Check(
        "video", not missing, f"libavcodec {ffmpeg}: {'no ' + ', '.join(missing) if missing else 'H.264 in and out'}"
    )


def _numba_cache() -> Check:
    import slomo

    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(slomo.__file__).parent)
    if _writable(folder):
        return Check("numba cache", True, str(folder))
    return Check(
        "numba cache", False, f"{folder} is read-only: compiled again at each start; set NUMBA_CACHE_DIR", False
    )


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _disk(root: Path) -> Check:
    there = next(p for p in (root, *root.parents) if p.exists())
    free = shutil.disk_usage(there).free
    return Check("disk", free > ENOUGH_DISK, f"{free / 1e9:.1f} GB free in {there}", needed=False)


def _project(root: Path) -> Check:
    there = next(p for p in (root, *root.parents) if p.is_dir())
    return Check("project", _writable(there), f"{root} {'can' if _writable(there) else 'cannot'} be written")


def examine(root: Path) -> list[Check]:
    """All checks, for the project folder `root`. Slow: it imports everything."""
    modules = {
        "numpy": "numpy", "scipy": "scipy", "torch": "torch", "warp": "warp-lang", "cv2": "opencv-python-headless",
        "av": "av", "onnxruntime": "onnxruntime", "pycolmap": "pycolmap", "numba": "numba", "casadi": "casadi",
        "clarabel": "clarabel", "pinocchio": "pin", "mujoco": "mujoco", "matplotlib": "matplotlib",
    }  # fmt: skip
    checks = [_imports(module, distribution) for module, distribution in modules.items()]
    for check in (_devices, _robots, _weights, _video, _numba_cache):
        try:
            checks.append(check())
        except Exception as e:  # of a broken package; its own line says more
            checks.append(Check(check.__name__.strip("_"), False, f"{type(e).__name__}: {e}"))
    return [*checks, _project(root), _disk(root)]
