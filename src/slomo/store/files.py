"""Writing files so that they are whole or absent, and bit-equal for equal content."""

import contextlib
import errno
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from slomo.errors import SlomoError
from slomo.store.digest import plain


@contextlib.contextmanager
def writing(path: Path, *, folder: str = "project folder with --project") -> Iterator[None]:
    """Turn the system's refusal to write (read-only, full, no permission) into one line.

    Args:
        folder: what the user can give instead of a folder that cannot be written.
    """
    try:
        yield
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            todo = "free some space (`slomo gc`) and run the same command again"
        else:
            todo = f"give another {folder}, or make this one writable"
        raise SlomoError(f"cannot write ({e.strerror or e})", where=e.filename or path, todo=todo) from e


def check_writable(folder: Path, *, named: str) -> None:
    """See that files can be made in a folder, which need not exist yet, before long work goes there.

    Args:
        named: the argument or option that names it.

    Raises:
        SlomoError: they cannot.
    """
    with writing(folder, folder=named):
        there = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.exists())
        try:
            with tempfile.TemporaryFile(dir=there):
                pass
        except OSError as e:
            raise OSError(e.errno, e.strerror, str(folder)) from None  # its name, not that of the file for the test


def fsync_folder(folder: Path) -> None:
    """Make renames in `folder` durable."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def write_file(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a new file and fsync it. Every byte of the store goes through here."""
    with open(path, "wb") as f:
        write(f)
        f.flush()
        os.fsync(f.fileno())


def replace_file(path: Path, data: bytes) -> None:
    """Give `path` a new content atomically: tmp, fsync, rename."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        tmp = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            write_file(tmp, lambda f: f.write(data))
            os.replace(tmp, path)
        except BaseException:
            tmp.unlink(missing_ok=True)
            raise
        fsync_folder(path.parent)


def json_bytes(x: Any) -> bytes:
    """`x` as readable JSON."""
    return (json.dumps(plain(x), indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in `path`, or None where there is no whole one."""
    try:
        data = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def write_npz(f: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """An uncompressed `.npz` whose bytes depend on the arrays alone: fixed time stamps, sorted names, C order."""
    with zipfile.ZipFile(f, "w", zipfile.ZIP_STORED) as z:
        for name in sorted(arrays):
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.create_system, info.external_attr = 3, 0o644 << 16
            with z.open(info, "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(arrays[name], order="C"), allow_pickle=False)


def remove(path: Path) -> None:
    """Remove a file or folder, if it is there."""
    with writing(path):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def size_of(path: Path) -> int:
    """Bytes in a file or folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
