"""What all commands share: their common options, the project, results on stdout, errors and exit codes."""

import contextlib
import ctypes
import errno
import inspect
import json
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slomo.console import Console
from slomo.errors import Interrupted, InvalidData, SlomoError, StageFailed

if TYPE_CHECKING:
    from slomo.pipeline import Project
    from slomo.runner import Runner
    from slomo.store import Manifest

COMMON: dict[str, Any] = {
    "project": Annotated[
        Path | None,
        typer.Option("--project", help="Project folder. Default: the nearest parent with slomo.toml, else this one."),
    ],
    "as_json": Annotated[bool, typer.Option("--json", help="Print a JSON object instead of a path or text.")],
    "quiet": Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no notes; errors only.")],
}
RUNNING: dict[str, Any] = {
    "no_wait": Annotated[
        bool, typer.Option("--no-wait", help="Exit with 75 if another process makes the same artifact.")
    ],
    "fresh": Annotated[bool, typer.Option("--fresh", help="Make it anew: neither cache nor checkpoint.")],
    "overrides": Annotated[
        list[str] | None,
        typer.Option("--set", metavar="SECTION.NAME=VALUE", help="Write a parameter into slomo.toml. Repeatable."),
    ],
}
RobotOption = Annotated[
    str, typer.Option("--robot", metavar="NAME|PATH", help="A name of `slomo robots`, or the path of a robot.toml.")
]


@dataclass
class Session:
    """One command under way."""

    project_option: Path | None = None
    as_json: bool = False
    quiet: bool = False
    no_wait: bool = False
    fresh: bool = False
    overrides: list[str] = field(default_factory=list)
    result: str | None = None

    def __post_init__(self):
        self.console = Console(quiet=self.quiet)

    @property
    def root(self) -> Path:
        """The project folder, which need not exist yet."""
        if self.project_option is not None:
            return self.project_option.absolute()
        here = Path.cwd()
        return next((p for p in (here, *here.parents) if (p / "slomo.toml").is_file()), here)

    def project(self, robot: str | None = None) -> "Project":
        """The project as it is, with the --set options written to its slomo.toml."""
        return self.configure({}, robot)

    def configure(self, changes: dict[str, dict[str, Any]], robot: str | None = None) -> "Project":
        """The project with `changes` and the --set options checked and written to its slomo.toml."""
        from slomo import settings
        from slomo.pipeline import STAGES, Project

        changes = {section: dict(values) for section, values in changes.items() if values}
        for text in self.overrides:
            section, name, value = settings.parse_set(text)
            changes.setdefault(section, {})[name] = value
        project = Project(self.root, robot)
        project.tables = settings.merge(project.tables, changes, list(STAGES), where=self.root / settings.FILE)
        for section in changes.keys() - {"inputs"}:
            project.config(section)
        if changes:
            self.initialise()
            for line in settings.edit(self.root, changes):
                self.console.note(line)
        return project

    def initialise(self) -> bool:
        """Write slomo.toml unless there is one; say so. True if it was written."""
        from slomo import settings
        from slomo.pipeline import ALL, STAGES
        from slomo.store import replace_file
        from slomo.template import template

        path = self.root / settings.FILE
        if path.is_file():
            return False
        records = {s.name: (s.module, s.config) for s in STAGES.values()}
        text = template(records, {s.name: s.lender for s in STAGES.values() if s.shares == ALL})
        replace_file(path, text.encode())
        self.console.note(f"new project: {path}")
        return True

    def user_path(self, path: Path, what: str) -> str:
        """A user's file as slomo.toml names it: relative inside the project, absolute elsewhere."""
        if not path.exists():
            raise InvalidData("no such file or folder", where=path, todo=f"give an existing path ({what})")
        resolved, root = path.resolve(), self.root.resolve()
        return resolved.relative_to(root).as_posix() if resolved.is_relative_to(root) else str(resolved)

    def path_or_none(self, text: str, what: str) -> str | None:
        """The same of an option that takes `none` too, which unsets the file."""
        return None if text == "none" else self.user_path(Path(text), what)

    def given(self, role: str) -> bool:
        """Whether slomo.toml names the user's file for `role`."""
        from slomo.pipeline import Project

        return Project(self.root).given(role) is not None

    def choice_reopened(self, role: str) -> dict[str, None]:
        """A first clip, or first key points, undo an earlier choice between the two."""
        return {} if self.given(role) else {"motion": None}

    def runner(self, project: "Project") -> "Runner":
        """What makes the project's artifacts."""
        from slomo.runner import Runner

        return Runner(project, self.console, wait=not self.no_wait, fresh=self.fresh)

    def emit(self, text: str, data: Any) -> None:
        """Keep the command's result; it is printed on stdout when the command has ended."""
        from slomo.store import json_bytes

        self.result = json_bytes(data).decode().rstrip("\n") if self.as_json else text

    def emit_artifact(self, m: "Manifest") -> None:
        """Print an artifact's path or manifest. Raises `StageFailed` if its result is not usable."""
        path = self.root / m["directory"]
        self.emit(str(path), m)
        if m["stage"] == "report":
            for name in m["files"]:
                self.console.note(f"report: {path / name}")
        if m["stage"] == "optimize" and "report.json" in m["files"]:
            from slomo.report import checks

            report = json.loads((path / "report.json").read_text())
            if "checks" in report:
                self.console.show(checks.as_table(report), f"optimize: {checks.as_line(report)}")
        if m["stage"] == "trials" and "trials.json" in m["files"]:
            self.console.note(json.loads((path / "trials.json").read_text())["text"])
        if m["failure"]:
            raise StageFailed(m["failure"], where=m["stage"], todo=f"its best result is in {path}")


