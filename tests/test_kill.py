"""SIGKILL in the middle of every real stage, and two processes at once: what is made is what would have been made."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from slomo.store.digest import without_wall_times

pytestmark = pytest.mark.slow

CLIP = Path(str(files("slomo"))) / "assets" / "walk" / "clip.mp4"
COMMANDS = {
    "masks": ["reconstruct"],
    "camera": ["reconstruct"],
    "fit": ["reconstruct"],
    "reconstruct": ["reconstruct"],
    "retarget": ["retarget", "--robot", "go1"],
    "optimize": ["optimize", "--robot", "go1"],
    "track": ["track", "--sim", "--no-video", "--robot", "go1"],
    "trials": ["track", "--robot", "go1", "--trials", "2", "--rows", "none,push-12"],
    "report": ["report", "--robot", "go1"],
}
KILLED = [stage for stage in COMMANDS if stage != "retarget"]  # which is over in a tenth of a second
# As short as it can be: the accuracy is not of interest here.
SETTINGS = f"""[inputs]
clip = "{CLIP}"
[decode]
duration = 1.5
[masks]
segmenter = "motion"
[reconstruct]
iterations = [20, 10, 10, 45, 15]
gait_phases = 4
candidates = 3
"""


def start(project: Path, command: list[str]) -> subprocess.Popen:
    """A real `slomo` in a process group of its own, its stderr in the file `said`."""
    program = [sys.executable, "-c", "from slomo.cli import main; main()", *command, "--project", str(project)]
    with open(project / f"said-{time.monotonic_ns()}", "w") as said:
        return subprocess.Popen(program, stdout=said, stderr=said, start_new_session=True)


def said(project: Path) -> str:
    """What the last process that was started wrote."""
    return max(project.glob("said-*"), key=lambda p: int(p.name.split("-")[1])).read_text()


def finish(project: Path, command: list[str]) -> None:
    process = start(project, command)
    assert process.wait() == 0, said(project)


def new_project(folder: Path) -> Path:
    folder.mkdir()
    (folder / "slomo.toml").write_text(SETTINGS)
    return folder


def manifest(project: Path, stage: str) -> dict:
    """That of the only artifact of the stage."""
    (path,) = project.glob(f".slomo/store/{stage}/*/manifest.json")
    return json.loads(path.read_text())


def children(group: int) -> list[int]:
    """Processes of a group, its leader aside."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[2]) == group and int(path.parent.name) != group and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def in_its_middle(project: Path, stage: str, process: subprocess.Popen, seconds: float) -> None:
    """Wait until the stage is under way: a third of the time that it took before, or of its work, is over."""
    began = None
    while process.poll() is None:
        found = list(project.glob(f".slomo/partial/{stage}/*/progress.json"))
        if found and began is None:
            began = time.monotonic()
        if began is not None:
            try:
                fraction = json.loads(found[0].read_text())["fraction"] if found else 1.0
            except OSError:
                fraction = 0.0
            under_way = fraction > 0.33 or time.monotonic() - began > 0.33 * seconds
            if under_way and (stage != "camera" or children(process.pid)):
                return
        time.sleep(0.01)
    pytest.fail(f"{stage} ended before it could be killed\n{said(project)}")


def content(project: Path, stage: str) -> dict:
    """All that the artifact holds, wall-clock figures aside."""
    folder = project / manifest(project, stage)["directory"]
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".npz":
            with np.load(path) as z:
                found |= {
                    (path.name, k): (z[k].dtype.str, z[k].shape, z[k].tobytes()) for k in z.files if "mpc_ms" not in k
                }
        elif path.suffix == ".json" and path.name != "manifest.json" and stage != "report":
            found[path.name] = without_wall_times(json.loads(path.read_text()))
        else:
            found[path.name] = None  # pictures carry times that were measured
    return found


def differing(a: dict, b: dict) -> list:
    return [name for name in {**a, **b} if a.get(name) != b.get(name)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    """The project that nobody interrupts."""
    project = new_project(tmp_path_factory.mktemp("kill") / "undisturbed")
    for stage in ("reconstruct", "retarget", "optimize", "track", "trials", "report"):
        finish(project, COMMANDS[stage])
    return project


def test_killed_in_the_middle_of_each_stage(undisturbed, tmp_path):
    project = new_project(tmp_path / "killed")
    for stage, command in COMMANDS.items():
        if stage in KILLED:
            process = start(project, command)
            in_its_middle(project, stage, process, manifest(undisturbed, stage)["seconds"])
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            assert not list(project.glob(f".slomo/store/{stage}/*"))
            assert not list(project.glob(f"out/{stage}*.json"))
        if stage not in ("masks", "camera", "fit"):  # whose second call is the one that is killed next
            finish(project, command)
    for stage in COMMANDS:
        assert differing(content(project, stage), content(undisturbed, stage)) == [], stage
        assert not list(project.glob(f".slomo/partial/{stage}/*"))
    assert not list(project.rglob("*.tmp"))


def test_the_child_dies_with_its_parent(undisturbed, tmp_path):
    """Structure from motion runs in a process of its own, which SIGKILL of `slomo` alone does not reach."""
    project = new_project(tmp_path / "orphan")
    process = start(project, COMMANDS["camera"])
    in_its_middle(project, "camera", process, manifest(undisturbed, "camera")["seconds"])
    process.kill()
    process.wait()
    until = time.monotonic() + 30
    while children(process.pid) and time.monotonic() < until:
        time.sleep(0.1)
    assert children(process.pid) == []


def test_two_at_once(undisturbed, tmp_path):
    project = new_project(tmp_path / "two")
    first = start(project, ["reconstruct"])
    second = start(project, ["reconstruct"])
    assert first.wait() == 0
    assert second.wait() == 0
    texts = [p.read_text() for p in project.glob("said-*")]
    assert len(texts) == 2
    for stage in ("decode", "masks", "camera", "evidence", "fit", "reconstruct"):
        assert sum(f"{stage}: done in" in text for text in texts) == 1, texts
        assert sum(f"{stage}: cached" in text for text in texts) == 1, texts
        assert differing(content(project, stage), content(undisturbed, stage)) == [], stage
    assert any("waiting for" in text for text in texts)
