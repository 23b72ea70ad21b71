"""What the user stops a run with: signals, and any key at the terminal."""

import os
import select
import signal
import sys
import termios
import tty
from typing import Self

from slomo.deploy.supervisor import Cause

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stops:
    """Inside the block a signal or a key only sets a mark, so that the robot is let down first.

    Attributes:
        number: of the signal that came first, or None.
        terminal: whether there is one, whose keys count.
    """

    def __init__(self):
        self.number: int | None = None
        self.terminal = sys.stdin is not None and sys.stdin.isatty()

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._caught) for number in SIGNALS}
        if self.terminal:
            self._mode = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *error: object) -> None:
        if self.terminal:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._mode)
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> tuple[Cause, str] | None:
        """Why to stop, if there is a reason."""
        if self.number is not None:
            return Cause.SIGNAL, signal.Signals(self.number).name
        if self.terminal and select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 1)
            if not key:  # the terminal is gone
                self.terminal = False
            return Cause.STOP_KEY, f"key {key!r} at the terminal"
        return None

    def _caught(self, number: int, frame: object) -> None:
        self.number = self.number or number
