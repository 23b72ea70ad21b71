"""Making artifacts: look in the store, else run the stage under its lock, publish, and move the pointer."""

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import slomo
from slomo import settings
from slomo.console import Console
from slomo.errors import InvalidData, MissingInput, StageFailed, UsageError
from slomo.pipeline import STAGES, Identity, Project
from slomo.progress import RunProgress, Signals
from slomo.stage import Artifact, Inputs
from slomo.status import State, states
from slomo.store import Manifest
from slomo.store.lock import command_line


@cache
def git_revision() -> str | None:
    """Revision of the checkout that slomo runs from, with `+` where it has changes; None for an installed package."""
    here = Path(slomo.__file__).parent
    try:
        git = ["git", "-C", str(here)]
        run = {"capture_output": True, "text": True, "timeout": 10, "check": True}
        revision = subprocess.run([*git, "rev-parse", "HEAD"], **run).stdout.strip()
        return revision + ("+" if subprocess.run([*git, "status", "--porcelain", "."], **run).stdout else "")
    except (OSError, subprocess.SubprocessError):
        return None


@cache
def packages() -> dict[str, str]:
    """Versions of slomo and of what it requires."""
    required = importlib.metadata.requires("slomo") or []
    names = ["slomo", *(re.split(r"[^\w.-]", r)[0] for r in required if "extra ==" not in r)]
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def device() -> dict[str, Any]:
    """What it ran on. A GPU is named only where torch was used."""
    torch = sys.modules.get("torch")
    gpu = torch.cuda.get_device_name() if torch and torch.cuda.is_available() else None
    return {"machine": platform.machine(), "system": platform.platform(), "cpus": os.cpu_count(), "gpu": gpu}


