"""Mesh files: PLY and GLB read back, by our own eyes and by trimesh's."""

import json
import struct
from io import BytesIO

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.formats.gltf import encode_animated_glb, encode_glb
from slomo.formats.ply import encode_ply, read_ply
from slomo.mesh import SkinnedMesh, heaviest, vertex_normals

Array = np.ndarray
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # what a z-up point is in a y-up world


def tube(T: int = 7, *, chain: bool = True, spread: int = 3) -> SkinnedMesh:
    """A tube along x with three links that walks, turns twice around z and bends."""
    cylinder = trimesh.creation.cylinder(radius=0.1, height=1.2, sections=12).subdivide()
    x = np.asarray(cylinder.vertices)[:, [2, 0, 1]] + [0.6, 0, 0]
    near = -np.abs(x[:, :1] - [0.2, 0.6, 1.0]) / 0.1
    links, w = heaviest(np.exp(near), spread)
    weights = np.zeros((len(x), 3))
    np.put_along_axis(weights, links, w, 1)
    rest = np.tile(np.eye(4), (3, 1, 1))
    rest[:, 0, 3] = [0.0, 0.4, 0.8]
    rest[1, :3, :3] = Rotation.from_euler("x", 0.4).as_matrix()
    local = np.tile(np.eye(4), (T, 3, 1, 1))
    phase = np.linspace(0, 1, T)
    local[:, 0, :3, :3] = Rotation.from_euler("z", 4 * np.pi * phase[:, None]).as_matrix()
    local[:, 0, :3, 3] = np.stack([phase, 0 * phase, 0.5 + 0 * phase], 1)
    for j in (1, 2):
        local[:, j, :3, :3] = Rotation.from_euler("yx", np.stack([np.sin(6 * phase), 0.3 * phase], 1)).as_matrix()
        local[:, j, 0, 3] = 0.4
    world = local.copy()
    for j in (1, 2):
        world[:, j] = world[:, j - 1] @ local[:, j]
    colours = np.random.default_rng(0).random(x.shape)
    parents = np.array([-1, 0, 1]) if chain else np.full(3, -1)
    return SkinnedMesh(
        x, np.asarray(cylinder.faces, np.int32), colours, weights, ("hip", "knee", "toe"), parents, rest, world,
        2.0 + np.arange(T) / 24,
    )  # fmt: skip


class Glb:
    """A GLB file taken apart; every rule of the specification that a reader may rely on is checked on the way."""

    def __init__(self, data: bytes):
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        assert size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        start = 20 + size
        size, kind = struct.unpack_from("<I4s", data, start)
        assert kind == b"BIN\0"
        assert size % 4 == 0
        self.binary = data[start + 8 :]
        assert len(self.binary) == size == self.json["buffers"][0]["byteLength"]
        assert self.json["asset"]["version"] == "2.0"
        self.arrays = [self._read(a) for a in self.json["accessors"]]

    def _read(self, accessor: dict) -> Array:
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind = np.dtype({5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]])
        shape = {"SCALAR": (), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}[accessor["type"]]
        element = kind.itemsize * int(np.prod(shape))
        assert view["byteOffset"] % 4 == 0
        assert element % 4 == 0
        assert view["byteLength"] == accessor["count"] * element
        assert view["byteOffset"] + view["byteLength"] <= len(self.binary)
        x = np.frombuffer(self.binary, kind, accessor["count"] * int(np.prod(shape)), view["byteOffset"])
        x = x.reshape(accessor["count"], *shape)
        if "min" in accessor:
            np.testing.assert_array_equal(np.atleast_1d(x.min(0)), accessor["min"])
            np.testing.assert_array_equal(np.atleast_1d(x.max(0)), accessor["max"])
        return x / np.iinfo(kind).max if accessor.get("normalized") else x

    @property
    def primitive(self) -> dict:
        return self.json["meshes"][0]["primitives"][0]

    def attribute(self, name: str) -> Array:
        return self.arrays[self.primitive["attributes"][name]]

    def pose(self, key: int) -> Array:
        """(B, 4, 4) global transforms of the joints at one key of the animation."""
        nodes = [dict(n) for n in self.json["nodes"]]
        animation = self.json["animations"][0]
        for c in animation["channels"]:
            value = self.arrays[animation["samplers"][c["sampler"]]["output"]][key]
            nodes[c["target"]["node"]][c["target"]["path"]] = value
        out: dict[int, Array] = {}

        def visit(n: int, above: Array) -> None:
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat(nodes[n].get("rotation", [0, 0, 0, 1])).as_matrix()
            T[:3, 3] = nodes[n].get("translation", [0, 0, 0])
            out[n] = above @ T
            for child in nodes[n].get("children", []):
                assert child not in out
                visit(child, out[n])

        for n in self.json["scenes"][self.json["scene"]]["nodes"]:
            visit(n, np.eye(4))
        assert len(out) == len(nodes)
        return np.stack([out[n] for n in self.json["skins"][0]["joints"]])

    def skinned(self, key: int) -> Array:
        """(V, 3) as a viewer computes them."""
        inverse = np.swapaxes(self.arrays[self.json["skins"][0]["inverseBindMatrices"]], 1, 2)
        M = self.pose(key) @ inverse
        x = np.pad(self.attribute("POSITION"), ((0, 0), (0, 1)), constant_values=1)
        links, w = self.attribute("JOINTS_0"), self.attribute("WEIGHTS_0")
        return np.einsum("vk,vkij,vj->vi", w, M[links], x)[:, :3]


