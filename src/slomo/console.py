"""What the user sees while slomo works. Everything goes to stderr; stdout belongs to results."""

import sys
import time
from typing import Any, TextIO

PLAIN_EVERY = 5.0  # s between two lines where stderr is no terminal


class Console:
    """Progress bars on a terminal, one plain line every few seconds elsewhere, nothing with `quiet`."""

    def __init__(self, *, quiet: bool = False, stream: TextIO | None = None):
        self.quiet = quiet
        self.stream = stream or sys.stderr
        self.live = not quiet and self.stream.isatty()
        self._bars = None
        self._task = None
        self._stage = ""
        self._started = self._last = 0.0

    def line(self, text: str) -> None:
        """One line, whatever else is on the screen; `quiet` does not silence it."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=self.stream, flush=True)

    def note(self, text: str) -> None:
        """One line that `quiet` silences."""
        if not self.quiet:
            self.line(text)

    def show(self, picture: Any, text: str) -> None:
        """Something that rich can draw, on a terminal; elsewhere a line; nothing with `quiet`."""
        if not self.live:
            self.note(text)
        elif self._bars is not None:
            self._bars.console.print(picture)
        else:
            from rich.console import Console as RichConsole

            RichConsole(file=self.stream).print(picture)

    def start(self, stage: str) -> None:
        """A stage begins."""
        self._stage, self._started = stage, time.monotonic()
        self._last = self._started
        if self.live:
            from rich.console import Console as RichConsole
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

            if self._bars is None:
                columns = (TextColumn("{task.description:<12}"), BarColumn(24), TaskProgressColumn())
                self._bars = Progress(
                    *columns, TimeElapsedColumn(), TextColumn("{task.fields[message]}"),
                    console=RichConsole(file=self.stream),
                )  # fmt: skip
                self._bars.start()
            self._task = self._bars.add_task(stage, total=1.0, message="")

    def update(self, fraction: float, message: str) -> None:
        """The stage under way has done `fraction` in [0, 1]."""
        now = time.monotonic()
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, completed=fraction, message=message)
        elif not self.quiet and now - self._last >= PLAIN_EVERY:
            self._last = now
            self.line(f"{self._stage}: {100 * fraction:3.0f} %  {message}  ({now - self._started:.0f} s)")

    def done(self, text: str) -> None:
        """The stage under way has ended."""
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, completed=1.0, message="")
            self._task = None
        self.note(f"{self._stage}: {text}")

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bars is not None:
            self._bars.stop()
            self._bars = None
