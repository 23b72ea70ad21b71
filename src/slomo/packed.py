"""Masks as bits, eight pixels of a row in a byte."""

from collections.abc import Mapping

import numpy as np

Array = np.ndarray


def pack(masks: Array) -> dict[str, Array]:
    """(T, H, W) bool as `packed` bits and their `shape`."""
    return {"packed": np.packbits(masks, axis=-1), "shape": np.array(masks.shape)}


def unpack(arrays: Mapping[str, Array], frames: int | np.integer | slice = slice(None)) -> Array:
    """Inverse of `pack`: (T, H, W) bool, or (H, W) of one frame."""
    return np.unpackbits(arrays["packed"][frames], axis=-1)[..., : int(arrays["shape"][-1])].astype(bool)
