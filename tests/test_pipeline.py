"""The table of stages, their keys, resumption, and two processes on one project."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import fake_line
from slomo import pipeline, settings
from slomo.cli import app
from slomo.cli.session import Session
from slomo.errors import MissingInput, UsageError
from slomo.pipeline import ALL, STAGES, Project

HERE = Path(__file__).parent
FAKE = [sys.executable, str(HERE / "fake_line.py")]


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with a clip, which is the current one, and the fake line in the place of the real one."""
    (tmp_path / "clip.txt").write_bytes(b"hello clip")
    monkeypatch.chdir(tmp_path)
    for name, spec in fake_line.replacements().items():
        monkeypatch.setitem(pipeline.STAGES, name, spec)
    monkeypatch.setattr(pipeline, "load_robot", fake_line.load_robot)
    monkeypatch.setattr(pipeline, "_find_weights", lambda: None)
    monkeypatch.setattr(pipeline, "_find_prior", lambda skeleton: None)
    return tmp_path


def slomo(*args, check):
    """Run a command in this process."""
    done = CliRunner().invoke(app, args)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.exit_code == check, done.stderr
    return done


def start(*args, gate=None):
    """Run a command of the fake line in a process of its own; its fit stops in the middle until `gate` exists."""
    env = os.environ | ({"FAKE_GATE": str(gate)} if gate else {})
    return subprocess.Popen([*FAKE, *args], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


def wait_for_gate(project: Path, process: subprocess.Popen) -> None:
    """Wait until the fit is half done: at its 10th iteration and 5th checkpoint."""
    for _ in range(3000):
        if list(project.glob(".slomo/partial/fit/*/checkpoints/000005.json")):
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.kill()
    pytest.fail("the fit did not reach its middle within a minute")


def test_the_table_names_what_there_is():
    for spec in STAGES.values():
        assert callable(spec.of_module(spec.run)), spec.name
        assert isinstance(spec.of_module(spec.version), int), spec.name
        settings.make(spec.of_module(spec.config), {}, where=spec.name)
        assert set(spec.upstream) <= STAGES.keys()
        assert {*spec.files, *spec.optional} <= settings.INPUTS.keys()


def test_every_option_of_reconstruct_is_a_parameter():
    stages = ("decode", "masks", "camera", "evidence", "fit", "reconstruct")
    parameters = {s: STAGES[s].of_module(STAGES[s].config) for s in stages}
    for stage, name in [
        ("decode", "start"),
        ("decode", "duration"),
        ("masks", "segmenter"),
        ("camera", "fov_deg"),
        ("evidence", "prior"),
        ("reconstruct", "length_m"),
        ("reconstruct", "skeleton"),
        ("reconstruct", "quality"),
    ]:
        assert hasattr(parameters[stage](), name), (stage, name)


def test_a_new_projects_file_is_read_back_as_the_defaults(tmp_path):
    Session(project_option=tmp_path, quiet=True).initialise()
    text = (tmp_path / settings.FILE).read_text()
    assert not any(settings.read(tmp_path, list(STAGES)).values())
    uncommented = "\n".join(line.removeprefix("# ") for line in text.splitlines()[2:])
    (tmp_path / settings.FILE).write_text(uncommented)
    tables = settings.read(tmp_path, list(STAGES))
    for name, spec in STAGES.items():
        config = spec.of_module(spec.config)
        assert settings.make(config, tables.get(name, {}), where=name) == config()
        lender = STAGES[spec.lender].of_module(STAGES[spec.lender].config)
        lent = {f.name for f in dataclasses.fields(lender)} if spec.shares == ALL else set()
        assert set(tables.get(name, {})) == {f.name for f in dataclasses.fields(config)} - lent
    assert set(tables["trials"]) == {"trials", "seed", "rows", "controllers"}
    assert not re.search(r"see `(?!slomo )", text)  # who reads the file does not read the source


def write_inputs(root, **inputs):
    (root / settings.FILE).write_text("[inputs]\n" + "".join(f'{k} = "{v}"\n' for k, v in inputs.items()))
    return Project(root)


def test_where_the_key_points_come_from(tmp_path):
    with pytest.raises(MissingInput, match="no motion yet; run `slomo reconstruct CLIP` or `slomo import KEYPOINTS`"):
        write_inputs(tmp_path).chain("retarget")
    assert write_inputs(tmp_path, clip="a.mp4").chain("retarget") == [
        "decode", "masks", "camera", "evidence", "fit", "reconstruct", "retarget",
    ]  # fmt: skip
    assert write_inputs(tmp_path, keypoints="a.json").chain("report") == [
        "import", "retarget", "optimize", "track", "report",
    ]  # fmt: skip
    with pytest.raises(UsageError, match=r"both a clip and imported key points.*--from reconstruct"):
        write_inputs(tmp_path, clip="a.mp4", keypoints="a.json").chain("retarget")
    chosen = write_inputs(tmp_path, clip="a.mp4", keypoints="a.json", motion="import")
    assert chosen.upstream("retarget") == ("import",)
    with pytest.raises(UsageError, match="valid: reconstruct, import"):
        write_inputs(tmp_path, motion="clip").chain("retarget")


@pytest.mark.parametrize(
    ("segmenter", "roles"),
    [("auto", {"masks"}), ("user", {"masks"}), ("u2netp", {"weights"}), ("motion", set())],
)
def test_only_what_the_segmenter_reads_is_in_the_key(tmp_path, segmenter, roles):
    text = f'[inputs]\nclip="c"\nmasks = "m"\nweights = "w"\n[masks]\nsegmenter = "{segmenter}"\n'
    (tmp_path / settings.FILE).write_text(text)
    assert Project(tmp_path).files("masks").keys() == roles


def test_weights_at_hand_are_an_input(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "_find_weights", lambda: tmp_path / "u2netp.onnx")
    assert write_inputs(tmp_path, clip="c").files("masks") == {"weights": tmp_path / "u2netp.onnx"}


def test_the_prior_of_the_skeleton_s_kind_is_an_input(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pipeline, "_find_prior", lambda skeleton: asked.append(str(skeleton)) or tmp_path / "own.onnx")
    project = write_inputs(tmp_path, clip="c", keypoints2d="p.json")
    assert project.files("evidence") == {"prior": tmp_path / "own.onnx", "keypoints2d": tmp_path / "p.json"}
    text = (tmp_path / settings.FILE).read_text()
    (tmp_path / settings.FILE).write_text(text + '[reconstruct]\nskeleton = "human"\nfps = 12.0\n')
    project = Project(tmp_path)
    assert project.files("evidence")["prior"] == tmp_path / "own.onnx"
    assert asked == ["auto", "human"]
    assert (project.config("evidence").skeleton, project.config("evidence").fps) == ("human", 12.0)
    (tmp_path / settings.FILE).write_text(text + 'prior = "mine.onnx"\n[evidence]\nfps = 5.0\n')
    assert Project(tmp_path).files("evidence")["prior"] == tmp_path / "mine.onnx"
    assert Project(tmp_path).config("evidence").fps == 5.0
    (tmp_path / settings.FILE).write_text(text + 'prior = "mine.onnx"\n[evidence]\nprior = "none"\n')
    assert Project(tmp_path).files("evidence").keys() == {"keypoints2d"}


def test_everything_is_cached_the_second_time(project):
    first = slomo("run", "clip.txt", "--robot", "go1", check=0)
    entry = Path(first.stdout.strip())
    stages = b"camera decode evidence masks optimize reconstruct retarget track"
    assert (entry / "side_by_side.mp4").read_bytes() == stages
    again = slomo("run", "--robot", "go1", check=0)
    assert again.stdout == first.stdout
    assert again.stderr.count(": cached") == 10
    assert "done in" not in again.stderr


def test_equal_results_upstream_do_not_rerun_what_follows(project):
    slomo("run", "clip.txt", "--robot", "go1", check=0)
    done = slomo("run", "--robot", "go1", "--set", "retarget.names=['c']", check=0)
    assert "retarget: done" in done.stderr
    assert "optimize: cached" in done.stderr
    fresh = slomo("retarget", "--robot", "go1", "--fresh", check=0)
    assert "retarget: done" in fresh.stderr
    assert "track: cached" in slomo("run", "--robot", "go1", check=0).stderr


def test_kill_in_the_middle_then_the_same_command_gives_the_same_bits(project, tmp_path_factory):
    whole = tmp_path_factory.mktemp("whole")
    undisturbed = slomo("reconstruct", "clip.txt", "--project", str(whole), check=0)
    run = start("reconstruct", "clip.txt", gate=project / "gate")
    wait_for_gate(project, run)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    status = slomo("status", "--why", check=0).stdout
    assert "fit                interrupted at" in status
    assert "goes on from there" in status
    resumed = slomo("reconstruct", "clip.txt", check=0)
    assert "fit: goes on from 50 %" in resumed.stderr
    a, b = (Path(r.stdout.strip()) for r in (undisturbed, resumed))
    assert a.name == b.name
    assert a != b
    assert (a / "keypoints.npz").read_bytes() == (b / "keypoints.npz").read_bytes()
    (fitted,) = (project / ".slomo" / "store" / "fit").iterdir()
    assert json.loads((fitted / "manifest.json").read_text())["resumed_at"] == 0.5
    assert not list(project.glob(".slomo/partial/*/*"))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_the_next_call_goes_on(project, number, code, monkeypatch):
    run = start("reconstruct", "clip.txt", gate=project / "gate")
    wait_for_gate(project, run)
    run.send_signal(number)
    time.sleep(0.1)
    (project / "gate").touch()  # on to the next checkpoint
    out, err = run.communicate()
    assert run.returncode == code, err
    assert out == ""
    assert err.splitlines()[-1] == "slomo: interrupted; run the same command again to go on"
    assert "Traceback" not in err
    assert "goes on from 5" in slomo("reconstruct", check=0).stderr


def test_fresh_discards_checkpoints(project):
    run = start("reconstruct", "clip.txt", gate=project / "gate")
    wait_for_gate(project, run)
    run.kill()
    run.communicate()
    assert "goes on from" not in slomo("reconstruct", "--fresh", check=0).stderr


def test_two_processes_one_works_the_other_waits_and_reuses(project):
    first = start("reconstruct", "clip.txt", gate=project / "gate")
    wait_for_gate(project, first)
    status = slomo("status", "--why", check=0).stdout
    assert f"fit                running\n    pid {first.pid}, `fake_line.py reconstruct clip.txt`" in status
    refused = slomo("reconstruct", "--no-wait", check=75)
    assert f"fit is being made by pid {first.pid}, `fake_line.py reconstruct clip.txt`" in refused.stderr
    second = start("reconstruct")
    told = ""
    while "waiting for" not in told:
        told = second.stderr.readline()
        assert told, "the second process did not wait"
    assert told.startswith(f"waiting for fit: pid {first.pid}")
    (project / "gate").touch()
    out, err = first.communicate()
    out_second, err_second = second.communicate()
    assert (first.returncode, second.returncode) == (0, 0)
    assert "fit: done in" in err
    assert "fit: cached" in err_second
    assert out == out_second


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_twice_does_nothing_the_second_time(project):
    page = (HERE.parent / "docs" / "project.md").read_text()
    fragment = page.split("```make\n")[1].split("```")[0]
    shutil.copy("clip.txt", "clip.mp4")
    (project / "Makefile").write_text(fragment)
    make = ["make", f"SLOMO={' '.join(FAKE)}"]
    env = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}

    def run():
        done = subprocess.run(make, capture_output=True, text=True, env=env, timeout=60)
        assert done.returncode == 0, done.stderr
        return done

    assert "track: done" in run().stderr
    assert run().stderr == ""
    os.utime("clip.mp4")  # touched, the same content: everything is a cache hit, and Make settles
    settled = run().stderr
    assert "done in" not in settled
    assert "cached" in settled
    assert run().stderr == ""


