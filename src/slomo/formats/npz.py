"""NumPy archives without pickle."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from slomo.errors import InvalidData


def load(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz file. Raises `InvalidData` when it is missing, truncated or holds Python objects."""
    try:
        with np.load(path, allow_pickle=False) as z:
            return {k: z[k] for k in z.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as e:
        raise InvalidData(f"is not a readable .npz archive ({e})", where=path, todo="make it again") from None
