"""glTF 2.0 in one binary file (GLB): a coloured mesh, still or moved by its skeleton.

Written to the Khronos Group's specification glTF 2.0 (ISO/IEC 12113:2022); section numbers below are its own. glTF is
y-up and its colours are linear: the node above everything turns slomo's z-up world (x, y, z) to (x, z, -y), and sRGB is
made linear. Everything else is as in slomo: metres, seconds (from the first pose), counter-clockwise faces.
"""

import json
import struct
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import slomo
from slomo.mesh import SkinnedMesh, heaviest, vertex_normals

Array = np.ndarray

INFLUENCES = 4  # links that move one vertex: what one set of JOINTS_0 and WEIGHTS_0 holds (3.7.3.3)
Z_UP_TO_Y_UP = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # xyzw: a quarter turn about x
_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_ATTRIBUTES, _INDICES = 34962, 34963  # targets of buffer views (5.11.5)


class _Buffer:
    """The binary chunk, with the accessors and buffer views that say what is where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, x: Array, kind: str, *, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """The accessor of an array (n, ...) stored as `kind` ("f4", "u1", ...), tightly packed in a view of its own.

        Args:
            bounds: give its least and greatest elements, as positions and times must (3.7.2.1, 3.11).
        """
        x = np.ascontiguousarray(x, f"<{kind}")
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": x.nbytes}
        accessor: dict[str, Any] = {
            "bufferView": len(self.views), "componentType": _COMPONENTS[kind], "count": len(x),
            "type": _SHAPES[x.shape[1:]],
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {name: np.atleast_1d(f(x, axis=0)).tolist() for name, f in (("min", np.min), ("max", np.max))}
        self.data += x.tobytes() + bytes(-x.nbytes % 4)
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def encode_glb(vertices: Array, faces: Array, colours: Array) -> bytes:
    """A still mesh. Args: vertices (V, 3) m, z up; faces (F, 3); colours (V, 3) sRGB in [0, 1]."""
    buffer = _Buffer()
    nodes = [_turned([1]), {"name": "body", "mesh": 0}]
    return _file(buffer, {"nodes": nodes, "scenes": [{"nodes": [0]}]} | _mesh(buffer, vertices, faces, colours))


def encode_animated_glb(mesh: SkinnedMesh) -> bytes:
    """A mesh skinned to a node a link, and one animation of the links, interpolated linearly between its times.

    The four heaviest weights of each vertex are kept. The nodes themselves stand in the first pose.
    """
    buffer = _Buffer()
    links, weights = heaviest(mesh.weights, INFLUENCES)
    joints = {
        "JOINTS_0": buffer.add(links, "u1" if len(mesh.link_names) <= 256 else "u2", target=_ATTRIBUTES),
        "WEIGHTS_0": buffer.add(weights, "f4", target=_ATTRIBUTES),
    }
    parts = _mesh(buffer, mesh.vertices, mesh.faces, mesh.colours, joints)
    move, turn = _local(mesh)
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": move[0, j].tolist(), "rotation": turn[0, j].tolist()}
        for j, name in enumerate(mesh.link_names)
    ]
    for j, parent in enumerate(mesh.link_parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(j)
    B = len(nodes)
    # A skinned mesh stands where its joints are; a transform of its own node would be ignored (3.7.3.3).
    nodes += [_turned([j for j in range(B) if mesh.link_parents[j] < 0]), {"name": "body", "mesh": 0, "skin": 0}]
    inverse = np.swapaxes(np.linalg.inv(mesh.rest), 1, 2)  # stored by columns (3.6.2.2)
    inverse[:, :, 3] = [0, 0, 0, 1]
    skin = {"joints": list(range(B)), "skeleton": B, "inverseBindMatrices": buffer.add(inverse, "f4")}
    time = buffer.add(mesh.t - mesh.t[0], "f4", bounds=True)
    samplers, channels = [], []
    for j in range(B):
        for path, values in (("translation", move[:, j]), ("rotation", turn[:, j])):
            channels.append({"sampler": len(samplers), "target": {"node": j, "path": path}})
            samplers.append({"input": time, "output": buffer.add(values, "f4"), "interpolation": "LINEAR"})
    animation = {"name": "motion", "samplers": samplers, "channels": channels}
    scene = {"nodes": nodes, "scenes": [{"nodes": [B, B + 1]}], "skins": [skin], "animations": [animation]}
    return _file(buffer, scene | parts)


def _turned(children: list[int]) -> dict[str, Any]:
    return {"name": "z_up", "rotation": list(Z_UP_TO_Y_UP), "children": children}


def _local(mesh: SkinnedMesh) -> tuple[Array, Array]:
    """Translations (T, B, 3) m and unit quaternions xyzw (T, B, 4) of the links in their parents.

    q and -q are the same rotation, but what is interpolated between them is not: signs go on from pose to pose.
    """
    T = mesh.T_world_link.copy()
    child = np.flatnonzero(mesh.link_parents >= 0)
    T[:, child] = np.linalg.inv(mesh.T_world_link[:, mesh.link_parents[child]]) @ mesh.T_world_link[:, child]
    quat_xyzw = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*T.shape[:2], 4)
    flips = np.where((quat_xyzw[1:] * quat_xyzw[:-1]).sum(-1) < 0, -1.0, 1.0)
    quat_xyzw[1:] *= np.cumprod(flips, axis=0)[..., None]
    return T[..., :3, 3], quat_xyzw


def _mesh(
    buffer: _Buffer, vertices: Array, faces: Array, colours: Array, more: dict[str, int] | None = None
) -> dict[str, Any]:
    """The entries `meshes` and `materials` of one coloured mesh."""
    attributes = {
        "POSITION": buffer.add(vertices, "f4", target=_ATTRIBUTES, bounds=True),
        "NORMAL": buffer.add(vertex_normals(np.asarray(vertices, float), faces), "f4", target=_ATTRIBUTES),
        "COLOR_0": buffer.add(_linear_rgba(colours), "u2", target=_ATTRIBUTES, normalized=True),
    }
    primitive = {
        "attributes": attributes | (more or {}),
        "indices": buffer.add(np.asarray(faces).reshape(-1), "u4", target=_INDICES),
        "material": 0,
    }
    coat = {"name": "coat", "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.9}}
    return {"meshes": [{"name": "body", "primitives": [primitive]}], "materials": [coat]}


def _linear_rgba(colours: Array) -> Array:
    """(V, 4) uint16, linear (IEC 61966-2-1) and opaque, of sRGB colours (V, 3). Four, for elements start at fours."""
    c = np.clip(np.asarray(colours, float), 0, 1)
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.round(np.pad(linear, ((0, 0), (0, 1)), constant_values=1) * 65535).astype(np.uint16)


def _file(buffer: _Buffer, scene: dict[str, Any]) -> bytes:
    """Header, JSON chunk and binary chunk (4.4)."""
    gltf = {
        "asset": {"version": "2.0", "generator": f"slomo {slomo.__version__}"}, "scene": 0, **scene,
        "accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": len(buffer.data)}],
    }  # fmt: skip
    text = json.dumps(gltf, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer.data), b"BIN\0") + bytes(buffer.data)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
