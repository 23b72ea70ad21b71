"""How this package's inner loops are compiled: LLVM through Numba, once, then from a cache on disk.

Array-to-array assignments (`a[:] = b`) and NumPy functions are left out of compiled code: each one compiles Numba's
broadcasting with its error messages, which triples the time of the first run.
"""

from functools import partial

from numba import njit

compiled = partial(njit, cache=True, error_model="numpy", no_cfunc_wrapper=True)