@pytest.mark.parametrize("chain", [True, False])
def test_the_glb_moves_as_the_body_does(chain):
    mesh = tube(chain=chain)
    glb = Glb(encode_animated_glb(mesh))
    for key in range(len(mesh.t)):
        np.testing.assert_allclose(glb.skinned(key), mesh.posed(key) @ Y_UP.T, atol=1e-5)


def test_the_glb_is_named_timed_and_whole():
    mesh = tube()
    glb = Glb(encode_animated_glb(mesh))
    g = glb.json
    joints = g["skins"][0]["joints"]
    assert [g["nodes"][j]["name"] for j in joints] == ["hip", "knee", "toe"]
    assert g["nodes"][joints[0]]["children"] == [joints[1]]
    animation = g["animations"][0]
    assert {(c["target"]["node"], c["target"]["path"]) for c in animation["channels"]} == {
        (j, path) for j in joints for path in ("translation", "rotation")
    }
    for s in animation["samplers"]:
        time = glb.arrays[s["input"]]
        np.testing.assert_allclose(time, np.arange(7) / 24, atol=1e-6)
        assert "min" in g["accessors"][s["input"]]
        assert len(glb.arrays[s["output"]]) == len(time)
    assert "min" in g["accessors"][glb.primitive["attributes"]["POSITION"]]
    links, w = glb.attribute("JOINTS_0"), glb.attribute("WEIGHTS_0")
    assert links.max() < len(joints)
    np.testing.assert_allclose(w.sum(1), 1, atol=1e-6)
    assert np.all(links[w == 0] == 0)
    inverse = glb.arrays[g["skins"][0]["inverseBindMatrices"]]
    np.testing.assert_array_equal(inverse[:, :, 3], np.tile([0, 0, 0, 1], (3, 1)))
    np.testing.assert_array_equal(glb.arrays[glb.primitive["indices"]].reshape(-1, 3), mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(glb.attribute("NORMAL"), axis=1), 1, atol=1e-6)
    assert glb.primitive["attributes"].keys() == {"POSITION", "NORMAL", "COLOR_0", "JOINTS_0", "WEIGHTS_0"}
    assert sum(n.get("mesh") == 0 for n in g["nodes"]) == 1


