"""The skin of a skeleton: it is where the capsules are, moves with them, and has the colours that the clip shows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from slomo.mesh import SkinnedMesh
from slomo.raycast import Light, Part, Scene, intrinsics, look_at
from slomo.reconstruct.body_colours import coloured_by_clip
from slomo.reconstruct.body_mesh import LEFT, RIGHT, body_mesh, field_mesh
from slomo.reconstruct.fields.canonical import apart
from slomo.reconstruct.kinematics import Kinematics, Posed
from slomo.skeleton import list_skeletons, load_skeleton

Array = np.ndarray
METRES = 0.7  # per world unit
T = 6


def made(name: str) -> tuple[Kinematics, Posed, SkinnedMesh]:
    """A body of odd proportions in random poses about the rest pose."""
    kin = Kinematics(load_skeleton(name))
    g = torch.Generator().manual_seed(3)
    shape = {k: 0.5 * torch.randn(v.shape, generator=g) for k, v in kin.shape_variables(2).items()}
    q = 0.5 * kin.sigma.clamp(max=0.5) * torch.randn(2, T, kin.B, 3, generator=g)
    position = torch.randn(2, T, 3, generator=g)
    turn = torch.linalg.matrix_exp(
        torch.cross(torch.eye(3).expand(2, T, 3, 3), torch.randn(2, T, 1, 3, generator=g), dim=-1)
    )
    body = kin.pose(shape, position, turn, q)
    return kin, body, body_mesh(kin, shape, body, np.arange(T) / 30, metres_per_unit=METRES)


@pytest.fixture(scope="module", params=list_skeletons())
def parts(request: pytest.FixtureRequest) -> tuple[Kinematics, Posed, SkinnedMesh]:
    return made(request.param)


def signed_distance(body: Posed, k: int, x: Array) -> Array:
    """(V,) m of points in the world from the nearest capsule of the first hypothesis."""
    out = np.full(len(x), np.inf)
    for a, b, r in zip(body.a[0, k].numpy(), body.b[0, k].numpy(), body.radii[0].numpy(), strict=True):
        a, b, r = METRES * a.astype(float), METRES * b.astype(float), METRES * r
        s = np.clip((x - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
        out = np.minimum(out, np.linalg.norm(x - a - s[:, None] * (b - a), axis=1) - (r[0] + s * (r[1] - r[0])))
    return out


def test_the_skin_lies_on_the_posed_capsules(parts):
    _, body, mesh = parts
    radius = METRES * float(body.radii[0].median())
    for k in range(T):
        d = signed_distance(body, k, mesh.posed(k))
        assert np.quantile(np.abs(d), 0.5) < 0.08 * radius
        assert np.quantile(d, 0.98) < 0.4 * radius  # limbs that touch lie deep in each other, but nothing sticks out


def test_the_skin_is_closed_whole_and_outwards(parts):
    _, _, mesh = parts
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shape.is_watertight
    assert shape.volume > 0
    assert shape.body_count == 1
    assert ((mesh.weights > 0).sum(1) <= 4).all()
    assert 5_000 < len(mesh.vertices) < 40_000


def test_links_are_where_the_kinematics_has_them(parts):
    kin, body, mesh = parts
    np.testing.assert_allclose(mesh.T_world_link[..., :3, 3], METRES * body.nodes[0, :, : kin.B].numpy(), atol=1e-6)
    assert mesh.link_names == kin.skeleton.names[: kin.B]
    assert mesh.rest[0].tolist() == np.eye(4).tolist()


def test_the_surface_of_a_field_moves_with_the_links(parts):
    """Points on the links, each carried by its own, are seen in metres where the kinematics puts them."""
    kin, body, _ = parts
    shape = kin.shape_variables(2)
    straight = kin.pose(
        kin.shape_variables(1), torch.zeros(1, 1, 3), torch.eye(3).expand(1, 1, 3, 3), torch.zeros(1, 1, kin.B, 3)
    )
    origins = straight.nodes[0, 0, : kin.B].numpy().astype(float)
    out = np.array([0.1, 0.02, -0.05])
    surface = SimpleNamespace(
        vertices=origins + out,
        faces=np.array([[0, 1, 2]]),
        colours=np.full((kin.B, 3), 1.0001),
        weights=np.eye(kin.B),
        q=np.zeros((kin.B, 3)),
    )
    mesh = field_mesh(surface, kin, shape, body, np.arange(T) / 30, metres_per_unit=METRES)  # pyright: ignore
    for k in range(T):
        want = body.nodes[0, k, : kin.B].numpy() + body.R[0, k].numpy() @ out
        np.testing.assert_allclose(mesh.posed(k), METRES * want, atol=1e-5)
    assert mesh.colours.max() == 1


def test_left_is_orange_and_right_is_blue(parts):
    _, _, mesh = parts
    low = mesh.vertices[:, 2] < np.quantile(mesh.vertices[:, 2], 0.1)  # shins and feet, apart
    for side, colour in ((1, LEFT), (-1, RIGHT)):
        mine = low & (side * mesh.vertices[:, 1] > 0)
        np.testing.assert_allclose(mesh.colours[mine], np.tile(colour, (mine.sum(), 1)), atol=0.02)


def test_limbs_stand_apart_within_their_limits(parts):
    kin, _, _ = parts
    q = apart(kin.skeleton)
    assert (np.abs(q).sum(1) > 0).sum() == 4
    assert np.all(q <= kin.skeleton.upper)
    assert np.all(q >= kin.skeleton.lower)
    np.testing.assert_allclose(q[:, 0], -q[kin.skeleton.mirror[: kin.B], 0])


def test_colours_come_back_from_a_clip():
    """A painted body is filmed from its left; painted by the film, it is as before, and its right as its left."""
    _, _, mesh = made("quadruped")
    x = mesh.vertices
    paint = np.stack([0.3 + 0.3 * (x[:, 0] > 0), 0.5 + 0 * x[:, 0], 0.3 + 0.3 * (x[:, 2] > 0.02)], 1)
    still = replace(mesh, colours=paint, T_world_link=np.tile(mesh.rest, (T, 1, 1, 1)))
    size, K = (200, 150), intrinsics(200, 150, hfov=0.8)
    eyes = [look_at(np.array([s, 1.6, 0.5]), np.zeros(3)) for s in np.linspace(-0.8, 0.8, T)]
    scene = Scene({"body": Part(x, still.faces, paint)}, Light(sun_strength=0.0, ambient=1.0, ground="none", fog=1e6))
    scene.move({"body": still.posed(0)})
    film = [scene.render(K, eye, size) for eye in eyes]
    asked = []

    def picture(k: int) -> Array:
        asked.append(k)
        return film[k].rgb

    found = coloured_by_clip(
        replace(still, colours=0 * paint), picture, lambda k: film[k].mask(1) & (k != 2), K, np.stack(eyes)
    )
    assert asked == [0, 1, 3, 4, 5]  # in frame 2 there is no subject
    # The shade varies with the direction of the sky's light: hues do not.
    hue = lambda c: c / c.sum(1, keepdims=True)  # noqa: E731
    clear = (np.abs(x[:, 0]) > 0.02) & (np.abs(x[:, 2] - 0.02) > 0.02)
    error = np.abs(hue(found.colours) - hue(paint)).max(1)[clear]
    assert np.quantile(error, 0.9) < 0.05
    nothing = coloured_by_clip(still, picture, lambda k: np.zeros((150, 200), bool), K, np.stack(eyes))
    np.testing.assert_array_equal(nothing.colours, still.colours)