class Runner:
    """Makes a project's artifacts.

    Args:
        wait: wait for another process that works on the same artifact; else raise `Locked`.
        fresh: do what is asked for anew, even where it is in the store or was interrupted.
    """

    def __init__(self, project: Project, console: Console, *, wait: bool = True, fresh: bool = False):
        self.project, self.console, self.wait, self.fresh = project, console, wait, fresh
        self.signals = Signals()

    def make(self, last: str) -> Manifest:
        """`last`, and before it everything that it needs and that is not current.

        Returns:
            The manifest of `last`, or of the first stage whose result is not usable (`failure`); that ends the chain
            but for a stage that shows failures.
        """
        for stage in self.project.chain(last):
            self.project.config(stage)
        done: dict[str, Manifest] = {}
        failed: Manifest | None = None
        with self.signals.installed():
            for stage in self.project.chain(last):
                before = {name: done[name] for name in self.project.upstream(stage) if name in done}
                if failed is None or (STAGES[stage].inspects and len(before) == len(self.project.upstream(stage))):
                    done[stage] = self._ensure(stage, before, touch=stage == last)
                    failed = failed or (done[stage] if done[stage]["failure"] else None)
        if len(done) > 1:
            self._say_times(done)
        return failed or done[last]

    def _say_times(self, done: Mapping[str, Manifest]) -> None:
        """One line with the time that each artifact took when it was made, now or before."""
        took = {name: float(m["seconds"]) for name, m in done.items()}
        parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in took.items())
        self.console.note(f"time: {parts}; together {sum(took.values()):.1f} s")

    def make_only(self, stage: str, *, show: bool = False) -> Manifest:
        """`stage`, from artifacts that are there; with `show` the report too, even of a failure.

        Returns:
            The manifest of `stage`, which may have failed.

        Raises:
            MissingInput: one of the artifacts is missing, stale or failed; says why and what to run.
        """
        before = self._require(stage)
        with self.signals.installed():
            m = self._ensure(stage, before, touch=True)
            if show:
                shown = self._ensure("report", self._require("report"), touch=True)
                for name in shown["files"]:
                    self.console.note(f"report: {self.project.root / shown['directory'] / name}")
        return m

    def _require(self, stage: str) -> dict[str, Manifest]:
        """The current artifacts that `stage` takes."""
        for name in self.project.chain(stage):
            self.project.config(name)
        found = states(self.project, stage)
        inspects = STAGES[stage].inspects
        needed = {n: found[n] for n in self.project.upstream(stage)}
        return {n: self._check(s, found, wanted_by=stage, inspects=inspects) for n, s in needed.items()}

    def current(self, stage: str, *, wanted_by: str) -> Artifact:
        """The stage's artifact that is there. Raises `MissingInput` as `make_only`."""
        found = states(self.project, stage)
        return self.project.store.load(self._check(found[stage], found, wanted_by=wanted_by))

    def _check(self, state: State, found: Mapping[str, State], *, wanted_by: str, inspects: bool = False) -> Manifest:
        """The manifest of an artifact that is current, or, with `inspects`, failed. Raises `MissingInput`."""
        fit = state.status == "current" or (inspects and state.status == "failed")
        if state.manifest is None or not fit:
            raise self._missing(wanted_by, state, found)
        if state.key and (bad := self.project.store.damaged(state.stage, state.key)):
            self.project.store.discard(state.stage, state.key)
            raise MissingInput(
                f"the stored artifact was damaged ({bad})", where=state.stage, todo=f"run `{state.command}`"
            )
        return state.manifest

    def _missing(self, stage: str, state: State, found: Mapping[str, State]) -> MissingInput:
        """`state` and the first thing before it that is not current, which is why."""
        root = next(s for s in found.values() if s.status != "current")
        because = f" because {root.label} is {root.status}" if root is not state and root.label != state.label else ""
        status = state.status.split(" at ")[0]
        return MissingInput(
            f"{state.label} {'has failed' if status == 'failed' else f'is {status}'}{because} ({'; '.join(root.why)})",
            where=stage,
            todo=f"run `{root.command}` first",
        )

    def _ensure(self, stage: str, before: Mapping[str, Manifest], *, touch: bool) -> Manifest:
        project, store = self.project, self.project.store
        identity = project.identity(stage, before)
        key = identity.key
        note = self.console.note
        with store.lock(stage, key, wait=self.wait, note=note, check=self.signals.check):
            if not self.fresh and (bad := store.damaged(stage, key)):
                note(f"{stage}: the stored artifact is damaged ({bad}); making it again")
                store.discard(stage, key)
            m = None if self.fresh else store.manifest(stage, key)
            self.console.start(stage)
            if m is not None:
                self.console.done("failed before, the same again" if m["failure"] else "cached")
            else:
                m = self._run(stage, identity, before)
            if not m["failure"]:
                self._point(stage, m, before, touch=touch)
        self.signals.check()
        return m

    def _run(self, stage: str, identity: Identity, before: Mapping[str, Manifest]) -> Manifest:
        project, store, spec, key = self.project, self.project.store, STAGES[stage], identity.key
        if self.fresh:
            store.forget(stage, key)
        progress = RunProgress(store, stage, key, console=self.console, signals=self.signals)
        inputs = Inputs(
            artifacts={name: store.load(m) for name, m in before.items()},
            files=project.files(stage),
            robot=project.robot if spec.robot else None,
        )
        started, wall, cpu = datetime.now(UTC), time.perf_counter(), time.process_time()
        progress.update(0.0, "starting")
        try:
            artifact = spec.of_module(spec.run)(inputs, project.config(stage), progress)
        except (InvalidData, UsageError, StageFailed):
            store.forget(stage, key)  # to go on from there would end the same way
            raise
        seconds = time.perf_counter() - wall
        about = {
            "robot": project.robot.name if spec.robot else None,
            "identity": vars(identity),
            "notes": progress.notes,
            "started": started.isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
            "resumed_at": progress.resumed_at,
            "command": command_line(),
            "git": git_revision(),
            "python": platform.python_version(),
            "packages": packages(),
            "device": device(),
        }
        m = store.publish(stage, key, artifact, about)
        self.console.done(f"failed after {seconds:.1f} s" if m["failure"] else f"done in {seconds:.1f} s")
        return m

    def _point(self, stage: str, m: Manifest, before: Mapping[str, Manifest], *, touch: bool) -> None:
        project = self.project
        content = {
            "stage": stage,
            "robot": m["robot"],
            "robot_source": self._robot_source() if m["robot"] else None,
            "key": m["key"],
            "directory": m["directory"],
            "files": list(m["files"]),
        }
        after = [project.store.pointer_path(project.label(name)) for name in before]
        after += [project.root / settings.FILE, *project.files(stage).values()]
        project.store.point(project.label(stage), content, touch=touch, after=after)

    def _robot_source(self) -> str | None:
        name = self.project.robot_name
        return str(Path(name).resolve()) if name and Path(name).is_file() else name
