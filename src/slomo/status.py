"""What is current, stale, missing, running or interrupted, and why."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slomo.errors import SlomoError
from slomo.pipeline import STAGES, Identity, Project
from slomo.settings import toml_value
from slomo.store import Manifest, read_json


@dataclass(frozen=True)
class State:
    """State of one stage's artifact.

    Attributes:
        status: current, failed, stale, missing, running or interrupted.
        why: one line a reason.
        key: of what the present parameters ask for; None where what comes before is not current.
        manifest: of the current artifact, for `current` and `failed`.
    """

    stage: str
    label: str
    status: str
    why: tuple[str, ...] = ()
    key: str | None = None
    manifest: Manifest | None = None
    command: str = ""


def states(project: Project, last: str) -> dict[str, State]:
    """The states of `last` and everything before it, in order."""
    out: dict[str, State] = {}
    for stage in project.chain(last):
        out[stage] = _state(project, stage, out)
    return out


def _state(project: Project, stage: str, before: Mapping[str, State]) -> State:
    label, command = project.label(stage), project.command(stage)
    pointer = project.store.pointer(label)
    upstream = {name: before[name] for name in project.upstream(stage)}
    waiting = tuple(
        f"{s.label} failed: {s.manifest['failure']}" if s.manifest else f"{s.label} is {s.status}"
        for s in upstream.values()
        if s.status != "current" and not (s.status == "failed" and STAGES[stage].inspects)
    )
    if waiting:
        return State(stage, label, "stale" if pointer else "missing", waiting, command=command)
    try:
        identity = project.identity(stage, {n: s.manifest for n, s in upstream.items() if s.manifest})
    except SlomoError as e:
        return State(stage, label, "stale" if pointer else "missing", (str(e),), command=command)
    key = identity.key
    if who := project.store.holder(stage, key):
        return State(stage, label, "running", (who,), key, command=command)
    m = project.store.manifest(stage, key)
    if m and m["failure"]:
        return State(stage, label, "failed", (m["failure"],), key, m, command)
    if m and pointer and pointer["key"] == key:
        return State(stage, label, "current", (), key, m, command)
    why = _changes(project, identity, pointer)
    if m:
        why += ("an artifact for the present parameters is in the store",)
    elif progress := read_json(project.store.partial(stage, key) / "progress.json"):
        done = f"at {100 * progress['fraction']:.0f} %"
        resumes = "goes on from there" if progress["checkpoint"] else "starts again: there is no checkpoint yet"
        return State(stage, label, f"interrupted {done}", (*why, f"interrupted {done}, {resumes}"), key, None, command)
    return State(stage, label, "stale" if pointer else "missing", why, key, None, command)


def _changes(project: Project, now: Identity, pointer: Mapping[str, Any] | None) -> tuple[str, ...]:
    """What differs between the artifact that the pointer leads to and the one that is asked for now."""
    if not pointer:
        return ("never made",)
    m = project.store.manifest(pointer["stage"], pointer["key"])
    if m is None:
        return ("its artifact is gone from the store or damaged",)
    was = Identity(**m["identity"])
    why = []
    if was.version != now.version:
        why.append(f"slomo's {now.stage} changed (version {was.version} -> {now.version})")
    for name in sorted(was.config.keys() | now.config.keys()):
        a, b = was.config.get(name), now.config.get(name)
        if a != b:
            why.append(f"[{now.stage}] {name} changed: {_shown(a)} -> {_shown(b)}")
    for role in sorted(was.files.keys() | now.files.keys()):
        why += _difference(f"file for {role}", was.files.get(role), now.files.get(role))
    for name in sorted(was.inputs.keys() | now.inputs.keys()):
        why += _difference(f"result of {name}", was.inputs.get(name), now.inputs.get(name))
    why += _difference("robot", was.robot, now.robot)
    return tuple(why) or (("it is damaged",) if pointer["key"] == now.key else ("slomo's store format changed",))


def _shown(x: Any) -> str:
    return "none" if x is None else toml_value(x)


def _difference(what: str, was: str | None, now: str | None) -> list[str]:
    if was == now:
        return []
    verb = "is new" if was is None else "is no longer used" if now is None else "changed"
    return [f"the {what} {verb}"]
