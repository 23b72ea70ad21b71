"""One process works on an artifact; a second one waits and says for whom."""

import contextlib
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from slomo.errors import Locked
from slomo.store.files import json_bytes, read_json, replace_file, writing


def command_line() -> str:
    """This process's command as the user would type it."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def _acquired(lock: FileLock) -> bool:
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    return True


def holder(path: Path) -> str | None:
    """Who holds the lock at `path` ("pid 7, `slomo run`"), or None. Never blocks."""
    if not path.exists():
        return None
    lock = FileLock(path)
    try:
        if _acquired(lock):
            lock.release()
            return None
    except OSError:  # who may only read the project cannot tell
        return None
    who = read_json(path.with_suffix(".json")) or {}
    return f"pid {who.get('pid', 'unknown')}, `{who.get('command', 'unknown command')}`"


@contextlib.contextmanager
def locked(
    path: Path, what: str, *, wait: bool, note: Callable[[str], None], check: Callable[[], None]
) -> Iterator[None]:
    """Hold the lock at `path`. The kernel drops it when the process dies, however it dies.

    Args:
        what: what is locked, for messages.
        wait: wait for the holder; else raise `Locked`.
        note: told once for whom we wait.
        check: called while waiting; may raise.
    """
    lock, told = FileLock(path), False
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        while not _acquired(lock):
            who = holder(path)
            if who is None:  # gone, or only looked at by `slomo status`
                continue
            if not wait:
                raise Locked(f"{what} is being made by {who}", todo="wait for it, or leave out --no-wait")
            if not told:
                note(f"waiting for {what}: {who} works on it")
                told = True
            check()
            time.sleep(0.1)
    try:
        replace_file(path.with_suffix(".json"), json_bytes({"pid": os.getpid(), "command": command_line()}))
        yield
    finally:
        lock.release()
