"""A coloured mesh that a skeleton's links move: the shape of the body and its motion in one record."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray


@dataclass(frozen=True)
class SkinnedMesh:
    """V vertices, F triangles, B links, T times.

    Attributes:
        vertices: (V, 3) m, canonical frame: x forward, y left, z up.  faces: (F, 3), counter-clockwise from outside.
        colours: (V, 3) sRGB in [0, 1].
        weights: (V, B) of the links, rows sum to 1.
        link_names: B names.  link_parents: (B,) number of the parent, before its children; -1 for a root.
        rest: (B, 4, 4) link to canonical in the pose in which the vertices are given.
        T_world_link: (T, B, 4, 4) link to world, z up.  t: (T,) s from the first video frame.

    Raises:
        InvalidData: shapes disagree, a number is not finite, or a value is none of what is written here.
    """

    vertices: Array
    faces: Array
    colours: Array
    weights: Array
    link_names: tuple[str, ...]
    link_parents: Array
    rest: Array
    T_world_link: Array
    t: Array

    def __post_init__(self):
        V, B, T = len(self.vertices), len(self.link_names), len(self.t)
        shapes = dict(
            vertices=(V, 3), faces=(len(self.faces), 3), colours=(V, 3), weights=(V, B), link_parents=(B,),
            rest=(B, 4, 4), T_world_link=(T, B, 4, 4), t=(T,),
        )  # fmt: skip
        for name, shape in shapes.items():
            x = getattr(self, name)
            if x.shape != shape:
                raise InvalidData(f"has shape {x.shape}, expected {shape}", where=name)
            _require(name, bool(np.isfinite(x).all()), "holds a number that is not finite")
        _require("faces", len(self.faces) > 0, "is empty")
        _require("faces", self.faces.min() >= 0 and self.faces.max() < V, f"names vertices beyond the {V} there are")
        _require("weights", np.allclose(self.weights.sum(1), 1, atol=1e-3), "rows do not sum to 1")
        _require("link_parents", bool(np.all(self.link_parents < np.arange(B))), "has a parent after its child")
        _require("t", bool(T > 0 and np.all(np.diff(self.t) > 0)), "is empty or not strictly increasing")
        for name in ("rest", "T_world_link"):
            R = getattr(self, name)[..., :3, :3]
            _require(name, np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-3), "is not rigid")

    def posed(self, frame: int) -> Array:
        """(V, 3) m in the world at `t[frame]`: linear blend skinning, sum over links of w T_world_link rest^-1 x."""
        move = (self.T_world_link[frame] @ np.linalg.inv(self.rest))[:, :3]
        M = (self.weights @ move.reshape(-1, 12)).reshape(-1, 3, 4)
        return (M[..., :3] @ self.vertices[..., None])[..., 0] + M[..., 3]

    def every(self, n: int) -> Self:
        """The same body at every n-th time."""
        return replace(self, t=self.t[::n], T_world_link=self.T_world_link[::n])

    def to_arrays(self) -> dict[str, Array]:
        """The arrays of `mesh.npz`: numbers as float32 (`t` float64), numbers of vertices and links as int32."""
        kinds = {f.name: np.float32 for f in fields(self)} | {"faces": np.int32, "link_parents": np.int32, "t": float}
        names = {"link_names": np.array(self.link_names)}
        return {k: np.asarray(getattr(self, k), kind) for k, kind in kinds.items() if k not in names} | names

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Self:
        """From the arrays of `mesh.npz`; without `link_parents` every link is a root. Raises `InvalidData`."""
        missing = {f.name for f in fields(cls)} - {"link_parents"} - arrays.keys()
        if missing:
            raise InvalidData(f"lacks {', '.join(sorted(missing))}", where="mesh.npz")
        names = tuple(str(n) for n in arrays["link_names"])
        parents = np.asarray(arrays.get("link_parents", np.full(len(names), -1)), int)
        real = ("vertices", "colours", "weights", "rest", "T_world_link", "t")
        numbers = {k: np.asarray(arrays[k], float) for k in real}
        return cls(**numbers, faces=np.asarray(arrays["faces"], np.int32), link_names=names, link_parents=parents)


def _require(name: str, holds: bool | np.bool_, what: str) -> None:
    if not holds:
        raise InvalidData(what, where=name)


def heaviest(weights: Array, count: int) -> tuple[Array, Array]:
    """Links (V, count) and weights (V, count) of the `count` largest of weights (V, B), heaviest first, summing to 1.

    Where fewer links carry a vertex the rest is link 0 with weight 0.
    """
    padded = np.pad(weights, ((0, 0), (0, max(0, count - weights.shape[1]))))
    links = np.argsort(-padded, axis=1, kind="stable")[:, :count]
    w = np.take_along_axis(padded, links, 1)
    w = np.where(w > 1e-4 * w[:, :1], w, 0)
    return np.where(w > 0, links, 0), w / w.sum(1, keepdims=True)


def vertex_normals(vertices: Array, faces: Array) -> Array:
    """(V, 3) area-weighted vertex normals, unit length; up where faces cancel or there are none."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    each = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    out = np.stack([np.bincount(faces.ravel(), each[:, k], len(vertices)) for k in range(3)], 1)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-20, out / np.maximum(length, 1e-20), [0.0, 0.0, 1.0])
