"""What a user can get wrong, through the real command line: one line that says what and where, and its exit code."""

import json
import re
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from slomo.cli import app
from slomo.robot import list_robots
from walking import walk

ROOT = Path(__file__).parents[1]
CLIP = Path(str(files("slomo"))) / "assets" / "walk" / "clip.mp4"
WEIGHTS = ROOT.parent / "shared" / "weights" / "u2netp.onnx"
# What may stand beside the error: progress, notes, and what was written into slomo.toml.
BESIDE = re.compile(r"(new project|slomo\.toml|decode|masks|camera|reconstruct|import|retarget|optimize|time): ")


@pytest.fixture
def slomo(capfd, monkeypatch) -> Callable[..., str]:
    """Run a command as a user would, with all that is written, by libraries too; returns its line of error.

    In this process, for each new one would load torch again.
    """
    monkeypatch.delenv("SLOMO_U2NETP", raising=False)

    def run(project: Path, *args: object, code: int) -> str:
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            app([*map(str, args), "--project", str(project)], prog_name="slomo")
        out, err = capfd.readouterr()
        assert end.value.code == code, f"{args} -> {end.value.code}\n{err}"
        assert "Traceback" not in err
        if code == 0:
            return err
        assert out == ""
        lines = err.splitlines()
        errors = [line for line in lines if not BESIDE.match(line)]
        assert errors == lines[-1:], err
        assert errors[0].startswith("slomo: ")
        assert not list(project.glob(".slomo/partial/*/*"))  # or a folder of it would be read as an interrupted run
        return errors[0]

    return run