def test_rotations_take_the_short_way_between_poses():
    mesh = tube(T=60)
    glb = Glb(encode_animated_glb(mesh))
    for s in glb.json["animations"][0]["samplers"]:
        x = glb.arrays[s["output"]]
        if x.shape[1] == 4:
            np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1, atol=1e-6)
            assert ((x[1:] * x[:-1]).sum(1) > 0.9).all()
    # Two turns about z are seen as such: the sign of the first link's rotation has come back after 4 pi.
    turn = glb.arrays[glb.json["animations"][0]["samplers"][1]["output"]]
    np.testing.assert_allclose(turn[0], turn[-1], atol=1e-6)
    np.testing.assert_allclose(turn[0] @ turn[len(turn) // 2], -1, atol=0.02)


def test_colours_are_linear_in_gltf():
    mesh = tube()
    colour = Glb(encode_animated_glb(mesh)).attribute("COLOR_0")
    assert np.all(colour[:, 3] == 1)
    c = colour[:, :3]
    srgb = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb, mesh.colours, atol=3e-4)


def test_more_links_than_four_keep_the_heaviest():
    rng = np.random.default_rng(1)
    links, w = heaviest(rng.dirichlet(np.ones(9), size=20), 4)
    assert links.shape == w.shape == (20, 4)
    assert (np.diff(w, axis=1) <= 0).all()
    np.testing.assert_allclose(w.sum(1), 1)
    links, w = heaviest(np.array([[0.0, 1.0]]), 4)
    np.testing.assert_array_equal(w, [[1, 0, 0, 0]])
    np.testing.assert_array_equal(links, [[1, 0, 0, 0]])


def test_more_than_256_links():
    mesh = tube()
    B = 300
    wide = np.zeros((len(mesh.vertices), B))
    wide[:, [0, 150, 299]] = mesh.weights
    rest, world = np.tile(np.eye(4), (B, 1, 1)), np.tile(np.eye(4), (len(mesh.t), B, 1, 1))
    rest[[0, 150, 299]], world[:, [0, 150, 299]] = mesh.rest, mesh.T_world_link
    names = tuple(f"link{j}" for j in range(B))
    many = SkinnedMesh(mesh.vertices, mesh.faces, mesh.colours, wide, names, np.full(B, -1), rest, world, mesh.t)
    np.testing.assert_allclose(Glb(encode_animated_glb(many)).skinned(3), mesh.posed(3) @ Y_UP.T, atol=1e-5)


def test_trimesh_reads_the_still_glb():
    mesh = tube()
    loaded = trimesh.load_scene(BytesIO(encode_glb(mesh.vertices, mesh.faces, mesh.colours)), file_type="glb")
    (shape,) = loaded.dump()
    np.testing.assert_allclose(shape.vertices, mesh.vertices @ Y_UP.T, atol=1e-6)
    np.testing.assert_array_equal(shape.faces, mesh.faces)
    assert shape.volume > 0
    Glb(encode_glb(mesh.vertices, mesh.faces, mesh.colours))


def test_trimesh_reads_the_ply():
    mesh = tube()
    shape = trimesh.load_mesh(
        BytesIO(encode_ply(mesh.posed(3), mesh.faces, mesh.colours)), file_type="ply", process=False
    )
    np.testing.assert_allclose(shape.vertices, mesh.posed(3), atol=1e-6)
    np.testing.assert_array_equal(shape.faces, mesh.faces)
    np.testing.assert_allclose(shape.visual.vertex_colors[:, :3] / 255, mesh.colours, atol=0.51 / 255)


FLOATS = st.floats(-1e3, 1e3, width=32)


@settings(max_examples=40, deadline=None)
@given(
    vertices=hnp.arrays(np.float32, st.tuples(st.integers(3, 9), st.just(3)), elements=FLOATS),
    faces=hnp.arrays(np.int32, st.tuples(st.integers(0, 5), st.just(3)), elements=st.integers(0, 2)),
    shade=st.integers(0, 255),
)
def test_ply_round_trip(tmp_path_factory, vertices, faces, shade):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    path.write_bytes(encode_ply(vertices, faces, np.full(vertices.shape, shade / 255), comments=("t 0.5 s",)))
    back = read_ply(path)
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.faces, faces)
    np.testing.assert_allclose(back.colours, shade / 255)
    assert back.comments == ("t 0.5 s",)


