"""The neural model: distances, density, skinning, rendering, terms and the mesh, on bodies whose answers are known."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from slomo.errors import StageFailed, UsageError
from slomo.pinhole import Intrinsics
from slomo.reconstruct import silhouette
from slomo.reconstruct.fields import mesh as meshing
from slomo.reconstruct.fields import rays, skinning
from slomo.reconstruct.fields.background import Background, colours
from slomo.reconstruct.fields.canonical import BLEND, Capsules, apart, density, rest
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.render import render
from slomo.reconstruct.fields.terms import Fields
from slomo.reconstruct.kinematics import Kinematics, rot
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.problem import Draw, Problem, Variables
from slomo.reconstruct.state import State
from slomo.reconstruct.trajectory import Guess, Trajectory
from slomo.skeleton import load_skeleton
from test_fit import _camera

F, SIZE = 3, 0.5
K = Intrinsics(110, 110, 63.5, 35.5, 128, 72)
SHARP = FieldsConfig(samples=48, coarse=96, beta=0.004)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def kin() -> Kinematics:
    return Kinematics(load_skeleton("quadruped"))


def _observations(mask: torch.Tensor) -> Observations:
    n = K.width * K.height
    t = torch.arange(F) / 10
    flat = torch.full((F, n), 1.0, dtype=torch.float64).cumsum(1) / n
    return Observations(
        t=t, at=torch.arange(F), dt=torch.full((F - 1,), 0.1), K=K, scale=1.0, T_world_cam=np.stack([_camera(0.8)] * F),
        mask=mask, edge=torch.zeros(F, 1, K.height, K.width), draw_in=flat, draw_out=flat,
        flow=torch.zeros(F - 1, n, 2), flow_ok=torch.ones(F - 1, n, dtype=torch.bool),
        static=torch.zeros(F, 1, K.height, K.width), quality=torch.ones(F), box=np.array([[40, 20, 90, 60.0]] * F),
        empty=np.zeros(F, bool), flow_size=1.0,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Case:
    """A body whose pose is the guess: it turns by `turn` rad and moves by `step` a frame, with joint angles q."""

    problem: Problem
    x: Variables
    guess: Guess

    def state(self, draw: Draw) -> State:
        return self.problem.state(self.x, self.guess, draw, stance_weight=0.0)

    def all_pixels(self, f: int) -> State:
        return self.state(Draw(torch.tensor([f]), torch.arange(K.width * K.height)[None], 0))


def _case(kin: Kinematics, config: FieldsConfig, *, q: torch.Tensor | None = None, turn=0.0, step=0.0) -> Case:
    obs = _observations(torch.zeros(F, K.width * K.height, dtype=torch.bool))
    path = Trajectory(obs.t, kin.B, joint_hz=3.0, root_hz=2.0, width=8)
    problem = Problem(obs, kin, path, {}, 0.01)
    generator = torch.Generator().manual_seed(0)
    x = problem.variables(1, generator)
    x["shape.log_length"] += math.log(SIZE)
    position = torch.tensor([-0.05, 1.6, 0.93 * SIZE]) + torch.arange(F)[:, None] * torch.tensor([step, 0.3 * step, 0])
    guess = Guess(
        position[None], 0.3 + turn * torch.arange(F)[None].float(), torch.zeros(1, F, 2),
        torch.zeros(1, F, kin.B, 3) if q is None else q.expand(1, F, -1, -1), torch.full((1, F, 4), -1.0),
    )  # fmt: skip
    fields = Fields(config, obs, kin, torch.full((F, K.width * K.height, 3), 0.3))
    return Case(problem, x | fields.variables(generator), guess)


def _bent(kin: Kinematics, seed: int = 1) -> torch.Tensor:
    """Joint angles (B, 3) well within the limits."""
    r = torch.rand(kin.B, 3, generator=torch.Generator().manual_seed(seed))
    q = 0.6 * (kin.lower + r * (kin.upper - kin.lower))
    return torch.where(torch.isfinite(q), q, 0)


def test_distance_to_a_capsule_is_the_analytic_one():
    one = Capsules(torch.tensor([[0.0, 0, 0]]), torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.2, 0.2]]))
    x = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.0, 0.1], [2.0, 0.0, 0.0], [-0.3, 0.4, 0.0]])
    np.testing.assert_allclose(one.distances(x)[:, 0].numpy(), [0.3, -0.1, 0.8, 0.3], atol=1e-3)
    np.testing.assert_allclose(one.union(x).numpy(), [0.3, -0.1, 0.8, 0.3], atol=1e-3)


def test_the_union_is_the_minimum_up_to_the_blend(kin: Kinematics):
    c = rest(kin, kin.shape_variables(1)).capsules
    x = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    gap = c.distances(x).amin(-1) - c.union(x)
    assert gap.min() >= -1e-6
    assert gap.max() <= BLEND * math.log(len(c.a)) + 1e-6


def test_density_is_the_laplace_distribution():
    beta = torch.tensor(0.02)
    sdf = torch.tensor([0.0, 0.02, -0.02, -1.0, 1.0])
    want = np.array([0.5, 0.5 / math.e, 1 - 0.5 / math.e, 1, 0]) / 0.02
    np.testing.assert_allclose(density(sdf, beta).numpy(), want, rtol=1e-5, atol=1e-6)


def test_quaternions_of_the_links_are_their_rotations(kin: Kinematics):
    q = _bent(kin)[None]
    body = kin.pose(kin.shape_variables(1), torch.zeros(1, 1, 3), torch.eye(3).expand(1, 1, 3, 3), q[None])
    real = skinning.rotations(kin, q)
    x = torch.tensor([0.3, -0.5, 0.7])
    np.testing.assert_allclose(
        skinning.turn(real[0], x.expand(kin.B, 3)).numpy(), (body.R[0, 0] @ x).numpy(), atol=1e-6
    )


def _posed(kin: Kinematics, q: torch.Tensor, R: torch.Tensor):
    shape = {k: 0.5 * torch.randn(v.shape, generator=torch.Generator().manual_seed(4)) for k, v in
             kin.shape_variables(1).items()}  # fmt: skip
    place, q = torch.tensor([[[1.0, 2.0, 3.0]]]), q[None, None]
    R = R[None, None]
    at_rest = rest(kin, shape)
    body = kin.pose(shape, place, R, q)
    return at_rest, skinning.bones(kin, body, R, q, torch.tensor([0]), at_rest)


def test_every_capsules_motion_takes_it_from_rest_to_its_pose(kin: Kinematics):
    at_rest, bones = _posed(kin, _bent(kin), rot(2, torch.tensor(0.7)))
    for end, want in ((at_rest.capsules.a, bones.capsules.a[0]), (at_rest.capsules.b, bones.capsules.b[0])):
        np.testing.assert_allclose(skinning.forward(bones.dual[0], end).numpy(), want.numpy(), atol=1e-5)


def test_warps_are_the_identity_at_rest_and_under_rigid_motion(kin: Kinematics):
    _, bones = _posed(
        kin,
        torch.as_tensor(apart(kin.skeleton), dtype=torch.float32),
        rot(2, torch.tensor(0.7)) @ rot(1, torch.tensor(0.4)),
    )
    x = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    dual = skinning.blend(skinning.weights(bones.quadric[0], x), bones.dual[0])
    np.testing.assert_allclose(skinning.forward(dual, x).numpy(), x.numpy(), atol=1e-5)
    np.testing.assert_allclose(skinning.backward(dual, x).numpy(), x.numpy(), atol=1e-5)


def test_backward_undoes_forward(kin: Kinematics):
    at_rest, bones = _posed(kin, _bent(kin), torch.eye(3))
    x = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    w = skinning.weights(skinning.quadric(at_rest.capsules), x)
    dual = skinning.blend(w, bones.dual[0])
    np.testing.assert_allclose(skinning.backward(dual, skinning.forward(dual, x)).numpy(), x.numpy(), atol=1e-5)
    # With weights of its own on the way back: along the bones, where one of them rules.
    c = at_rest.capsules
    axis = (c.a + c.b) / 2
    there = skinning.forward(skinning.blend(skinning.weights(skinning.quadric(c), axis), bones.dual[0]), axis)
    w = skinning.weights(bones.quadric[0], there)
    back = skinning.backward(skinning.blend(w, bones.dual[0]), there)
    assert (back - axis).norm(dim=-1).median() < 0.01
    assert (back - axis).norm(dim=-1).max() < 0.1


def test_the_mahalanobis_distance_is_two_at_the_surface():
    c = Capsules(torch.tensor([[0.1, 0, 0]]), torch.tensor([[0.1, 0, 0.4]]), torch.tensor([[0.05, 0.05]]))
    x = torch.tensor([[0.15, 0.0, 0.2], [0.1, 0.0, 0.45], [0.1, 0.0, 0.2]])
    d2 = (skinning._monomials(x) @ skinning.quadric(c))[:, 0]
    np.testing.assert_allclose(d2.numpy(), [4, 4, 0], atol=1e-3)


def test_a_solid_is_opaque_where_it_is_and_at_its_depth(kin: Kinematics):
    case = _case(kin, SHARP)
    s = case.all_pixels(1)
    r = render(s, SHARP, K.width * K.height)
    sd, pixel = s.sd[0, 0].amin(-1), r.rays.column
    inside, outside = sd[pixel] < -1.5, sd[pixel] > 1.5
    assert r.opacity[inside].min() > 0.95
    assert r.opacity[outside].mean() < 0.02
    assert set(torch.nonzero(sd < 2.9)[:, 0].tolist()) <= set(pixel.tolist())
    c, _ = silhouette.visible(K, s.out, s.sd, s.h)
    front = silhouette.surface(K, s.out, c, s.u, s.v)[0, 0, pixel, 2] / s.body.length[0]
    assert (r.depth - front)[inside].abs().median() < 0.015
    assert (r.depth - front)[inside].abs().quantile(0.95) < 0.08
    assert torch.allclose(r.weight.sum(1), r.opacity)


def test_flow_of_a_rigidly_moved_body_is_its_projected_motion(kin: Kinematics):
    case = _case(kin, SHARP, turn=0.08, step=0.03)
    s = case.all_pixels(0)
    r = render(s, SHARP, K.width * K.height)
    sure = r.opacity > 0.95
    u, v = s.u[0, r.rays.column], s.v[0, r.rays.column]
    X = torch.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, torch.ones_like(u)], -1)
    X = X * (r.depth * s.body.length[0])[:, None] @ s.R_cam[0, 0] + s.centre[0, 0]
    Y = (X - s.body.nodes[0, 0, 0]) @ s.R_root[0, 0] @ s.R_root[0, 1].T + s.body.nodes[0, 1, 0]
    seen = silhouette.to_camera(s.R_cam[:, 1:2], s.centre[:, 1:2], Y[None, None])[0, 0]
    pu, pv, _ = silhouette.project(K, seen)
    error = (r.flow - torch.stack([pu - u, pv - v], -1))[sure].norm(dim=-1)
    assert r.flow[sure].norm(dim=-1).median() > 1
    assert error.median() < 0.03
    assert error.quantile(0.95) < 0.3


def _drawn(case: Case) -> Draw:
    """Pixels of two frames on and near the body, those on it first."""
    sd = case.all_pixels(0).sd[0, 0].amin(-1)
    inside = torch.nonzero(sd < 0)[::2, 0]
    outside = torch.nonzero((sd > 0) & (sd < 2))[::2, 0]
    n = min(len(inside), len(outside))
    pixel = torch.cat([inside[:n], outside[:n]])
    return Draw(torch.tensor([0, 1]), torch.stack([pixel, pixel]), n)


@pytest.mark.parametrize("name", ["opacity", "flow", "colour", "cycle"])
def test_gradients_of_the_rendering_by_the_pose(kin: Kinematics, name: str, monkeypatch: pytest.MonkeyPatch):
    """Against finite differences with the samples held: where they lie along a ray is not differentiated."""
    config = dataclasses.replace(SHARP, rays=400, beta=0.012, samples=24, queried=24)
    case = _case(kin, config, q=0.5 * _bent(kin)[None], turn=0.05, step=0.02)
    generator = torch.Generator().manual_seed(3)
    case.x["F.colour.w1"] += torch.randn(case.x["F.colour.w1"].shape, generator=generator)
    draw = _drawn(case)
    held: list[torch.Tensor] = []
    sample = rays.sample
    monkeypatch.setattr(rays, "sample", lambda *a: held[0] if held else (held.append(sample(*a)) or held[0]))
    direction = {k: 0.3 * torch.randn(case.x[k].shape, generator=generator) for k in ("G.b2", "Q.b2")}

    def value(step: torch.Tensor) -> torch.Tensor:
        x = case.x | {k: case.x[k] + step * d for k, d in direction.items()}
        r = render(case.problem.state(x, case.guess, draw, stance_weight=0.0), config)
        if name == "cycle":  # in what order the samples come is no matter, but how much each counts
            return (r.cycle / 0.02**2 * r.queried_weight).sum()
        return getattr(r, name)[r.rays.column < 150].sum()

    step = torch.zeros(1, requires_grad=True)
    (slope,) = torch.autograd.grad(value(step), step)
    h = 5e-4
    with torch.no_grad():
        measured = (value(torch.tensor([h])) - value(torch.tensor([-h]))) / (2 * h)
    assert abs(float(measured)) > 1e-2
    np.testing.assert_allclose(float(slope), float(measured), rtol=0.02)


def test_terms_are_the_same_every_time_and_reach_every_variable(kin: Kinematics):
    config = FieldsConfig(rays=200)
    case = _case(kin, config, q=_bent(kin)[None], step=0.02)
    for v in case.x.values():
        v.requires_grad_()
    # Last layers start at zero and hide those before them.
    case.x["F.sdf.w3"].data += 0.01
    for k in ("F.colour.w1", "F.delta.w1", "F.background.w2"):
        case.x[k].data += 0.05 * torch.randn(case.x[k].shape, generator=torch.Generator().manual_seed(2))
    draw = _drawn(case)

    def values() -> dict[str, torch.Tensor]:
        fields = Fields(config, case.problem.obs, kin, torch.full((F, K.width * K.height, 3), 0.3))
        state = case.state(draw)
        return {name: term(state) for name, term in fields.terms().items()}

    a, b = values(), values()
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert all(v.shape == (1,) and bool(torch.isfinite(v).all()) for v in a.values())
    sum(a.values(), torch.zeros(1)).sum().backward()
    for name, v in case.x.items():
        if name.startswith("F."):
            assert v.grad is not None, name
            assert bool(v.grad.abs().max() > 0), name
    radius = case.x["shape.radius"].grad
    assert radius is not None
    assert float(radius.abs().max()) > 0


def test_rays_that_do_not_meet_the_body_say_nothing(kin: Kinematics):
    config = FieldsConfig(rays=50)
    case = _case(kin, config)
    away = dataclasses.replace(case, guess=dataclasses.replace(case.guess, position=case.guess.position + 40.0))
    for v in away.x.values():
        v.requires_grad_()
    fields = Fields(config, case.problem.obs, kin, torch.full((F, K.width * K.height, 3), 0.3))
    state = away.state(_drawn(case))
    values = {name: term(state) for name, term in fields.terms().items()}
    assert len(fields.rendered(state).opacity) == 0
    assert all(v.shape == (1,) and bool(torch.isfinite(v).all()) for v in values.values()), values
    sum(values.values(), torch.zeros(1)).sum().backward()
    assert all(bool(torch.isfinite(v.grad).all()) for v in away.x.values() if v.grad is not None)


def test_a_state_is_rendered_once(kin: Kinematics, monkeypatch: pytest.MonkeyPatch):
    case = _case(kin, FieldsConfig(rays=50))
    fields = Fields(FieldsConfig(rays=50), case.problem.obs, kin, torch.zeros(F, K.width * K.height, 3))
    count = []
    monkeypatch.setattr("slomo.reconstruct.fields.terms.render", lambda *a: count.append(1) or render(*a))
    state = case.state(_drawn(case))
    for term in fields.terms().values():
        term(state)
    assert len(count) == 1
    fields.terms()["opacity"](case.state(_drawn(case)))
    assert len(count) == 2


def test_published_sizes_run(kin: Kinematics):
    config = dataclasses.replace(FieldsConfig.published(), rays=8)
    case = _case(kin, config)
    fields = Fields(config, case.problem.obs, kin, torch.full((F, K.width * K.height, 3), 0.3))
    assert torch.isfinite(fields.terms()["colour"](case.state(_drawn(case)))).all()


def test_a_point_of_the_ground_looks_alike_to_every_camera():
    obs = _observations(torch.zeros(F, K.width * K.height, dtype=torch.bool))
    T = obs.T_world_cam.copy()
    T[1, 0, 3] += 0.4
    T[2, :3, :3] = T[2, :3, :3] @ rot(1, torch.tensor(0.2)).numpy()
    background = Background(dataclasses.replace(obs, T_world_cam=T), 4)
    X = np.array([0.1, 1.9, 0.0])
    Y = np.stack([(X - M[:3, 3]) @ M[:3, :3] for M in T])
    u = torch.as_tensor(K.fx * Y[:, 0] / Y[:, 2] + K.cx, dtype=torch.float32)
    v = torch.as_tensor(K.fy * Y[:, 1] / Y[:, 2] + K.cy, dtype=torch.float32)
    ground = background.features(torch.arange(F), u, v)[:, : 2 * (1 + 2 * 4)]
    np.testing.assert_allclose(ground[1:].numpy(), ground[:1].expand(2, -1).numpy(), atol=2e-3)
    sky = background.features(torch.tensor([0]), torch.tensor([60.0]), torch.tensor([-400.0]))
    assert torch.isfinite(sky).all()
    assert sky[0, -1] == 0


def test_colours_are_those_of_the_frames():
    obs = _observations(torch.zeros(F, K.width * K.height, dtype=torch.bool))
    frames = np.zeros((F, 2 * K.height, 2 * K.width, 3), np.uint8)
    frames[1] = (255, 51, 0)
    out = colours(frames, obs)
    assert out.shape == (F, K.width * K.height, 3)
    np.testing.assert_allclose(out[1, 7].numpy(), [1, 0.2, 0], atol=1e-6)
    assert float(out[0].abs().max()) == 0


def test_the_first_mesh_lies_on_the_capsules_and_follows_the_body(kin: Kinematics):
    case = _case(kin, SHARP, q=_bent(kin)[None])
    shape = {k.removeprefix("shape."): v for k, v in case.x.items() if k.startswith("shape.")}
    m = meshing.mesh(case.x, SHARP, kin, shape, cell=0.02)
    sdf = rest(kin, shape).capsules.union(torch.as_tensor(m.vertices / SIZE, dtype=torch.float32))
    assert sdf.abs().max() < 0.006
    np.testing.assert_allclose(m.weights.sum(1), 1, atol=1e-5)
    a, b, c = (m.vertices[m.faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0  # faces look outwards
    assert 0 <= m.colours.min() <= m.colours.max() <= 1
    s = case.all_pixels(0)
    x = meshing.posed(m, kin, shape, s.body, s.R_root, s.q, torch.tensor([0, 2]))
    assert x.shape == (2, *m.vertices.shape)
    posed = Capsules(s.body.a[0, 2], s.body.b[0, 2], s.body.radii[0])
    off = posed.distances(torch.as_tensor(x[1], dtype=torch.float32)).amin(-1).abs() / SIZE
    assert off.median() < 0.02  # skin at bent joints leaves the cones
    at_rest = torch.as_tensor(m.q, dtype=torch.float32).expand_as(s.q)
    still = case.problem.kin.pose(shape, s.body.nodes[:, :, 0], s.R_root, at_rest)
    x = meshing.posed(m, kin, shape, still, s.R_root, at_rest, torch.tensor([1]))[0]
    want = m.vertices @ s.R_root[0, 1].numpy().T + s.body.nodes[0, 1, 0].numpy()
    np.testing.assert_allclose(x, want, atol=1e-5)


def test_a_field_without_surface_is_said(kin: Kinematics):
    case = _case(kin, SHARP)
    case.x["F.sdf.b3"][..., 0] = 1e3
    shape = {k.removeprefix("shape."): v for k, v in case.x.items() if k.startswith("shape.")}
    with pytest.raises(StageFailed, match="no surface"):
        meshing.mesh(case.x, SHARP, kin, shape, cell=0.05)


def test_wrong_sizes_are_refused():
    with pytest.raises(UsageError, match=r"fields\.rays"):
        FieldsConfig(rays=0)
    with pytest.raises(UsageError, match="queried"):
        FieldsConfig(samples=3, queried=4)
