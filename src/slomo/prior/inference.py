"""The trained networks through onnxruntime: probabilities of crops.

Each crop is looked at as it is and mirrored, and the two answers are averaged: left and right are alike to the network
then, and what it is unsure of varies less from frame to frame.
"""

import hashlib
import json
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path

import numpy as np

from slomo.errors import InvalidData
from slomo.prior.labels import Labels, mirror_of

Array = np.ndarray

OUTPUTS = ("parts", "surface", "heatmaps", "seen", "view", "up")
METADATA = "slomo"  # the entry of the file's metadata_props
BATCH = 16  # crops at a time
_PEAK = 2  # cells of a heat map around its maximum that belong to the peak
_STEPS = np.arange(-_PEAK, _PEAK + 1)


@dataclass(frozen=True)
class Prediction:
    """What the network says of F crops of S x S, each by itself.

    Attributes:
        size: S, px.
        parts: (F, P+1, S/2, S/2) probabilities, background first.
        surface: (F, 3, S/2, S/2) canonical coordinates; surface_scale: (F, S/2, S/2) Laplace b; body lengths.
        heat: (F, K, S/4, S/4) probability of the place of each key point.
        seen: (F, K) probability that it is visible.
        view: (F, 36) probability of the azimuth's bins.  up: (F, 3) unit vectors, view frame.
    """

    size: int
    parts: Array
    surface: Array
    surface_scale: Array
    heat: Array
    seen: Array
    view: Array
    up: Array


def packaged_folder() -> Path:
    """Where the weights are that come with slomo."""
    return Path(str(resources.files("slomo"))) / "prior" / "weights"


def packaged(kind: str) -> Path | None:
    """The weights that come with slomo for a kind of skeleton, if there are any."""
    path = packaged_folder() / f"{kind}.onnx"
    return path if path.is_file() else None


