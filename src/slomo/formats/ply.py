"""Binary PLY (little-endian) of one coloured mesh: float x, y, z in metres, uchar red, green, blue, triangles.

The format is that of Greg Turk's "The PLY Polygon File Format" (1994). The world is slomo's: z up.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray

_VERTEX = np.dtype([(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
_TYPES = {
    name: code
    for names, code in (
        (("char", "int8"), "i1"), (("uchar", "uint8"), "u1"), (("short", "int16"), "<i2"),
        (("ushort", "uint16"), "<u2"), (("int", "int32"), "<i4"), (("uint", "uint32"), "<u4"),
        (("float", "float32"), "<f4"), (("double", "float64"), "<f8"),
    )
    for name in names
}  # fmt: skip


class Ply(NamedTuple):
    """vertices (V, 3) float32 m; faces (F, 3) int32; colours (V, 3) in [0, 1], in steps of 1/255; comments."""

    vertices: Array
    faces: Array
    colours: Array
    comments: tuple[str, ...] = ()


def encode_ply(vertices: Array, faces: Array, colours: Array, *, comments: tuple[str, ...] = ()) -> bytes:
    """The bytes of a PLY file.

    Args:
        vertices: (V, 3) m.  faces: (F, 3) int.  colours: (V, 3) sRGB in [0, 1].
        comments: lines of the header.
    """
    v = np.empty(len(vertices), _VERTEX)
    for k, name in enumerate("xyz"):
        v[name] = vertices[:, k]
    rgb = np.clip(np.round(np.asarray(colours) * 255), 0, 255)
    for k, name in enumerate(("red", "green", "blue")):
        v[name] = rgb[:, k]
    f = np.empty(len(faces), _FACE)
    f["count"], f["vertices"] = 3, faces
    header = [
        "ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments),
        f"element vertex {len(v)}", *(f"property float {n}" for n in "xyz"),
        *(f"property uchar {n}" for n in ("red", "green", "blue")),
        f"element face {len(f)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return "\n".join(header).encode() + b"\n" + v.tobytes() + f.tobytes()


def read_ply(path: Path) -> Ply:
    """A binary little-endian PLY of triangles, by slomo or another program; grey where it has no colours.

    Vertices come first and may have further properties of one number each; faces have their corners only.

    Raises:
        InvalidData: unreadable, truncated, or not such a file; says what is in its place.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as e:
        raise InvalidData(e.strerror or "cannot be read", where=path) from None
    head, end, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    if not end or lines[:1] != ["ply"] or "format binary_little_endian 1.0" not in lines:
        raise InvalidData("is not a binary little-endian PLY file", where=path)
    comments = tuple(line.removeprefix("comment ") for line in lines if line.startswith("comment "))
    try:
        count, vertex, faces, face = _elements([line.split() for line in lines])
    except (ValueError, KeyError, IndexError) as e:
        raise InvalidData(f"has a header that is not of a mesh of triangles ({e})", where=path) from None
    if len(body) < count * vertex.itemsize + faces * face.itemsize:
        raise InvalidData("is truncated", where=path, todo="make it again")
    v = np.frombuffer(body, vertex, count)
    f = np.frombuffer(body, face, faces, count * vertex.itemsize)
    if np.any(f["count"] != 3):
        raise InvalidData("has faces that are no triangles", where=path)
    colours = [v[n] / 255 if n in (vertex.names or ()) else np.full(count, 0.5) for n in ("red", "green", "blue")]
    corners = f["vertices"].astype(np.int32)
    if faces and (corners.min() < 0 or corners.max() >= count):
        raise InvalidData("has a face that names a vertex beyond its last", where=path)
    return Ply(np.stack([v[n] for n in "xyz"], 1).astype(np.float32), corners, np.stack(colours, 1), comments)


def _elements(lines: list[list[str]]) -> tuple[int, np.dtype, int, np.dtype]:
    """Number and layout of the vertices and of the faces. Raises `ValueError`, `KeyError`, `IndexError`."""
    body = [w for w in lines if w and w[0] in ("element", "property")]
    (start, faces), *_ = [(i, int(w[2])) for i, w in enumerate(body) if w[:2] == ["element", "face"]]
    if body[0][:2] != ["element", "vertex"] or any(w[0] == "element" for w in body[1:start]):
        raise ValueError("vertices must come first, then faces")
    vertex = np.dtype([(w[2], _TYPES[w[1]]) for w in body[1:start]])
    if not set("xyz") <= set(vertex.names or ()):
        raise ValueError("vertices lack x, y, z")
    (word, kind, count, index, _), *more = body[start + 1 :]
    if (word, kind) != ("property", "list") or any(w[0] == "property" for w in more):
        raise ValueError("faces must have a list of corners and nothing else")
    return int(body[0][2]), vertex, faces, np.dtype([("count", _TYPES[count]), ("vertices", _TYPES[index], 3)])
