"""The whole line through the command line, on what the project carries with it."""

import json
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from slomo.motion import KeypointMotion
from slomo.synth.score import score
from walking import walk

ASSET = Path(str(files("slomo"))) / "assets" / "walk"


def slomo(project: Path, *args: str, code: int = 0) -> dict:
    """Run a command in a process of its own; the JSON that it prints."""
    command = [sys.executable, "-c", "from slomo.cli import main; main()", *args, "--json", "--project", str(project)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == code, f"{args} -> {done.returncode}\n{done.stderr}"
    return json.loads(done.stdout)


def artifact(project: Path, stage: str) -> Path:
    (folder,) = (project / ".slomo" / "store" / stage).iterdir()
    return folder


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> Path:
    """Key points of a walk whose answer is known, up to the robot in simulation."""
    project = tmp_path_factory.mktemp("line")
    np.savez(project / "walk.npz", **walk(seconds=2.0).to_arrays())
    slomo(project, "import", str(project / "walk.npz"))
    for command in (["retarget"], ["optimize"], ["track", "--sim", "--no-video"]):
        slomo(project, *command, "--robot", "go1")
    return project


def test_reference_is_verified(walked):
    report = json.loads((artifact(walked, "optimize") / "report.json").read_text())
    assert report["verified"]
    assert report["dynamics_residual"] <= 1e-6
    assert report["complementarity"] <= 1e-4
    assert report["penetration"] < 1e-3
    assert report["slip_per_second"] < 0.02


def test_robot_walks_the_distance_without_falling(walked):
    metrics = json.loads((artifact(walked, "track") / "metrics.json").read_text())
    assert not metrics["fell"]
    assert metrics["body_rmse"] < 0.05
    rollout = np.load(artifact(walked, "track") / "rollout.npz")
    # The creature walks 0.6 m/s on legs of 0.5 m; the robot's are of another length, its strides in proportion.
    scale = json.loads((artifact(walked, "retarget") / "report.json").read_text())["scale"]
    assert rollout["body"][-1, 0] == pytest.approx(0.6 * 2.0 * scale, abs=0.1)


def test_second_call_does_nothing(walked):
    before = {p: p.stat().st_mtime_ns for p in walked.rglob("*.npz")}
    slomo(walked, "track", "--sim", "--no-video", "--robot", "go1")
    assert {p: p.stat().st_mtime_ns for p in walked.rglob("*.npz")} == before


def test_clip_becomes_key_points_in_metres(tmp_path):
    """A short part of the embedded clip, with far fewer iterations than the default: the files, not the accuracy."""
    slomo(
        tmp_path, "reconstruct", str(ASSET / "clip.mp4"), "--segmenter", "motion", "--duration", "1.2",
        "--set", "reconstruct.iterations=[20, 10, 10, 45, 15]", "--set", "reconstruct.gait_phases=4",
        "--set", "reconstruct.candidates=3",
    )  # fmt: skip
    z = np.load(artifact(tmp_path, "reconstruct") / "keypoints.npz")
    T = len(z["t"])
    assert pytest.approx(36, abs=1) == T
    assert z["T_world_cam"].shape == (T, 4, 4)
    assert z["K"].shape == (3, 3)
    motion = KeypointMotion.from_arrays(z)
    assert {"pelvis", "withers", "front_left_paw", "hind_right_paw"} <= set(motion.names)
    assert motion.contact_names == tuple(f"{e}_{s}_paw" for e in ("front", "hind") for s in ("left", "right"))
    paws = np.stack([motion[n] for n in motion.contact_names])
    assert -0.1 < np.median(paws[..., 2]) < 0.15  # on the ground, within the paws' size
    assert np.all(motion["withers"][:, 2] > paws[..., 2].max(axis=0))
    # Even so little work tells the way it faces and where its limbs are, within half a body.
    truth = dict(np.load(ASSET / "truth.npz"))
    assert score(motion, truth)["pa_mpjpe_percent"] < 35
    names = list(map(str, truth["keypoint_names"]))
    facing = truth["keypoints"][10, names.index("withers")] - truth["keypoints"][10, names.index("pelvis")]
    cam = truth["T_world_cam"][10, :3, :3].T @ facing
    mine = z["T_world_cam"][10, :3, :3].T @ (motion["withers"] - motion["pelvis"])[10]
    assert cam @ mine / np.linalg.norm(cam) / np.linalg.norm(mine) > 0.8


@pytest.mark.slow
def test_embedded_clip_meets_its_bars(tmp_path):
    """What `make demo` runs, against the clip's truth."""
    clip, truth = ASSET / "clip.mp4", ASSET / "truth.npz"
    slomo(tmp_path, "run", str(clip), "--truth", str(truth), "--robot", "go1", "--segmenter", "motion")
    motion = KeypointMotion.from_arrays(np.load(artifact(tmp_path, "reconstruct") / "keypoints.npz"))
    result = score(motion, dict(np.load(truth)))
    assert result["pa_mpjpe_percent"] <= 12
    assert result["root_path_error_percent"] <= 15
    assert not json.loads((artifact(tmp_path, "track") / "metrics.json").read_text())["fell"]
    assert (artifact(tmp_path, "report") / "side_by_side.mp4").stat().st_size > 50_000
