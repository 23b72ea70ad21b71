"""Errors that a user can cause. Each is one readable line and carries its exit code.

Exit codes: 0 done or cached; 1 failed or did not converge; 2 usage; 3 a stage's input is missing or stale;
4 the given data is invalid; 75 locked and --no-wait; 130 / 143 interrupted by SIGINT / SIGTERM.
"""

from collections.abc import Iterable


class SlomoError(Exception):
    """`where: what (valid: ...); what to do next` on one line; a user never sees its traceback.

    Args:
        what: what is wrong, in the user's words ("no video stream").
        where: the file, option or frame concerned.
        valid: the values that would have been accepted.
        todo: what to do next ("give a video file").
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object = "", valid: Iterable[object] = (), todo: str = ""):
        self.what, self.where, self.valid, self.todo = what, str(where), tuple(map(str, valid)), todo
        line = f"{self.where}: {what}" if self.where else what
        if self.valid:
            line += f" (valid: {', '.join(self.valid)})"
        if todo:
            line += f"; {todo}"
        super().__init__(" ".join(line.split()))


class StageFailed(SlomoError):
    """A stage ran and its result is not usable (a solver did not converge, a check did not hold)."""

    exit_code = 1


class UsageError(SlomoError):
    """A wrong option, name or parameter."""

    exit_code = 2


class MissingInput(SlomoError):
    """The artifact that a stage starts from is missing or stale."""

    exit_code = 3


class InvalidData(SlomoError):
    """The given file or its content cannot be used."""

    exit_code = 4


class Locked(SlomoError):
    """Another process works on the same artifact and --no-wait was given."""

    exit_code = 75


class Interrupted(SlomoError):
    """SIGINT or SIGTERM; the state is saved and the same command goes on."""

    def __init__(self, signal_number: int, what: str = "interrupted"):
        super().__init__(what, todo="run the same command again to go on")
        self.exit_code = 128 + signal_number
