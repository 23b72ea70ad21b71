"""How this package's inner loops are compiled: LLVM through Numba, once (half a minute), then from a cache on disk.

Array-to-array assignments (`a[:] = b`) and NumPy functions are left out of compiled code: each one compiles Numba's
broadcasting with its error messages. Numba renews a cached function when its own file changes, not when a function
that it calls does; so the cache's folder is named after the sources of all compiled code.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit


def _cache_folder() -> str:
    """The user's cache folder for these sources; "" (beside the sources) where there is no home."""
    digest = hashlib.sha256()
    here = Path(__file__).parent
    track = here.parent / "track"
    for path in (*sorted(here.glob("*.py")), track / "plan.py", track / "inekf.py"):
        digest.update(path.read_bytes())
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return ""
    return str(base / "slomo" / f"compiled-{digest.hexdigest()[:12]}")


if not numba.config.CACHE_DIR:  # pyright: ignore[reportAttributeAccessIssue]
    numba.config.CACHE_DIR = _cache_folder()  # pyright: ignore[reportAttributeAccessIssue]


def compiled(function: Callable[..., Any]) -> Any:
    """Decorator: compile without the Python interpreter, cached."""
    return njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function)  # pyright: ignore[reportCallIssue]