def _crashed(session: Session, error: Exception) -> str:
    """Keep the traceback where the user can find it; one line."""
    text = f"{' '.join(sys.argv)}\n\n{''.join(traceback.format_exception(error))}"
    summary = f"internal error: {type(error).__name__}: {error}"
    for path in (session.root / ".slomo" / "crash.txt", Path(tempfile.gettempdir()) / "slomo-crash.txt"):
        with contextlib.suppress(OSError):
            if (session.root / "slomo.toml").is_file():
                path.parent.mkdir(exist_ok=True)
            path.write_text(text)
            return f"{summary} (traceback in {path})"
    return summary


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """What libraries print, from Python or C, goes to stderr: stdout is for the result."""
    flush_c = ctypes.CDLL(None).fflush
    sys.stdout.flush()
    flush_c(None)
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        flush_c(None)
        os.dup2(stdout, 1)
        os.close(stdout)


def _terminated(number: int, frame: object) -> None:
    raise Interrupted(number)


def _exit_code(session: Session, run: Callable[[], None]) -> int:
    """Run a command; every way in which it can end, as an exit code and at most one line on stderr."""
    line, code = "", 0
    try:
        with _stdout_to_stderr():
            run()
    except SlomoError as e:
        line, code = str(e), e.exit_code
    except KeyboardInterrupt:
        line, code = "interrupted", 130
    except MemoryError:
        line, code = "out of memory; use a shorter or smaller clip (--duration)", 1
    except OSError as e:
        known = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
        line, code = f"{e.filename or 'writing'}: {e.strerror}" if known else _crashed(session, e), 1
    except Exception as e:
        line, code = _crashed(session, e), 1
    session.console.close()
    if session.result is not None:
        try:
            print(session.result, flush=True)
        except BrokenPipeError:  # the reader, `head` say, has had enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if line:
        session.console.line(f"slomo: {' '.join(line.split())}")
    return code


def command(app: typer.Typer, name: str, *, runs: bool = False) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register `f(session, ...)` as a command with the common options and the error handling of all commands.

    Args:
        runs: whether it makes artifacts, and so takes --no-wait, --fresh and --set too.
    """
    extra = COMMON | (RUNNING if runs else {})
    defaults = {"project": None, "overrides": None}

    def register(f: Callable[..., None]) -> Callable[..., None]:
        def wrapper(**given: Any) -> None:
            mine = {n: given.pop(n) for n in extra}
            mine["project_option"] = mine.pop("project")
            if "overrides" in mine:
                mine["overrides"] = mine["overrides"] or []
            session = Session(**mine)
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, _terminated)
            raise typer.Exit(_exit_code(session, lambda: f(session, **given)))

        own = list(inspect.signature(f, eval_str=True).parameters.values())[1:]
        added = [
            inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, annotation=a, default=defaults.get(n, False))
            for n, a in extra.items()
        ]
        own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
        wrapper.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
        wrapper.__annotations__ = {p.name: p.annotation for p in (*own, *added)}
        wrapper.__doc__ = f.__doc__
        app.command(name)(wrapper)
        return f

    return register


def device_there(project: "Project", stage: str) -> None:
    """A device that is not there is told of now and not after minutes, when the fields begin, where `stage` needs them.

    Raises:
        UsageError: of `SLOMO_DEVICE`.
    """
    if os.environ.get("SLOMO_DEVICE") and "reconstruct" in project.chain(stage):
        from slomo.reconstruct.refine_stage import device_of

        device_of(project.config("reconstruct"))
