"""How this package's inner loops are compiled: LLVM through Numba, once (half a minute), then from a cache on disk.

Array-to-array assignments (`a[:] = b`) and NumPy functions are left out of compiled code: each one compiles Numba's
broadcasting with its error messages. Numba renews a cached function when its own file changes, not when a function
that it calls does: after editing a file here, remove `__pycache__`.
"""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any]) -> Any:
    """Decorator: compile without the Python interpreter, cached."""
    return njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function)  # pyright: ignore[reportCallIssue]
