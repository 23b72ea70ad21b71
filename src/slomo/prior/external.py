"""Any key-point network in ONNX form, told by a small TOML file how it is fed and what its numbers mean.

    [input]
    size = [192, 256]             # width and height, px
    layout = "nchw"               # or "nhwc"
    colour = "rgb"                # or "bgr"
    scale = 0.00392156862745098   # (pixel * scale - mean) / std; pixels are 0 to 255
    mean = [0.485, 0.456, 0.406]
    std = [0.229, 0.224, 0.225]

    [output]
    name = "output"               # default: the first
    type = "heatmaps"             # (1, K, h, w); or "coordinates", (1, K, 2 or 3) with confidence as the third
    units = "fraction"            # of coordinates: "fraction" of the input's size, or "pixel"
    order = "xy"                  # of coordinates: or "yx"

    [keypoints]                   # number in the model's output = node of the skeleton
    0 = "nose"
    9 = "left_wrist"

It sees the picture around the subject, background included.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slomo.errors import InvalidData, SlomoError
from slomo.prior.crop import Box, cut
from slomo.prior.inference import open_session, peaks
from slomo.settings import make

Array = np.ndarray

_CHOICES = {
    "layout": ("nchw", "nhwc"),
    "colour": ("rgb", "bgr"),
    "type": ("heatmaps", "coordinates"),
    "units": ("fraction", "pixel"),
    "order": ("xy", "yx"),
}
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64}
_TYPES |= {"tensor(uint8)": np.uint8, "tensor(int32)": np.int32, "tensor(int64)": np.int64}


@dataclass(frozen=True)
class Feed:
    """[input]: `size` width and height px; a value is (pixel * scale - mean) / std."""

    size: tuple[int, int] = (256, 256)
    layout: str = "nchw"
    colour: str = "rgb"
    scale: float = 1 / 255
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Meaning:
    """[output]: which one (default the first), and what its numbers are."""

    name: str = ""
    type: str = "heatmaps"
    units: str = "fraction"
    order: str = "xy"


@dataclass(frozen=True)
class KeypointMap:
    """A mapping file. `index` (n,) numbers in the model's output, `names` the nodes that they are."""

    feed: Feed
    meaning: Meaning
    index: Array
    names: tuple[str, ...]


def load_map(path: Path, nodes: Sequence[str]) -> KeypointMap:
    """Read a mapping file; `nodes` are the skeleton's.

    Raises:
        InvalidData: cannot be read, no TOML, an unknown entry, choice or node, or a node that is named twice.
    """
    try:
        tables = tomllib.loads(Path(path).read_text())
    except OSError as e:
        raise InvalidData(f"cannot be read ({e.strerror})", where=path) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InvalidData(f"is not TOML ({e})", where=path) from None
    for section in tables:
        if section not in ("input", "output", "keypoints"):
            raise InvalidData(f"no section {section!r}", where=path, valid=("input", "output", "keypoints"))
    try:
        feed = make(Feed, tables.get("input", {}), where=f"{path} [input]")
        meaning = make(Meaning, tables.get("output", {}), where=f"{path} [output]")
    except SlomoError as e:  # there it is an option of slomo's that is wrong, here it is a file
        raise InvalidData(e.what, where=e.where, valid=e.valid, todo=e.todo) from None
    for name, value in (vars(feed) | vars(meaning)).items():
        if name in _CHOICES and value not in _CHOICES[name]:
            raise InvalidData(f"{name} = {value!r}", where=path, valid=_CHOICES[name])
    if min(feed.size) < 8 or 0 in feed.std:
        raise InvalidData("size must be 8 px and more, std not 0", where=f"{path} [input]")
    entries = tables.get("keypoints", {})
    for key, name in entries.items():
        if not key.isdecimal():
            raise InvalidData(f"{key!r} is no number", where=f"{path} [keypoints]", todo='write 0 = "nose"')
        if name not in nodes:
            raise InvalidData(f"no node {name!r}", where=f"{path} [keypoints]", valid=nodes)
        if list(entries.values()).count(name) > 1:
            raise InvalidData(f"names {name!r} twice", where=f"{path} [keypoints]")
    if not entries:
        raise InvalidData("names no key points", where=path, todo='add [keypoints] with lines like 0 = "nose"')
    return KeypointMap(feed, meaning, np.array([int(k) for k in entries]), tuple(entries.values()))


