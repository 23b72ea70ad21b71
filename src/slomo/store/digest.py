"""Digests by content: the same numbers give the same key, wherever and whenever they were computed."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import InvalidData

_WALL_TIME = re.compile(r"(^|_)(seconds|ms)(_|$)|^missed_ticks$")


def plain(x: Any) -> Any:
    """`x` as JSON can hold it: NumPy scalars and arrays become numbers and lists; NaN and infinity become null."""
    if is_dataclass(x) and not isinstance(x, type):
        return plain(asdict(x))
    if isinstance(x, Mapping):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return plain(x.tolist())
    if isinstance(x, list | tuple | set | frozenset):
        return [plain(v) for v in (sorted(x) if isinstance(x, set | frozenset) else x)]
    if isinstance(x, float):
        return x if np.isfinite(x) else None
    if x is None or isinstance(x, bool | int | str):
        return x
    if isinstance(x, Path):
        return str(x)
    raise TypeError(f"{type(x).__name__} cannot be written as JSON")


def canonical(x: Any) -> bytes:
    """One byte string for each JSON value: sorted names, no spaces, UTF-8."""
    return json.dumps(plain(x), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def digest_json(x: Any) -> str:
    """SHA-256 (hex) of `canonical(x)`."""
    return hashlib.sha256(canonical(x)).hexdigest()


def without_wall_times(x: Any) -> Any:
    """`x` without the entries that measure the machine: names with the word `seconds` or `ms`, and `missed_ticks`."""
    if isinstance(x, Mapping):
        return {k: without_wall_times(v) for k, v in x.items() if not _WALL_TIME.search(k)}
    return [without_wall_times(v) for v in x] if isinstance(x, list) else x


def digest_array(name: str, x: np.ndarray) -> str:
    """SHA-256 (hex) of an array's name, dtype, shape and bytes (C order)."""
    x = np.asarray(x, order="C")
    if x.dtype.hasobject:
        raise TypeError(f"array {name!r} holds Python objects")
    h = hashlib.sha256(canonical([name, x.dtype.str, list(x.shape)]))
    h.update(x.reshape(-1).view(np.uint8).data if x.size and x.itemsize else b"")
    return h.hexdigest()


def digest_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 (hex) of a set of named arrays, whatever their order."""
    return digest_json({name: digest_array(name, x) for name, x in arrays.items()})


def digest_file(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def digest_input(path: Path, role: str) -> str:
    """SHA-256 (hex) of a user's file, or of a folder's relative names and files.

    Raises:
        InvalidData: there is no such file, or it cannot be read.
    """
    try:
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.is_file())
            return digest_json({p.relative_to(path).as_posix(): digest_file(p) for p in files})
        return digest_file(path)
    except FileNotFoundError:
        raise InvalidData("no such file or folder", where=path, todo=f"give an existing path ({role})") from None
    except OSError as e:
        raise InvalidData(f"cannot be read ({e.strerror})", where=path) from None
