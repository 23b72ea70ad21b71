"""How a stage reports, saves itself and hears of SIGINT and SIGTERM."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

from slomo.console import Console
from slomo.errors import Interrupted
from slomo.stage import Arrays
from slomo.store import Store, json_bytes, replace_file

CHECKPOINT_EVERY = 20.0  # s
GRACE = 10.0  # s that a stage which saves checkpoints has for saving one after a signal


class Signals:
    """Remembers the first SIGINT or SIGTERM; a second one ends the process at once (nothing in the store can tear)."""

    def __init__(self):
        self.number: int | None = None
        self.since = 0.0

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Catch the signals inside the block (in the main thread only, as Python wants it)."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        old = {n: signal.signal(n, self._handle) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for n, handler in old.items():
                signal.signal(n, handler)

    def _handle(self, number: int, frame: object) -> None:
        self.number, self.since = number, time.monotonic()
        for n in (signal.SIGINT, signal.SIGTERM):
            signal.signal(n, signal.SIG_DFL)
        os.write(2, b"\nstopping at the next safe point; the same signal again stops at once\n")

    def check(self) -> None:
        """Raise `Interrupted` if a signal has come in."""
        if self.number is not None:
            raise Interrupted(self.number)


class RunProgress:
    """The `Progress` of one run of one key."""

    def __init__(self, store: Store, stage: str, key: str, *, console: Console, signals: Signals):
        self.notes: list[str] = []
        self.resumed_at: float | None = None
        self._checkpoints = store.checkpoints(stage, key)
        self._path = store.partial(stage, key) / "progress.json"
        self._stage, self._console, self._signals = stage, console, signals
        self._fraction, self._message, self._saved = 0.0, "", False
        self._polls = False
        self._wrote = self._shown = 0.0
        self._checkpointed = time.monotonic()

    def update(self, fraction: float, message: str = "") -> None:
        self._fraction, self._message = min(max(float(fraction), 0.0), 1.0), message
        now = time.monotonic()
        if now - self._shown > 0.1:
            self._shown = now
            self._console.update(self._fraction, message)
        if now - self._wrote > 2.0 or self._signals.number is not None:
            self._write()
        if not self._polls or now - self._signals.since > GRACE:
            self._signals.check()

    def note(self, message: str) -> None:
        message = message.removeprefix(f"{self._stage}: ")
        if message not in self.notes:
            self.notes.append(message)
            self._console.note(f"{self._stage}: {message}")

    def checkpoint_due(self) -> bool:
        self._polls = True
        return self._signals.number is not None or time.monotonic() - self._checkpointed > CHECKPOINT_EVERY

    def save(self, state: Arrays) -> None:
        self._checkpoints.save(state, {"fraction": self._fraction, "message": self._message})
        self._saved, self._checkpointed = True, time.monotonic()
        self._write()
        self._signals.check()

    def load(self) -> Arrays | None:
        found = self._checkpoints.load()
        if found is None:
            return None
        state, about = found
        self._saved, self.resumed_at = True, about["fraction"]
        self.note(f"goes on from {100 * about['fraction']:.0f} %")
        return state

    def _write(self) -> None:
        self._wrote = time.monotonic()
        content: dict[str, Any] = {"fraction": self._fraction, "message": self._message, "checkpoint": self._saved}
        replace_file(self._path, json_bytes(content))
