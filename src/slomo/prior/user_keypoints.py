"""The user's own 2-D key points: a JSON file in pixels of the clip, for as many or as few frames as there are.

    {"names": ["nose", "front_left_paw"],
     "frames": [{"frame": 0, "points": [[412.0, 80.5, 1.0], null]}, {"t": 0.5, "points": [[420, 82], [390, 300, 0.5]]}]}

`frame` counts the clip's frames from 0, `t` is seconds from its first; a point is [u, v], [u, v, confidence] or null.
Pixels are those of the upright picture as players show it, with (0, 0) at the centre of the upper left one.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray

_FORM = 'expected {"names": [...], "frames": [{"frame": 0, "points": [[u, v, confidence] or null, ...]}, ...]}'


@dataclass(frozen=True)
class UserKeypoints:
    """What the file says.

    Attributes:
        names: N names of nodes.
        frame: (n,) number in the clip, NaN where a time is given; t: (n,) s, NaN where a number is given.
        points: (n, N, 3) u, v px of the clip and confidence; confidence 0 where nothing is said.
    """

    names: tuple[str, ...]
    frame: Array
    t: Array
    points: Array


def load_user_keypoints(path: Path, nodes: Sequence[str]) -> UserKeypoints:
    """Read the file; `nodes` are the skeleton's.

    Raises:
        InvalidData: cannot be read, another form, an unknown or repeated name, or a number that is none.
    """
    try:
        data = json.loads(Path(path).read_text())
    except OSError as e:
        raise InvalidData(f"cannot be read ({e.strerror})", where=path) from None
    except ValueError as e:
        raise InvalidData(f"is not JSON ({e})", where=path, todo=_FORM) from None
    try:
        names = [str(n) for n in data["names"]]
        frames = list(data["frames"])
    except (KeyError, TypeError):
        raise InvalidData("has no names or frames", where=path, todo=_FORM) from None
    for name in names:
        if name not in nodes:
            raise InvalidData(f"no key point {name!r}", where=path, valid=nodes)
        if names.count(name) > 1:
            raise InvalidData(f"names {name!r} twice", where=path)
    points = np.zeros((len(frames), len(names), 3))
    when = np.full((2, len(frames)), np.nan)
    for i, entry in enumerate(frames):
        where = f"{path}, entry {i} of frames"
        try:
            given = entry["points"]
            key = "frame" if "frame" in entry else "t"
            when[0 if key == "frame" else 1, i] = float(entry[key])
            rows = [None if p is None else [float(x) for x in p] for p in given]
        except (KeyError, TypeError, ValueError):
            raise InvalidData("cannot be understood", where=where, todo=_FORM) from None
        if len(rows) != len(names):
            raise InvalidData(f"has {len(rows)} points for {len(names)} names", where=where)
        if not abs(np.nan_to_num(when[:, i]).sum()) < np.inf or np.isnan(when[:, i]).all():
            raise InvalidData(f"{key} is not a finite number", where=where)
        for j, row in enumerate(rows):
            if row is not None:
                points[i, j] = _point(row, names[j], where)
    return UserKeypoints(tuple(names), when[0], when[1], points)


def _point(row: list[float], name: str, where: str) -> list[float]:
    if len(row) not in (2, 3):
        raise InvalidData(f"{name} has {len(row)} numbers, not u, v and perhaps confidence", where=where)
    if not np.isfinite(row).all():
        raise InvalidData(f"{name} is not finite", where=where, todo="write null where a point is not known")
    if len(row) == 3 and not 0 <= row[2] <= 1:
        raise InvalidData(f"{name} has a confidence of {row[2]:g}", where=where, valid=["0 to 1"])
    return [*row, 1.0][:3]


def to_decoded(user: UserKeypoints, video: Mapping[str, Any], *, where: object) -> tuple[Array, Array]:
    """The same in decoded frames: (n,) their (fractional) numbers, (n, N, 2) px.

    Args:
        video: `video.json` of the decoded clip.

    Raises:
        InvalidData: points far outside the picture, or all of them within its first pixel.
    """
    size = np.array([video["source_width"] * video["pixel_aspect"], video["source_height"]])  # as players show it
    if round(video["rotation"] / 90) % 2:
        size = size[::-1]
    said = user.points[..., 2] > 0
    uv = user.points[..., :2]
    if said.any():
        if np.abs(uv[said] / size - 0.5).max() > 1.5:
            what = f"points lie far outside the picture ({size[0]:g} x {size[1]:g} px)"
            raise InvalidData(what, where=where, todo="give pixels of the original clip")
        if said.sum() > 1 and np.abs(uv[said]).max() <= 1:
            raise InvalidData("all points lie in the first pixel", where=where, todo="give pixels, not fractions")
    scale = np.array([video["width"], video["height"]]) / size
    t = np.where(np.isnan(user.t), user.frame / max(float(video["source_fps"]), 1e-9), user.t)
    return (t - float(video["start_s"])) * float(video["fps"]), (uv + 0.5) * scale - 0.5