def test_a_damaged_artifact_is_made_again(project):
    slomo("reconstruct", "clip.txt", check=0)
    (frames,) = project.glob(".slomo/store/decode/*/frames.npz")
    content = frames.read_bytes()
    frames.write_bytes(content[:-40] + bytes(40))
    done = slomo("reconstruct", check=0)
    assert "decode: the stored artifact is damaged (frames.npz); making it again" in done.stderr
    assert frames.read_bytes() == content
    (keypoints,) = project.glob(".slomo/store/reconstruct/*/keypoints.npz")
    keypoints.write_bytes(b"PK" + bytes(keypoints.stat().st_size - 2))
    refused = slomo("retarget", "--robot", "go1", check=3)
    assert "damaged (keypoints.npz); run `slomo reconstruct`" in refused.stderr
    slomo("reconstruct", check=0)
    slomo("retarget", "--robot", "go1", check=0)


def test_a_manifest_says_how_it_was_made(project):
    slomo("reconstruct", "clip.txt", check=0)
    (path,) = project.glob(".slomo/store/masks/*/manifest.json")
    m = json.loads(path.read_text())
    assert m["notes"] == ["masks by motion"]
    settings = {"segmenter": "motion", "subject_at": [], "subject_box": [], "quality": "normal"}
    assert m["identity"]["config"] == settings
    assert m["packages"]["numpy"] == np.__version__
    assert {"seconds", "started", "command", "git", "device", "python", "content"} <= m.keys()
    assert json.loads((project / "out" / "masks.json").read_text())["directory"] == m["directory"]
