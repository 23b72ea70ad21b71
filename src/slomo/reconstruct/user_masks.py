"""Segmenter that takes the masks which the user made."""

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slomo.errors import InvalidData
from slomo.formats import npz
from slomo.packed import unpack
from slomo.reconstruct.flow import Flow
from slomo.reconstruct.segment import Masks, Report, no_subject

_EXACT = (".png", ".bmp", ".tif", ".tiff")
_LOSSY = (".jpg", ".jpeg", ".webp")  # around the subject such a picture rings, so that little is nothing


@dataclass(frozen=True)
class UserMasks:
    """A folder of pictures, one a frame in the order of their names (2 before 10), of any size, or an npz with `packed`
    (T, H, ceil(W/8)) as of `np.packbits` and `shape` (T, H, W). A folder that holds one npz counts as it.

    The subject is what is not zero, in pictures that are compressed with loss what is more than half of the range.
    """

    path: Path
    name: str = "user"

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        path = Path(self.path)
        if path.is_dir():
            archives = [f for f in path.iterdir() if f.suffix.lower() == ".npz"]
            if len(archives) == 1:
                masks = _from_archive(archives[0])
            else:
                pictures = [f for f in path.iterdir() if f.suffix.lower() in (*_EXACT, *_LOSSY)]
                masks = [_from_picture(f) for f in sorted(pictures, key=_natural)]
        else:
            masks = _from_archive(path)
        if len(masks) != len(frames):
            raise InvalidData(
                f"holds {len(masks)} masks, the decoded clip has {len(frames)} frames",
                where=path,
                todo="give one mask for each decoded frame (see start, duration and fps of decode)",
            )
        height, width = frames.shape[1:3]
        out = np.zeros(frames.shape[:3], bool)
        for i, mask in enumerate(masks):
            given = mask.shape[1] / mask.shape[0]
            if abs(given / (width / height) - 1.0) > 0.03:
                raise InvalidData(
                    f"mask {i} is {mask.shape[1]}x{mask.shape[0]}, the frames are {width}x{height}",
                    where=path,
                    todo="give masks with the frames' proportions",
                )
            how = cv2.INTER_AREA if mask.shape[1] > width else cv2.INTER_LINEAR  # areas make steps where they enlarge
            out[i] = cv2.resize(mask.astype(np.float32), (width, height), interpolation=how) > 0.5
            progress((i + 1) / len(masks))
        if not out.any():
            raise no_subject(f"all masks in {path} are empty")
        return Masks(out)


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Key that sorts names by the numbers in them."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _from_archive(path: Path) -> np.ndarray:
    arrays = npz.load(path)
    try:
        shape = tuple(int(n) for n in arrays["shape"])
        masks = unpack(arrays)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InvalidData(
            f"cannot be read as masks ({error})", where=path, todo="give an npz with arrays packed and shape"
        ) from None
    if masks.shape != shape:
        raise InvalidData(f"packed holds {masks.shape}, shape says {shape}", where=path)
    return masks


def _from_picture(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InvalidData("not a readable picture", where=path, todo="give masks as PNG")
    least = 127 if path.suffix.lower() in _LOSSY else 0
    if picture.ndim == 3 and picture.shape[2] == 4 and not picture[..., 3].all():
        return picture[..., 3] > least  # drawn on transparency
    return np.asarray((picture[..., :3] > least).any(-1) if picture.ndim == 3 else picture > least)