def write_clip(path: Path, frames: np.ndarray) -> Path:
    """(T, H, W, 3) uint8 RGB as H.264."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def empty_scene(path: Path, *, pan: float, frames: int = 30) -> Path:
    """A textured wall and nothing before it, from a camera that turns by `pan` px a frame."""
    rng = np.random.default_rng(0)
    wall = sum(
        cv2.resize(rng.uniform(0, 255, (6 * 2**k, 12 * 2**k, 3)).astype(np.float32), (640, 240)) / 2**k
        for k in range(5)
    )
    wall = np.uint8(cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX))  # type: ignore[call-overload]
    views = [
        cv2.warpAffine(wall, np.float32([[1, 0, -pan * t], [0, 1, 0]]), (320, 240))  # type: ignore[arg-type]
        for t in range(frames)
    ]
    return write_clip(path, np.stack(views))


def test_a_file_that_is_no_clip(slomo, tmp_path):
    (tmp_path / "empty.mp4").touch()
    assert "empty.mp4: the file is empty" in slomo(tmp_path / "a", "reconstruct", tmp_path / "empty.mp4", code=4)
    (tmp_path / "text.mp4").write_text("this is no video\n" * 50)
    said = slomo(tmp_path / "b", "reconstruct", tmp_path / "text.mp4", code=4)
    assert "text.mp4: not a readable video" in said
    assert not list(tmp_path.glob("*/out/*"))


def test_a_truncated_clip(slomo, tmp_path):
    """The index comes first in the embedded clip, so what is there can be read; a part too short is refused."""
    data = CLIP.read_bytes()
    (tmp_path / "half.mp4").write_bytes(data[: len(data) // 2])
    # An unknown segmenter ends it right after decoding: only the frames are of interest here.
    said = slomo(tmp_path / "a", "reconstruct", tmp_path / "half.mp4", "--segmenter", "nonsense", code=2)
    assert "unknown segmenter 'nonsense' (valid: auto, u2netp, still, motion, user)" in said
    (video,) = (tmp_path / "a").glob(".slomo/store/decode/*/video.json")
    info = json.loads(video.read_text())
    assert info["frames_total"] >= 8
    assert info["frames_lost"] > 10
    (tmp_path / "start.mp4").write_bytes(data[:12_000])
    said = slomo(tmp_path / "b", "reconstruct", tmp_path / "start.mp4", code=4)
    assert "start.mp4: " in said


@pytest.mark.parametrize("pan", [0.0, 3.0])
def test_a_clip_without_a_subject(slomo, tmp_path, pan):
    clip = empty_scene(tmp_path / "wall.mp4", pan=pan)
    said = slomo(tmp_path, "reconstruct", clip, "--segmenter", "motion", code=4)
    assert "masks: no subject found: " in said
    assert "--masks DIR" in said
    if not WEIGHTS.is_file():
        pytest.skip("needs ../shared/weights/u2netp.onnx")
    said = slomo(tmp_path, "reconstruct", "--segmenter", "u2netp", "--weights", WEIGHTS, code=4)
    assert "masks: no subject found: " in said


def test_weights_that_are_not_there(slomo, tmp_path, monkeypatch):
    monkeypatch.setenv("SLOMO_U2NETP", str(tmp_path / "none.onnx"))
    said = slomo(tmp_path, "reconstruct", CLIP, code=4)
    assert "none.onnx: no such file" in said


def test_key_points_that_are_not_finite(slomo, tmp_path):
    frames = [[0.1 * k for k in range(18)] for _ in range(20)]
    frames[7][3] = float("nan")
    (tmp_path / "nan.json").write_text(json.dumps({"FrameDuration": 0.03, "Frames": frames}))
    said = slomo(tmp_path, "import", tmp_path / "nan.json", code=4)
    assert "nan.json: not a finite number in frame 7, column 3" in said
    said = slomo(tmp_path, "run", tmp_path / "nan.json", "--robot", "go1", code=4)
    assert "nan.json: not a finite number in frame 7, column 3" in said
    arrays = walk(seconds=1.0).to_arrays()
    arrays["keypoints"][5, 2, 1] = np.nan
    np.savez(tmp_path / "nan.npz", allow_pickle=False, **arrays)
    assert "nan.npz: " in slomo(tmp_path, "import", tmp_path / "nan.npz", code=4)
    np.savez(tmp_path / "other.npz", allow_pickle=False, t=arrays["t"], points=arrays["keypoints"])
    said = slomo(tmp_path, "import", tmp_path / "other.npz", code=4)
    assert "has no array 'keypoints' (it has: t, points; needed: t, keypoints, keypoint_names)" in said


def test_robots_that_are_not_right(slomo, tmp_path):
    np.savez(tmp_path / "walk.npz", allow_pickle=False, **walk(seconds=1.0).to_arrays())
    said = slomo(tmp_path, "run", tmp_path / "walk.npz", "--robot", "spot", code=2)
    assert "no robot named 'spot'" in said
    assert ", ".join(list_robots()) in said
    text = (ROOT / "robots" / "go1" / "robot.toml").read_text()
    (tmp_path / "robot.toml").write_text(text.replace('"FL_foot"', '"FL_paw"'))
    said = slomo(tmp_path, "run", tmp_path / "walk.npz", "--robot", tmp_path / "robot.toml", code=4)
    assert "'FL_paw'" in said
    assert "FR_foot" in said
    assert not (tmp_path / "out" / "retarget-go1.json").exists()


def test_a_person_on_four_legs(slomo, tmp_path):
    t = np.arange(40) / 30
    names = ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
    at = np.array([[0, 0, 1.0], [0, 0.4, 0.9], [0, -0.4, 0.9], [0, 0.1, 0], [0, -0.1, 0]])
    np.savez(
        tmp_path / "person.npz", allow_pickle=False, t=t, keypoints=np.tile(at, (40, 1, 1)),
        keypoint_names=np.array(names), confidence=np.ones((40, 5)),
    )  # fmt: skip
    slomo(tmp_path, "import", tmp_path / "person.npz", code=0)
    said = slomo(tmp_path, "retarget", "--robot", "go1", code=4)
    assert "go1" in said


def test_names_that_do_not_exist(slomo, tmp_path):
    (tmp_path / "slomo.toml").write_text("[camera]\nfov = 60\n")
    said = slomo(tmp_path, "reconstruct", CLIP, code=2)
    assert "[camera]: no parameter 'fov' (valid: fov_deg, " in said
    said = slomo(tmp_path / "b", "reconstruct", CLIP, "--skeleton", "spider", code=2)
    assert "no skeleton 'spider' (valid: auto, quadruped, human)" in said


def test_a_project_below_a_file(slomo, tmp_path):
    (tmp_path / "file").touch()
    said = slomo(tmp_path / "file" / "project", "reconstruct", CLIP, code=1)
    assert "cannot write (Not a directory); give another project folder with --project" in said