def test_reads_the_ply_of_others(tmp_path):
    ball = trimesh.creation.icosphere(1, 0.3)
    for colours in (None, np.full((len(ball.vertices), 4), [10, 20, 30, 255], np.uint8)):
        if colours is not None:
            ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=colours)
        (tmp_path / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, vertex_normal=True))
        back = read_ply(tmp_path / "ball.ply")
        np.testing.assert_allclose(back.vertices, ball.vertices, atol=1e-6)
        np.testing.assert_array_equal(back.faces, ball.faces)
        want = [0.5, 0.5, 0.5] if colours is None else np.array([10, 20, 30]) / 255
        np.testing.assert_allclose(back.colours, np.tile(want, (len(ball.vertices), 1)))


def test_ply_that_cannot_be_read(tmp_path):
    path = tmp_path / "a.ply"
    good = encode_ply(np.eye(3), np.array([[0, 1, 2]]), np.zeros((3, 3)))
    for data, what in (
        (b"", "not a binary little-endian PLY"),
        (b"ply\nformat ascii 1.0\nend_header\n", "not a binary little-endian PLY"),
        (good[:-1], "truncated"),
        (good.replace(b"float z", b"float w"), "vertices lack x, y, z"),
        (good.replace(b"float z", b"list uchar float z"), "not of a mesh of triangles"),
        (good.replace(b"element face 1", b"element edge 1"), "not of a mesh of triangles"),
        (good[:-13] + b"\x04" + good[-12:], "no triangles"),
        (good[:-4] + struct.pack("<i", 3), "beyond its last"),
    ):
        path.write_bytes(data)
        with pytest.raises(InvalidData, match=what):
            read_ply(path)
    with pytest.raises(InvalidData, match="No such file"):
        read_ply(tmp_path / "none.ply")


def test_arrays_of_a_mesh_round_trip():
    mesh = tube()
    back = SkinnedMesh.from_arrays(mesh.to_arrays())
    np.testing.assert_allclose(back.posed(5), mesh.posed(5), atol=1e-6)
    assert (back.link_names, back.link_parents.tolist()) == (mesh.link_names, [-1, 0, 1])
    roots = SkinnedMesh.from_arrays({k: v for k, v in mesh.to_arrays().items() if k != "link_parents"})
    assert roots.link_parents.tolist() == [-1, -1, -1]
    assert mesh.every(3).t.tolist() == mesh.t[::3].tolist()
    np.testing.assert_array_equal(mesh.every(3).posed(1), mesh.posed(3))


@pytest.mark.parametrize(
    ("name", "change", "what"),
    [
        ("vertices", lambda x: x * np.nan, "not finite"),
        ("faces", lambda x: x + 10_000, "beyond"),
        ("weights", lambda x: 2 * x, "do not sum to 1"),
        ("weights", lambda x: x[:-1], "expected"),
        ("rest", lambda x: 1.1 * x, "not rigid"),
        ("link_parents", lambda x: x[::-1], "parent after its child"),
        ("t", lambda x: 0 * x, "not strictly increasing"),
        ("colours", lambda x: None, "lacks colours"),
    ],
)
def test_a_mesh_that_is_none(name, change, what):
    arrays = tube().to_arrays()
    arrays[name] = change(arrays[name])
    with pytest.raises(InvalidData, match=what):
        SkinnedMesh.from_arrays({k: v for k, v in arrays.items() if v is not None})


def test_normals_point_out_and_are_of_unit_length():
    ball = trimesh.creation.icosphere(3, 0.5)
    x = np.vstack([ball.vertices, [[9.0, 9, 9]]])  # the last belongs to no face
    normals = vertex_normals(x, np.asarray(ball.faces))
    np.testing.assert_allclose(normals[:-1], ball.vertices / 0.5, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
