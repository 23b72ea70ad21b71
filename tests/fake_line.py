"""A line of stages that do next to nothing, for testing the machinery around them.

Run as a program it is `slomo` with these stages: `python fake_line.py reconstruct clip.txt`. With the environment
variable FAKE_GATE the fit stops in its middle until that file exists.
"""

import ctypes
import dataclasses
import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from slomo import pipeline
from slomo.errors import InvalidData, UsageError
from slomo.stage import Artifact, Inputs, Progress

MASKS_VERSION = CAMERA_VERSION = FIT_VERSION = REFINE_VERSION = VERSION = 1


@dataclasses.dataclass(frozen=True)
class DecodeConfig:
    start: float = 0.0  # s, from the first frame
    duration: float = 0.0  # s, 0: all
    slow_motion: float = 0.0


@dataclasses.dataclass(frozen=True)
class MasksConfig:
    segmenter: str = "motion"
    subject_at: tuple[float, ...] = ()
    subject_box: tuple[float, ...] = ()
    quality: str = "normal"


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    fov_deg: float = 0.0
    quality: str = "normal"


@dataclasses.dataclass(frozen=True)
class FitConfig:
    skeleton: str = "auto"
    length_m: float = 0.5
    iterations: int = 20
    seed: int = 0
    fps: float = 15.0
    quality: str = "normal"

    def __post_init__(self):
        if self.iterations < 1:
            raise UsageError(f"iterations = {self.iterations}: expected at least 1")


@dataclasses.dataclass(frozen=True)
class ReconstructConfig(FitConfig):
    """Those of the fit."""


@dataclasses.dataclass(frozen=True)
class EvidenceConfig:
    prior: str = "auto"
    skeleton: str = "auto"
    fps: float = 15.0


@dataclasses.dataclass(frozen=True)
class Config:
    """Parameters.

    Attributes:
        gain: of nothing.  names: some names.
        mode: "good", "bad" (fails), "crash", "full" (disk), or "print".
    """

    gain: float = 1.0
    names: tuple[str, ...] = ("a", "b")
    mode: str = "good"


@dataclasses.dataclass(frozen=True)
class TrialsConfig(Config):
    """Those of the others, and how many."""

    trials: int = 200
    rows: tuple[str, ...] = ("none", "mass")
    controllers: tuple[str, ...] = ("ci-mpc",)


@dataclasses.dataclass(frozen=True)
class ReplayConfig(Config):
    """Those of the others, and which."""

    trial: str = ""


def run_decode(inputs: Inputs, config: DecodeConfig, progress: Progress) -> Artifact:
    content = inputs.files["clip"].read_bytes()
    if not content:
        raise InvalidData("the file is empty", where=inputs.files["clip"])
    return Artifact(npz={"frames.npz": {"frames": np.frombuffer(content, np.uint8), "t": np.arange(len(content)) / 30}})


def run_masks(inputs: Inputs, config: MasksConfig, progress: Progress) -> Artifact:
    progress.note(f"masks by {config.segmenter}")
    masks = inputs.artifacts["decode"].npz["frames.npz"]["frames"] > 64
    report = {"segmenter": config.segmenter, "solve_seconds": time.time()}
    return Artifact(npz={"masks.npz": {"packed": masks}}, json={"report.json": report})


def run_camera(inputs: Inputs, config: CameraConfig, progress: Progress) -> Artifact:
    return Artifact(npz={"camera.npz": {"K": np.eye(3) * (1 + config.fov_deg)}})


def run_evidence(inputs: Inputs, config: EvidenceConfig, progress: Progress) -> Artifact:
    report = {"skeleton": config.skeleton, "files": sorted(inputs.files)}
    return Artifact(npz={"evidence.npz": {"frame": np.zeros(0, int)}}, json={"report.json": report})