class ExternalModel:
    """A network and its mapping. Raises `InvalidData` when it cannot be loaded or has not that output."""

    def __init__(self, path: Path, mapping: KeypointMap, *, threads: int = 1):
        self.path, self.mapping = path, mapping
        self._session = open_session(path, threads=threads)
        given = self._session.get_inputs()
        outputs = [o.name for o in self._session.get_outputs()]
        if len(given) != 1 or given[0].type not in _TYPES:
            raise InvalidData("must have one input of numbers", where=path, valid=_TYPES)
        if mapping.meaning.name and mapping.meaning.name not in outputs:
            raise InvalidData(f"no output {mapping.meaning.name!r}", where=path, valid=outputs)
        self._input, self._dtype = given[0].name, _TYPES[given[0].type]
        self._output = mapping.meaning.name or outputs[0]

    def __call__(self, rgb: Array, box: Box) -> tuple[Array, Array]:
        """Key points of one picture (H, W, 3) uint8: (n, 2) px of it, (n,) confidence in [0, 1].

        Raises:
            InvalidData: the network does not take the input or gives another form than the mapping says.
        """
        feed = self.mapping.feed
        w, h = feed.size
        # The picture's part of the input's shape that just holds the square box.
        px = min(w, h) / box.side
        longest = max(w, h)
        side = longest / px
        square = Box(box.x0 + (box.side - side) / 2, box.y0 + (box.side - side) / 2, side)
        top, left = (longest - h) // 2, (longest - w) // 2
        x = cut(rgb, square, longest)[top : top + h, left : left + w].astype(np.float32)
        x = x[..., ::-1] if feed.colour == "bgr" else x
        x = ((x * feed.scale - feed.mean) / feed.std)[None].astype(self._dtype)
        x = np.ascontiguousarray(x.transpose(0, 3, 1, 2)) if feed.layout == "nchw" else x
        try:
            out = np.asarray(self._session.run([self._output], {self._input: x})[0], np.float32)
        except Exception as e:  # onnxruntime's own exceptions derive from Exception only
            what = f"does not take an input of {x.shape} ({e})"
            raise InvalidData(what, where=self.path, todo="look at size and layout of the mapping") from None
        uv, confidence = self._read(out)
        return (uv + [left, top] + 0.5) / px + [square.x0, square.y0] - 0.5, confidence

    def _read(self, out: Array) -> tuple[Array, Array]:
        """(n, 2) px of the input and (n,) confidence."""
        index, meaning, size = self.mapping.index, self.mapping.meaning, np.array(self.mapping.feed.size)
        heat = meaning.type == "heatmaps"
        if heat and out.ndim == 4:
            points = out[0]
        elif not heat and out.ndim >= 2 and out.shape[-1] in (2, 3):
            points = out.reshape(-1, out.shape[-1])
        else:
            raise InvalidData(f"output {self._output!r} is {out.shape}, no {meaning.type}", where=self.path)
        if index.max() >= len(points):
            raise InvalidData(f"has {len(points)} key points, the mapping names {index.max()}", where=self.path)
        points = np.nan_to_num(points[index])
        if heat:
            cells, _ = peaks(np.maximum(points, 0) + 1e-9, points.shape[-1])
            uv = (cells + 0.5) * (size / points.shape[:0:-1]) - 0.5
            return uv, np.clip(points.max((1, 2)), 0, 1)
        uv = points[:, 1::-1] if meaning.order == "yx" else points[:, :2]
        uv = uv * size - 0.5 if meaning.units == "fraction" else uv
        confidence = np.clip(points[:, 2], 0, 1) if points.shape[-1] == 3 else np.ones(len(points))
        return uv, confidence
