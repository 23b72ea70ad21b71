"""Runs of a signal that is either on or off."""

import numpy as np


def runs(on: np.ndarray) -> list[tuple[int, int]]:
    """(start, end) of the runs of True in (T,), end exclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
