"""The commands: results, messages and exit codes."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

import fake_line
import slomo
from slomo import pipeline, settings
from slomo.cli import _common_last, app

COMMANDS = get_command(app).commands
HEAVY = ("torch", "warp", "casadi", "pinocchio", "cv2", "mujoco", "numba", "scipy", "matplotlib", "av", "onnxruntime")


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


def run(*args, code=0):
    """Run a command in this process; one line of error at most."""
    done = CliRunner().invoke(app, [str(a) for a in args])
    assert done.exit_code == code, (args, done.stdout, done.stderr, done.exception)
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("slomo: ")]
    assert len(errors) == (code != 0) or "\nError: " in f"\n{done.stderr}"
    return done


def keypoint_file(folder: Path) -> Path:
    arrays = dict(t=np.arange(4.0), keypoints=np.zeros((4, 2, 3)), keypoint_names=np.array(["a", "b"]))
    np.savez(folder / "points.npz", **arrays)
    return folder / "points.npz"


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_help_with_an_example(name):
    args = ["weights", "fetch"] if name == "weights" else [name]
    text = run(*args, "--help").stdout
    assert f"\n  slomo {' '.join(args)}" in text
    assert "--project" in text


def test_version():
    assert run("--version").stdout == f"slomo {slomo.__version__}\n"


def test_help_starts_fast():
    code = f"import sys; from slomo.cli import app; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_usage_errors_end_with_2(project):
    for args in (["nonsense"], ["run", "clip.txt"], ["status", "--nonsense"], ["retarget", "--robot"]):
        run(*args, code=2)
    assert "what is to be done? (valid: --sim, " in run("track", "--robot", "go1", code=2).stderr
    said = run("run", "clip.txt", "--robot", "spot", code=2).stderr
    assert said.endswith("slomo: --robot: no robot named 'spot' (valid: a1, go1)\n")


def test_common_options_may_come_first():
    assert _common_last(["--project", "d", "-q", "--set", "a.b=1", "run", "--json"]) == [
        "run", "--json", "--project", "d", "-q", "--set", "a.b=1",
    ]  # fmt: skip
    assert _common_last(["--project=d", "status"]) == ["status", "--project=d"]
    assert _common_last(["--help"]) == ["--help"]


def test_every_command_of_the_line(project):
    def path(done):
        assert done.stdout.count("\n") == 1
        return Path(done.stdout.strip())

    assert path(run("init")) == project / "slomo.toml"
    assert "already a project" in run("init").stderr
    assert path(run("reconstruct", "clip.txt")).parent.name == "reconstruct"
    assert path(run("retarget", "--robot", "go1")).parent.name == "retarget"
    assert path(run("optimize", "--robot", "go1")).parent.name == "optimize"
    assert path(run("track", "--sim", "--robot", "go1", "--no-video")).parent.name == "track"
    assert not (project / "out" / "report-go1.json").exists()
    assert "side_by_side.mp4" in run("track", "--sim", "--robot", "go1").stderr
    assert path(run("report", "--robot", "go1")).parent.name == "report"
    assert path(run("run", "--robot", "a1", "--duration", "0")).parent.name == "report"
    assert {p.name for p in (project / "out").iterdir()} == {
        *(f"{s}.json" for s in ("decode", "masks", "camera", "evidence", "fit", "reconstruct")),
        *(f"{s}-{r}.json" for s in ("retarget", "optimize", "track", "report") for r in ("go1", "a1")),
    }


def test_json_is_the_manifest(project):
    done = run("reconstruct", "clip.txt", "--json")
    m = json.loads(done.stdout)
    assert m == json.loads((project / m["directory"] / "manifest.json").read_text())
    listed = json.loads(run("status", "--json").stdout)["stages"]
    assert [s["status"] for s in listed] == ["current"] * 6
    assert listed[4]["manifest"]["seconds"] >= 0
    assert json.loads(run("init", "--json").stdout)["new"] is False
    assert json.loads(run("gc", "--json").stdout) == {"dry_run": False, "bytes": 0, "removed": []}
    assert "go1" in json.loads(run("robots", "--json").stdout)


def test_quiet_is_quiet(project):
    assert run("run", "clip.txt", "--robot", "go1", "-q").stderr == ""


def test_stdout_belongs_to_the_result(project):
    program = [sys.executable, fake_line.__file__, "run", "clip.txt", "--robot", "go1", "--set", "optimize.mode=print"]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    assert Path(done.stdout.removesuffix("\n")).is_dir()
    assert "printed by a library" in done.stderr
    assert "printed from C" in done.stderr


def test_a_project_is_found_from_below(project, monkeypatch):
    run("init")
    (project / "a" / "b").mkdir(parents=True)
    monkeypatch.chdir(project / "a" / "b")
    run("reconstruct", "../../clip.txt")
    assert settings.read(project, list(pipeline.STAGES))["inputs"]["clip"] == "clip.txt"
    elsewhere = run("reconstruct", "../../clip.txt", "--project", "new")
    assert elsewhere.stdout.startswith(str(project / "a" / "b" / "new"))


def test_options_are_written_into_the_users_file(project):
    own = "# mine\n[decode]\nstart = 1.0  # not the first\n# duration = 0.0  # s\n\n[reconstruct]\nseed = 3\n"
    (project / "slomo.toml").write_text(own)
    said = run("reconstruct", "clip.txt", "--duration", "2", "--start", "0.5", "--skeleton", "human").stderr
    assert "slomo.toml: decode.start = 0.5 (was 1.0)" in said
    text = (project / "slomo.toml").read_text()
    assert text.startswith("# mine\n[decode]\nstart = 0.5  # not the first\nduration = 2.0  # s\n")
    assert settings.read(project, list(pipeline.STAGES)) == {
        "decode": {"start": 0.5, "duration": 2.0},
        "reconstruct": {"seed": 3, "skeleton": "human"},
        "inputs": {"clip": "clip.txt"},
    }
    assert "slomo.toml" not in run("reconstruct", "--duration", "2").stderr
    run("reconstruct", "--slow-motion", "8")
    assert settings.read(project, list(pipeline.STAGES))["decode"]["slow_motion"] == 8.0
    run("reconstruct", "--set", "decode.slow_motion=")
    (project / "bones.toml").write_text("")
    run("reconstruct", "--skeleton", "bones.toml", "--set", "decode.duration=")
    tables = settings.read(project, list(pipeline.STAGES))
    assert tables["inputs"]["skeleton"] == "bones.toml"
    assert tables["decode"] == {"start": 0.5}
    run("reconstruct", "--skeleton", "quadruped")
    assert "skeleton" not in settings.read(project, list(pipeline.STAGES))["inputs"]


def test_whom_the_user_means(project):
    def masks():
        return settings.read(project, list(pipeline.STAGES)).get("masks", {})

    run("reconstruct", "clip.txt", "--subject-at", "320,180.5,1")
    assert masks() == {"subject_at": [320.0, 180.5, 1.0]}
    run("reconstruct", "--subject-box", "10,20,300,200")
    assert masks() == {"subject_box": [10.0, 20.0, 300.0, 200.0]}
    run("reconstruct", "--subject-box", "none")
    assert masks() == {}
    assert "no list of numbers" in run("reconstruct", "--subject-at", "here", code=2).stderr
    assert "give one of them" in run("reconstruct", "--subject-at", "1,2", "--subject-box", "1,2,3,4", code=2).stderr


def test_quality_is_that_of_masks_and_camera_too(project):
    def said():
        made = pipeline.Project(project)
        return [made.config(stage).quality for stage in ("masks", "camera", "fit", "reconstruct")]

    run("reconstruct", "clip.txt", "--quality", "draft")
    assert said() == ["draft"] * 4
    run("reconstruct", "--quality", "high", "--set", "masks.quality=normal")
    assert said() == ["normal", "high", "high", "high"]


def test_masks_given_are_used(project):
    (project / "masks").mkdir()
    run("reconstruct", "clip.txt", "--segmenter", "motion")
    run("reconstruct", "--masks", "masks")
    tables = settings.read(project, list(pipeline.STAGES))
    assert tables["inputs"]["masks"] == "masks"
    assert "segmenter" not in tables["masks"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[decode]\nstrat = 1.0",
            "[decode]: no parameter 'strat' (valid: start, duration, slow_motion); did you mean 'start'?",
        ),
        (
            "[decoed]\nstart = 1.0",
            "no section 'decoed' (valid: inputs, decode, masks, camera, evidence, fit, reconstruct",
        ),
        ("[decode]\nstart = 'soon'", "[decode]: start = 'soon': expected a valid number"),
        ("[reconstruct]\niterations = 2.5", "iterations = 2.5: expected a valid integer"),
        ("[decode]\nstart = nan", "start = nan: expected a finite number"),
        ("[reconstruct]\niterations = 0", "iterations = 0: expected at least 1"),
        ("[retarget]\nnames = 'a'", "names = 'a': expected a valid tuple"),
        ("[inputs]\nclip = 3", "[inputs]: clip must be a string, not 3"),
        ("[inputs]\nclp = 'a'", "no input 'clp' (valid: clip"),
        ("decode = 3", "decode stands outside any section"),
        ("[decode", "slomo.toml: is not TOML: "),
        ("[decode", "; correct it there, or move the file away: `slomo init` writes a new one"),
    ],
)
def test_a_wrong_slomo_toml(project, text, message):
    (project / "slomo.toml").write_text(text)
    said = run("run", "clip.txt", "--robot", "go1", code=2).stderr
    assert message in said
    assert (project / "slomo.toml").read_text().startswith(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (".5", 0.5), ("-.5e-1", -0.05), ("2.", 2.0), ("2", 2), ("[1, 2]", [1, 2]), ("true", True), ("'.5'", ".5"),
        ("walk.mp4", "walk.mp4"), (".hidden", ".hidden"), ("", None),
    ],
)  # fmt: skip
def test_values_of_set(text, value):
    section, name, found = settings.parse_set(f"decode.start={text}")
    assert (section, name, found, type(found)) == ("decode", "start", value, type(value))


def test_wrong_set_options_leave_the_file_alone(project):
    run("reconstruct", "clip.txt")
    before = (project / "slomo.toml").read_text()
    for option, message in [
        ("decode.start=soon", "start = 'soon': expected a valid number"),
        ("start=1", "--set: 'start=1' is not section.name=value; for example camera.fov_deg=60"),
        ("decode.strat=1", "no parameter 'strat'"),
        ("nonsense.x=1", "no section 'nonsense'"),
    ]:
        assert message in run("reconstruct", "--set", option, code=2).stderr
    assert (project / "slomo.toml").read_text() == before


def test_who_is_asked_what_the_clip_shows(project):
    def given():
        tables = settings.read(project, list(pipeline.STAGES))
        return tables.get("evidence", {}), {k: v for k, v in tables["inputs"].items() if k != "clip"}

    for name in ("points.json", "own.onnx", "model.onnx", "map.toml"):
        (project / name).write_text("")
    done = run("reconstruct", "clip.txt", "--prior", "none", "--keypoints2d", "points.json")
    assert given() == ({"prior": "none"}, {"keypoints2d": "points.json"})
    artifact = json.loads((project / "out" / "evidence.json").read_text())
    files = json.loads((project / artifact["directory"] / "report.json").read_text())["files"]
    assert files == ["keypoints2d"]
    assert "reconstruct: done" in done.stderr
    assert "evidence: cached" in run("reconstruct", "--length", "0.7").stderr
    run("run", "--robot", "go1", "--prior", "own.onnx", "--keypoints2d", "none")
    assert given() == ({}, {"prior": "own.onnx"})
    run("reconstruct", "--prior", "auto", "--keypoint-model", "model.onnx", "--keypoint-map", "map.toml")
    assert given() == ({}, {"keypoint_model": "model.onnx", "keypoint_map": "map.toml"})
    run("reconstruct", "--keypoint-model", "none")
    assert given() == ({}, {})
    assert "needs --keypoint-map too" in run("reconstruct", "--keypoint-model", "model.onnx", code=2).stderr
    assert "needs --keypoint-model too" in run("reconstruct", "--keypoint-map", "map.toml", code=2).stderr
    assert "nothing.onnx: no such file or folder; give" in run("reconstruct", "--prior", "nothing.onnx", code=4).stderr
    assert "nothing.json: no such file" in run("run", "--robot", "go1", "--keypoints2d", "nothing.json", code=4).stderr


def test_a_file_that_cannot_be_edited_by_line(project):
    (project / "slomo.toml").write_text("decode = {start = 1.0}\n")
    said = run("reconstruct", "clip.txt", "--start", "2", code=2).stderr
    assert "cannot be edited by line; write there yourself:" in said


def test_missing_and_stale_inputs_end_with_3_and_the_command(project):
    assert "no motion yet; run `slomo reconstruct CLIP` or" in run("retarget", "--robot", "go1", code=3).stderr
    assert "no clip given; run `slomo reconstruct CLIP`" in run("reconstruct", code=3).stderr
    run("reconstruct", "clip.txt")
    said = run("optimize", "--robot", "go1", code=3).stderr
    assert "optimize: retarget-go1 is missing (never made); run `slomo retarget --robot go1` first" in said
    run("retarget", "--robot", "go1")
    run("optimize", "--robot", "go1")
    (project / "clip.txt").write_text("another")
    said = run("track", "--sim", "--robot", "go1", code=3).stderr
    assert "optimize-go1 is stale because decode is stale (the file for clip changed); run `slomo reconstruct`" in said
    (project / "clip.txt").unlink()
    assert "no such file" in run("reconstruct", code=4).stderr


def test_invalid_data_ends_with_4_and_leaves_nothing(project):
    (project / "empty.mp4").write_bytes(b"")
    said = run("reconstruct", "empty.mp4", code=4).stderr
    assert said.splitlines()[-1] == f"slomo: {project / 'empty.mp4'}: the file is empty"
    assert "nothing.mp4: no such file or folder" in run("reconstruct", "nothing.mp4", code=4).stderr
    assert not list(project.glob(".slomo/*/decode/*"))
    (project / "bad.npz").write_bytes(b"PK")
    assert "bad.npz" in run("import", "bad.npz", code=4).stderr


def test_a_failed_stage_is_kept_and_refused(project):
    failed = run("run", "clip.txt", "--robot", "go1", "--set", "optimize.mode=bad", code=1)
    assert "slomo: optimize: did not converge; its best result is in" in failed.stderr
    assert json.loads((Path(failed.stdout.strip()) / "manifest.json").read_text())["failure"] == "did not converge"
    assert not (project / "out" / "optimize-go1.json").exists()
    assert "failed before, the same again" in run("optimize", "--robot", "go1", code=1).stderr
    assert "optimize: failed after" in run("optimize", "--robot", "go1", "--fresh", code=1).stderr
    said = run("track", "--sim", "--robot", "go1", code=3).stderr
    assert "track: optimize-go1 has failed (did not converge); run `slomo optimize --robot go1` first" in said
    assert "optimize-go1       failed\n    did not converge\n" in run("status", "--robot", "go1", "--why").stdout
    run("run", "--robot", "go1", "--set", "optimize.mode=good")


@pytest.mark.parametrize("command", [["run", "clip.txt"], ["track", "--sim"]])
def test_a_fall_is_shown(project, command):
    if command[0] == "track":
        run("run", "clip.txt", "--robot", "go1")
    done = run(*command, "--robot", "go1", "--set", "track.mode=bad", code=1)
    assert Path(done.stdout.strip()).parent.name == "track"
    assert (project / "out" / "report-go1.json").exists()
    assert "slomo: track: did not converge" in done.stderr
    assert Path(run("report", "--robot", "go1").stdout.strip()).parent.name == "report"


def test_key_points_instead_of_a_clip(project):
    points = keypoint_file(project)
    assert Path(run("import", points).stdout.strip()).parent.name == "import"
    run("retarget", "--robot", "go1")
    assert Path(run("run", points, "--robot", "go1").stdout.strip()).parent.name == "report"
    run("reconstruct", "clip.txt")
    said = run("retarget", "--robot", "go1", code=2).stderr
    assert "both a clip and imported key points; choose: `slomo retarget --robot go1 --from reconstruct` or" in said
    run("retarget", "--robot", "go1", "--from", "reconstruct")
    assert "retarget: cached" in run("retarget", "--robot", "go1", "--from", points).stderr
    assert settings.read(project, list(pipeline.STAGES))["inputs"]["motion"] == "import"
    run("run", "clip.txt", "--robot", "go1")
    assert settings.read(project, list(pipeline.STAGES))["inputs"]["motion"] == "reconstruct"


def test_status_says_why(project):
    def why(*args):
        return run("status", "--why", *args).stdout

    assert why().startswith(f"nothing yet in {project}; run `slomo reconstruct CLIP`")
    run("run", "clip.txt", "--robot", "go1")
    assert set(why().split()) >= {"decode", "report-go1", "current"}
    assert "stale" not in why()
    (project / "slomo.toml").write_text(
        (project / "slomo.toml").read_text().replace("# length_m = 0.5", "length_m = 0.75")
    )
    assert "fit                stale\n    [fit] length_m changed: 0.5 -> 0.75\n    run `slomo reconstruct`" in why()
    assert "retarget-go1       stale\n    reconstruct is stale\n    run `slomo retarget --robot go1`" in why()
    run("run", "--robot", "go1", "--set", "reconstruct.length_m=0.5")
    (project / "clip.txt").write_text("b")
    assert "decode             stale\n    the file for clip changed\n" in why()
    (project / "clip.txt").unlink()
    assert "clip.txt: no such file or folder" in why()
    assert "retarget-a1        missing\n" in why("--robot", "a1")
    assert "no robot named 'spot'" in run("status", "--robot", "spot", code=2).stderr


def test_gc_keeps_what_is_used(project):
    run("run", "clip.txt", "--robot", "go1")
    (project / "clip.txt").write_text("another clip, of another length")
    run("run", "--robot", "go1")
    would = run("gc", "--dry-run")
    assert "would free" in would.stderr
    assert {line.split("/")[2] for line in would.stdout.splitlines()} == {
        "decode", "masks", "camera", "evidence", "fit", "reconstruct", "report",
    }  # fmt: skip
    assert run("gc").stdout == would.stdout
    assert run("gc").stdout == "\n"
    assert "done in" not in run("run", "--robot", "go1").stderr


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_refuses(project, monkeypatch, number):
    run("init")

    def refuse(path, write):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr("slomo.store.artifacts.write_file", refuse)
    said = run("import", keypoint_file(project), code=1).stderr.splitlines()[-1]
    assert os.strerror(number) in said
    assert not list(project.glob("out/*"))


def test_a_project_folder_that_cannot_be(project):
    said = run("reconstruct", "clip.txt", "--project", "clip.txt/inside", code=1).stderr
    assert "cannot write (Not a directory); give another project folder with --project" in said


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only folders")
def test_a_read_only_project(project):
    (project / "p").mkdir()
    (project / "p").chmod(0o500)
    assert "cannot write (Permission denied)" in run("reconstruct", "clip.txt", "--project", "p", code=1).stderr


def test_a_bug_is_one_line_and_a_file(project):
    run("run", "clip.txt", "--robot", "go1")
    said = run("optimize", "--robot", "go1", "--set", "optimize.mode=crash", code=1).stderr.splitlines()[-1]
    crash = project / ".slomo" / "crash.txt"
    assert said == f"slomo: internal error: ZeroDivisionError: a bug (traceback in {crash})"
    assert "ZeroDivisionError: a bug" in crash.read_text()


def test_interrupted_and_out_of_memory(project, monkeypatch):
    for error, code, message in [(KeyboardInterrupt(), 130, "interrupted"), (MemoryError(), 1, "out of memory")]:

        def fail(path, role, error=error):
            raise error

        monkeypatch.setattr(pipeline, "digest_input", fail)
        assert message in run("reconstruct", "clip.txt", code=code).stderr


def test_synth_takes_every_parameter_of_its_clip(project):
    from dataclasses import fields

    from slomo.synth.clip import Config

    options = {p.name for p in COMMANDS["synth"].params}
    assert {f.name for f in fields(Config)} <= options
    said = run("synth", "out", "--gait", "hop", code=2).stderr
    assert said.startswith("slomo: synth: no gait 'hop' (valid: walk")
    assert "slomo: dataset: no kind 'cat' (valid" in run("dataset", "out", "--kind", "cat", code=2).stderr
    assert not (project / "out").exists()


def test_synth_writes_a_clip(project):
    args = ["--seconds", "0.2", "--fps", "10", "--width", "64", "--height", "64", "--seed", "1"]
    assert run("synth", "out", *args).stdout == f"{project / 'out'}\n"
    assert {p.name for p in (project / "out").iterdir()} == {"clip.mp4", "truth.npz", "masks.npz"}


def test_robots():
    names = run("robots").stdout.split()
    assert {"go1", "a1", "go2"} <= set(names)
    assert all((Path(slomo.__file__).parents[2] / "robots" / n / "robot.toml").is_file() for n in names)