def run_fit(inputs: Inputs, config: FitConfig, progress: Progress) -> Artifact:
    state = progress.load() or {
        "x": np.zeros(4),
        "i": np.array(0),
        "rng": _rng_state(np.random.default_rng(config.seed)),
    }
    x, i = state["x"], int(state["i"])
    rng = _rng(state["rng"])
    while i < config.iterations:
        x, i = 0.9 * x + rng.normal(size=4), i + 1
        progress.update(i / config.iterations, f"iteration {i}")
        if progress.checkpoint_due() or i % 2 == 0:
            progress.save({"x": x, "i": np.array(i), "rng": _rng_state(rng)})
        while i == config.iterations // 2 and not Path(os.environ.get("FAKE_GATE", ".")).exists():
            time.sleep(0.02)
            progress.update(i / config.iterations, "waiting at the gate")
    return Artifact(npz={"fit.npz": {"x": x}}, json={"report.json": {"iterations": i}})


def run_refine(inputs: Inputs, config: ReconstructConfig, progress: Progress) -> Artifact:
    x, t = inputs.artifacts["fit"].npz["fit.npz"]["x"], np.arange(5) / 30
    arrays = {"t": t, "keypoints": np.tile(x[:3], (5, 2, 1)), "keypoint_names": np.array(["a", "b"])}
    return Artifact(npz={"keypoints.npz": arrays}, json={"report.json": {"length": config.length_m}})


def _rng_state(rng: np.random.Generator) -> np.ndarray:
    s = rng.bit_generator.state["state"]
    return np.frombuffer(s["state"].to_bytes(16, "big") + s["inc"].to_bytes(16, "big"), np.uint8)


def _rng(state: np.ndarray) -> np.random.Generator:
    rng = np.random.default_rng()
    b = state.tobytes()
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": int.from_bytes(b[:16], "big"), "inc": int.from_bytes(b[16:], "big")},
        "has_uint32": 0,
        "uinteger": 0,
    }
    return rng


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    if config.mode == "crash":
        raise ZeroDivisionError("a bug")
    if config.mode == "print":
        print("printed by a library")
        ctypes.CDLL(None).puts(b"printed from C")
    total = sum(float(np.sum(a.npz["keypoints.npz"]["keypoints"])) for a in inputs.artifacts.values() if len(a.npz))
    arrays = {"keypoints": np.full((3, 2, 3), total * config.gain)}
    failure = "did not converge" if config.mode == "bad" else None
    return Artifact(npz={"keypoints.npz": arrays}, json={"report.json": {"wall_ms": time.time()}}, failure=failure)


def run_report(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    return Artifact(blobs={"side_by_side.mp4": " ".join(sorted(inputs.artifacts)).encode()})


def replacements() -> dict[str, pipeline.StageSpec]:
    """The table with these stages."""
    real = {n: s for n, s in pipeline.STAGES.items() if n != "import"}
    own = {"report": {"run": "run_report"}, "evidence": {"run": "run_evidence", "config": "EvidenceConfig"}}
    own |= {"decode": {"run": "run_decode", "config": "DecodeConfig"}}
    own |= {"trials": {"config": "TrialsConfig"}, "replay": {"config": "ReplayConfig"}}
    return {n: dataclasses.replace(s, module="fake_line", **own.get(n, {})) for n, s in real.items()}


def install() -> None:
    """Put these stages and robots in the place of the real ones."""
    pipeline.STAGES.update(replacements())
    pipeline.load_robot = load_robot
    pipeline._find_weights = lambda: None
    pipeline._find_prior = lambda skeleton: None


def load_robot(name: str) -> SimpleNamespace:
    if name not in ("go1", "a1") and not Path(name).is_file():
        raise UsageError(f"no robot named {name!r}", where="--robot", valid=("a1", "go1"))
    return SimpleNamespace(name=Path(name).stem, digest=f"digest of {name}")


if __name__ == "__main__":
    import fake_line
    from slomo.cli import main

    fake_line.install()
    main()