def open_session(path: Path, *, threads: int = 1):
    """An onnxruntime session on the CPU. Raises `InvalidData` when the file is no network."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), sess_options=options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions derive from Exception only
        what = f"not a network that can be loaded ({error})"
        raise InvalidData(what, where=path, todo="give an .onnx file") from None


class Prior:
    """The network of one kind of body, as `slomo train-prior` exports it.

    Raises:
        InvalidData: the file is no network, or none of slomo's.
    """

    def __init__(self, path: Path, *, threads: int = 1):
        self.path = path
        self._session = open_session(path, threads=threads)
        self.digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA)
        names = [o.name for o in self._session.get_outputs()]
        lacking = [name for name in OUTPUTS if name not in names]
        if text is None or lacking:
            raise InvalidData(
                f"is not a network of slomo's ({'lacks ' + ', '.join(lacking) if lacking else 'no metadata'})",
                where=path,
                todo="train one, or give another model of key points with --keypoint-model",
            )
        try:
            about = json.loads(text)
            self.kind, self.size = str(about["kind"]), int(about["size"])
            self.keypoints, self.parts = tuple(about["keypoints"]), tuple(about["parts"])
            given = about.get("temperature", {})
            self.temperature = {name: float(given.get(name, 1.0)) for name in OUTPUTS}
        except (ValueError, KeyError, TypeError, AttributeError) as e:
            raise InvalidData(f"its metadata is incomplete ({e})", where=path) from None

    def misfit(self, labels: Labels) -> str:
        """Why the network does not speak about this skeleton; empty if it does."""
        if self.kind != labels.kind:
            return f"was trained for {self.kind!r}, the skeleton is {labels.kind!r}"
        pairs = (("key points", self.keypoints, labels.keypoints), ("parts", self.parts, labels.parts))
        for what, mine, wanted in pairs:
            if mine != wanted:
                other = sorted({*mine} ^ {*wanted}) or ["their order"]
                return f"its {what} are not the skeleton's: {', '.join(other)}"
        return ""

    def __call__(self, crops: Array) -> Prediction:
        """What is seen in crops (F, 6, S, S) float32, made by `crop.network_input`."""
        return _mean(self._look(crops), self._mirrored(self._look(mirrored_crops(crops))))

    def _mirrored(self, p: Prediction) -> Prediction:
        """What is said of a mirrored crop, said of the crop."""
        points, parts = mirror_of(self.keypoints), np.concatenate([[0], 1 + mirror_of(self.parts)])
        return Prediction(
            size=p.size,
            parts=p.parts[:, parts, :, ::-1],
            surface=p.surface[..., ::-1] * np.array([1, -1, 1], np.float32)[:, None, None],
            surface_scale=p.surface_scale[..., ::-1],
            heat=p.heat[:, points, :, ::-1],
            seen=p.seen[:, points],
            view=np.roll(p.view[:, ::-1], 1, axis=1),  # bin k is at k steps of azimuth, its mirror image at -k
            up=p.up * np.array([-1, 1, 1], np.float32),
        )

    def _look(self, crops: Array) -> Prediction:
        runs = [
            dict(zip(OUTPUTS, self._session.run(OUTPUTS, {self._input: crops[i : i + BATCH]}), strict=True))
            for i in range(0, len(crops), BATCH)
        ]
        raw = {name: np.concatenate([np.asarray(run[name], np.float32) for run in runs]) for name in OUTPUTS}
        hot = {name: raw[name] / self.temperature[name] for name in ("parts", "heatmaps", "seen", "view")}
        heat = hot["heatmaps"]
        return Prediction(
            size=crops.shape[-1],
            parts=softmax(hot["parts"], 1),
            surface=raw["surface"][:, :3],
            surface_scale=np.exp(np.clip(raw["surface"][:, 3], -6, 3)) * self.temperature["surface"],
            heat=softmax(heat.reshape(*heat.shape[:2], -1), 2).reshape(heat.shape),
            seen=1 / (1 + np.exp(-np.clip(hot["seen"], -30, 30))),
            view=softmax(hot["view"], 1),
            up=raw["up"] / np.maximum(np.linalg.norm(raw["up"], axis=-1, keepdims=True), 1e-6),
        )

    @property
    def _input(self) -> str:
        return self._session.get_inputs()[0].name


def mirrored_crops(crops: Array) -> Array:
    """Crops (F, 6, S, S) with left and right exchanged: motion along x changes its sign."""
    out = crops[..., ::-1].copy()
    out[:, 4] *= -1
    return out


def _mean(a: Prediction, b: Prediction) -> Prediction:
    mean = {f.name: (getattr(a, f.name) + getattr(b, f.name)) / 2 for f in fields(Prediction) if f.name != "size"}
    mean["up"] /= np.maximum(np.linalg.norm(mean["up"], axis=-1, keepdims=True), 1e-6)
    return Prediction(size=a.size, **mean)


def softmax(x: Array, axis: int) -> Array:
    """exp(x) over its sum along an axis."""
    e = np.exp(x - x.max(axis, keepdims=True))
    return e / e.sum(axis, keepdims=True)


def peaks(heat: Array, size: int) -> tuple[Array, Array]:
    """Where heat maps (..., h, w) have their maximum, to fractions of a cell, and how much lies there.

    Returns:
        (..., 2) px of a crop of `size`; (...) probability within the 5 x 5 cells around the maximum.
    """
    h, w = heat.shape[-2:]
    row, column = np.divmod(heat.reshape(-1, h * w).argmax(1), w)
    around = _around(heat, row, column)
    mass = around.sum((1, 2))
    sharp = around**2  # a second, lower peak beside it hardly draws then
    sharp /= np.maximum(sharp.sum((1, 2), keepdims=True), 1e-30)
    v, u = row + sharp.sum(2) @ _STEPS, column + sharp.sum(1) @ _STEPS
    places = (np.stack([u, v], -1) + 0.5) * (size / w) - 0.5
    return places.reshape(*heat.shape[:-2], 2), mass.reshape(heat.shape[:-2])


def mass_at(heat: Array, places: Array, size: int) -> Array:
    """(...) probability that heat maps (..., h, w) give to the 5 x 5 cells around places (..., 2) px of the crop."""
    h, w = heat.shape[-2:]
    cell = np.rint((places.reshape(-1, 2) + 0.5) * (w / size) - 0.5).astype(int)
    around = _around(heat, np.clip(cell[:, 1], 0, h - 1), np.clip(cell[:, 0], 0, w - 1))
    return around.sum((1, 2)).reshape(heat.shape[:-2])


def _around(heat: Array, row: Array, column: Array) -> Array:
    """(n, 5, 5) cells of n heat maps around a place of each, zero outside."""
    flat = np.pad(heat.reshape(-1, *heat.shape[-2:]), ((0, 0), (_PEAK, _PEAK), (_PEAK, _PEAK)))
    rows, columns = row[:, None] + _STEPS + _PEAK, column[:, None] + _STEPS + _PEAK
    return flat[np.arange(len(flat))[:, None, None], rows[:, :, None], columns[:, None, :]]
