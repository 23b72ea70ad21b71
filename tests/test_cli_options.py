"""What options write into slomo.toml, what they refuse, and what their help says."""

import json
from dataclasses import fields

import pytest

import test_cli
from slomo import pipeline, settings
from test_cli import COMMANDS, keypoint_file, run

project = test_cli.project  # the fixture


def written(project, section):
    return settings.read(project, list(pipeline.STAGES)).get(section, {})


@pytest.fixture
def line(project):
    """A project with a reference."""
    run("import", keypoint_file(project))
    run("retarget", "--robot", "go1")
    run("optimize", "--robot", "go1")
    return project


def track(*args, code=0):
    return run("track", "--robot", "go1", *args, code=code)


WORLD = [
    ("--sim", None), ("--seconds", "3"), ("--payload", "0"), ("--push", "12@1,90"), ("--terrain", "none"),
    ("--friction", "0.5"), ("--state", "truth"), ("--latency", "0.01"),
]  # fmt: skip


@pytest.mark.parametrize(("option", "value"), WORLD)
@pytest.mark.parametrize("kind", [["--trials", "2"], ["--compare"], ["--replay", "mass/0"]])
def test_an_option_of_another_kind_of_call_is_refused(line, kind, option, value):
    given = [option] if value is None else [option, value]
    said = track(*kind, *given, code=2).stderr
    assert said.startswith(f"slomo: {option}: has no effect with {kind[0]}; ")
    if option in ("--state", "--friction"):
        assert f"--set track.{option[2:]}={value}" in said
    assert not written(line, "trials")
    assert not written(line, "replay")


@pytest.mark.parametrize(
    ("args", "option", "kind"),
    [
        (["--sim", "--rows", "mass"], "--rows", "--sim"),
        (["--sim", "--no-compare"], "--no-compare", "--sim"),
        (["--replay", "mass/0", "--trials", "0"], "--trials", "--replay"),
        (["--replay", "mass/0", "--rows", "mass"], "--rows", "--replay"),
        (["--replay", "mass/0", "--no-video"], "--no-video", "--replay"),
    ],
)
def test_other_kinds_exclude_each_other_too(line, args, option, kind):
    assert track(*args, code=2).stderr.startswith(f"slomo: {option}: has no effect with {kind}; leave it out")


def test_what_is_not_given_stays_as_it_is_written(line):
    text = (line / "slomo.toml").read_text()
    text = text.replace('# rows = ["none", "mass"]', 'rows = ["mass"]')
    (line / "slomo.toml").write_text(text.replace('# controllers = ["ci-mpc"]', 'controllers = ["open-loop"]'))
    track("--trials", "3")
    assert written(line, "trials") == {"trials": 3, "rows": ["mass"], "controllers": ["open-loop"]}
    track("--compare")
    three = ["ci-mpc", "convex-mpc", "open-loop"]
    assert written(line, "trials") == {"trials": 3, "rows": ["mass"], "controllers": three}
    track("--trials", "4", "--rows", "none,mass")
    assert written(line, "trials") == {"trials": 4, "rows": ["none", "mass"], "controllers": three}
    track("--trials", "4", "--no-compare", "--set", "trials.rows=")
    assert written(line, "trials") == {"trials": 4}


def test_a_comparison_has_ten_trials_unless_more_are_asked_for(line):
    track("--compare")
    assert written(line, "trials")["trials"] == 10
    assert "# trials = 200  # " not in (line / "slomo.toml").read_text()


def test_the_command_that_is_named_can_be_typed(line):
    track("--trials", "7")
    track("--replay", "mass/3")
    run("optimize", "--robot", "go1", "--set", "track.gain=2.0")
    stages = json.loads(run("status", "--json").stdout)["stages"]
    commands = {s["stage"]: s["command"] for s in stages}
    assert commands["trials"] == "slomo track --trials 7 --robot go1"
    assert commands["replay"] == "slomo track --replay mass/3 --robot go1"
    assert commands["track"] == "slomo track --sim --robot go1"
    assert "trials-go1         stale\n" in run("status").stdout
    for command in (commands["trials"], commands["replay"]):
        run(*command.split()[1:])
    assert "trials-go1         current\n" in run("status").stdout
    run("optimize", "--robot", "go1", "--set", "trials.trials=", "--set", "track.gain=3.0")
    assert "run `slomo track --trials 200 --robot go1`" in run("status", "--why").stdout


def test_imported_again_without_naming_the_file(project):
    assert "no keypoints given; run `slomo import KEYPOINTS`" in run("import", code=3).stderr
    points = keypoint_file(project)
    run("import", points)
    run("retarget", "--robot", "go1")
    points.write_bytes(points.read_bytes()[:-1] + b"x")
    assert (
        "import             stale\n    the file for keypoints changed\n    run `slomo import`"
        in run("status", "--why").stdout
    )
    keypoint_file(project)
    run("import", "--fresh")
    (project / "out" / "import.json").unlink()
    assert "run `slomo import` first" in run("retarget", "--robot", "go1", code=3).stderr
    run("import")
    run("retarget", "--robot", "go1")


@pytest.mark.parametrize(
    ("option", "command"), [("masks", "reconstruct"), ("weights", "reconstruct"), ("truth", "report")]
)
def test_none_takes_back_a_file(project, option, command):
    run("run", "clip.txt", "--robot", "go1")
    args = [command] if command == "reconstruct" else [command, "--robot", "go1"]
    (project / "given").write_text("x")
    run(*args, f"--{option}", "given")
    assert written(project, "inputs")[option] == "given"
    (project / "given").unlink()
    segmenter = ["--set", "masks.segmenter=u2netp"] if option == "weights" else []
    said = run(*args, *segmenter, code=4).stderr
    assert f"give an existing path ({option}, or do without: --set inputs.{option}=)" in said
    run(*args, f"--{option}", "none", *segmenter)
    assert option not in written(project, "inputs")
    run("run", "--robot", "go1", f"--{option}", "none")
    said = run(*args, f"--{option}", "gone", code=4).stderr
    assert f"gone: no such file or folder; give an existing path ({option})" in said


def test_synth_and_dataset_say_their_defaults():
    from slomo.synth import clip, dataset

    for name, config in (("synth", clip.Config()), ("dataset", dataset.Config())):
        help_of = {p.name: p.help for p in COMMANDS[name].params}
        for f in fields(config):
            value = getattr(config, f.name)
            shown = "none" if value is False else f"{value:g}" if isinstance(value, float) else str(value)
            assert help_of[f.name].endswith(f"Default: {shown}."), f.name


@pytest.mark.parametrize("command", ["synth", "dataset"])
def test_a_folder_that_cannot_be_written_is_told_before_the_work(project, command, monkeypatch):
    for module, name in (("clip", "write_clip"), ("dataset", "write_dataset")):
        monkeypatch.setattr(f"slomo.synth.{module}.{name}", lambda *a, **k: pytest.fail("it has begun"))
    said = run(command, "clip.txt/inside", code=1).stderr
    assert (
        said
        == "slomo: clip.txt/inside: cannot write (Not a directory); give another OUT_DIR, or make this one writable\n"
    )
