"""The commands that look after a project: init, status, gc."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slomo.cli.session import Session, command
from slomo.errors import SlomoError

if TYPE_CHECKING:
    from slomo.status import State


def _all_states(session: Session, robot: str | None) -> "dict[str, State]":
    """Label -> state of every stage, for `robot` or for every robot that has artifacts and still exists."""
    from slomo.pipeline import Project
    from slomo.status import states

    project = Project(session.root, robot)
    pointers = project.store.pointers().values()
    robots = {robot} if robot else {c["robot_source"] for c in pointers if c.get("robot_source")}
    found: dict[str, State] = {}
    for role, last in (("clip", "reconstruct"), ("keypoints", "import")):
        if project.given(role):
            found |= {s.label: s for s in states(project, last).values()}
    for name in sorted(robots):
        own = Project(session.root, name)
        try:
            own.label(own.chain("report")[-1])
        except SlomoError as e:  # a robot that is gone, or a choice to be made between clip and key points
            if robot:
                raise
            session.console.note(str(e))
            continue
        found |= {s.label: s for s in states(own, "report").values()}
        for extra in ("trials", "replay", "deploy"):  # shown once they have been asked for
            state = states(own, extra)[extra]
            found |= {state.label: state} if state.status != "missing" else {}
    return found


def add_commands(app: typer.Typer) -> None:
    """Register the commands with `app`."""

    @command(app, "init")
    def init(session: Session) -> None:
        """A new project: slomo.toml with every parameter at its default.

        Commands that make artifacts do this by themselves.

        \b
        slomo init --project cat
        """
        new = session.initialise()
        path = session.root / "slomo.toml"
        if not new:
            session.console.note(f"already a project: {path}")
        session.emit(str(path), {"path": str(path), "new": new})

    @command(app, "status")
    def status(
        session: Session,
        robot: Annotated[str | None, typer.Option("--robot", help="Default: every robot with artifacts.")] = None,
        why: Annotated[
            bool, typer.Option("--why", help="Say which input or parameter changed, and what to run.")
        ] = False,
    ) -> None:
        """Per stage: current, stale, missing, failed, running or interrupted.

        \b
        slomo status --why
        slomo status --json
        """
        found = _all_states(session, robot)
        lines = []
        for s in found.values():
            lines.append(f"{s.label:<18} {s.status}")
            if why:
                lines += [f"    {reason}" for reason in s.why]
                lines += [f"    run `{s.command}`"] if s.status not in ("current", "running") else []
        if not found:
            lines = [f"nothing yet in {session.root}; run `slomo reconstruct CLIP` or `slomo import KEYPOINTS`"]
        facts = ("directory", "files", "started", "seconds", "notes")
        shown = [
            {**asdict(s), "manifest": {k: s.manifest[k] for k in facts} if s.manifest else None} for s in found.values()
        ]
        session.emit("\n".join(lines), {"project": str(session.root), "stages": shown})

    @command(app, "gc")
    def gc(
        session: Session,
        dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be removed.")] = False,
    ) -> None:
        """Remove artifacts and interrupted runs that nothing points to any more.

        \b
        slomo gc --dry-run
        """
        from slomo.store import Store, remove, size_of

        store = Store(session.root)
        keep = {(s.stage, s.key) for s in _all_states(session, None).values() if s.key}
        removed: list[dict[str, Any]] = []
        for path in store.unused(keep):
            removed.append({"path": path.relative_to(session.root).as_posix(), "bytes": size_of(path)})
            if not dry_run:
                remove(path)
        total = sum(r["bytes"] for r in removed)
        session.console.note(f"{'would free' if dry_run else 'freed'} {total / 1e6:.1f} MB")
        session.emit("\n".join(r["path"] for r in removed), {"dry_run": dry_run, "bytes": total, "removed": removed})
