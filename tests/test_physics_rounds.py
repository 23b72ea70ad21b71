"""Windows, what is learned in them, and the term that the fit gets from it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.physics.coupling import term
from slomo.reconstruct.physics.learn import Learner, PhysicsConfig, Simulated
from slomo.reconstruct.physics.model import build
from slomo.reconstruct.physics.windows import Kinematic, cover, guides
from slomo.skeleton import load_skeleton

SKELETON = load_skeleton("quadruped")
LENGTH = 0.5


def kinematic(T: int = 25, fps: float = 30.0, *, speed: float = 0.0, sunk: float = 0.0) -> Kinematic:
    """The rest pose, which stands or glides along x without moving its feet: what no body can do."""
    t = np.arange(T) / fps
    height = SKELETON.root_height * LENGTH - sunk
    position = np.stack([speed * t, 0 * t, 0 * t + height], 1)
    nodes = position[:, None] + SKELETON.rest() * LENGTH
    contact = np.zeros(nodes.shape[:2])
    contact[:, list(SKELETON.contacts)] = 1
    return Kinematic(t, position, np.tile(np.eye(3), (T, 1, 1)), np.zeros((T, SKELETON.link_count, 3)), nodes, contact)


def learner(k: Kinematic, base: Kinematic | None = None, **config) -> Learner:
    kin = Kinematics(SKELETON)
    still = torch.zeros(1, 1, 3), torch.eye(3)[None, None], torch.zeros(1, 1, kin.B, 3)
    body = build(SKELETON, kin.pose(kin.shape_variables(1), *still), unit=LENGTH)
    return Learner(body, k, SKELETON.mirror[: SKELETON.link_count], PhysicsConfig(**config), base=base)


@pytest.mark.parametrize("total", [0.5, 1.2, 3.0, 31.0])
def test_windows_cover_the_clip_and_their_shares_sum_to_one(total):
    t = np.arange(0, total, 1 / 24)
    w = cover(t, length=1.2, overlap=0.3, dt=0.0025, knot=0.1)
    assert w.dt <= 0.0025 + 1e-9
    assert w.start[0] == t[0]
    assert w.start[-1] + w.steps * w.dt == pytest.approx(t[-1])
    assert np.all(np.diff(w.start) <= 0.9 + 1e-9)
    assert w.merge(np.ones((*w.frame.shape, 1)), len(t)) == pytest.approx(1)
    when = w.start[:, None] + w.step * w.dt
    assert w.merge(when[..., None], len(t))[:, 0] == pytest.approx(t)
    assert w.basis.sum(1).numpy() == pytest.approx(1, abs=1e-5)


def test_guides_pass_through_the_motion_with_its_velocities():
    t = np.arange(40) / 25
    spin = np.array([0.2, -0.1, 1.5])
    R = Rotation.from_rotvec(t[:, None] * spin).as_matrix()
    place = np.stack([0.5 * t, -0.2 * t, 1 + 0 * t], 1)
    q = np.zeros((40, 3, 3))
    q[:, 1, 1] = np.sin(4 * t)
    k = Kinematic(t, place, R, q, np.zeros((40, 4, 3)), np.zeros((40, 4)))
    w = cover(t, length=0.8, overlap=0.2, dt=0.005, knot=0.1)
    g = guides(k, w)
    when = w.start[:, None] + w.dt * np.arange(w.steps + 1)
    assert g.velocity.numpy() == pytest.approx(np.tile([0.5, -0.2, 0], (w.count, 1)), abs=1e-5)
    assert g.spin.numpy() == pytest.approx(np.tile(spin, (w.count, 1)), abs=1e-4)
    assert g.position[..., 0].numpy() == pytest.approx(0.5 * when, abs=1e-5)
    assert g.q[..., 1, 1].numpy() == pytest.approx(np.sin(4 * when), abs=1e-3)


def test_learning_makes_the_body_stand_where_it_should():
    """The pose is sunk into the ground and the joints sag under the weight: raw, it is pushed out and swings."""
    one = learner(kinematic(sunk=0.01))
    x = one.start()
    raw = one.simulate(x, 0.001)
    assert raw.trust.max() < 1
    error = lambda s: np.linalg.norm(s.nodes - one.kinematic.nodes, axis=-1).mean() / LENGTH  # noqa: E731
    x, losses = one.learn(x, np.full(60, 0.001), rate=0.05)
    learned = one.simulate(x, 0.001)
    assert min(losses) < 0.6 * losses[0]
    assert error(learned) < 0.7 * error(raw)
    assert learned.trust.min() > raw.trust.max()
    assert learned.report["assisting_force_of_weight"] < 0.01


def test_what_no_body_can_do_is_not_done():
    """A body that glides on feet that stand: friction holds the feet, which slide in the kinematic motion."""
    one = learner(kinematic(speed=0.1))
    nodes = one.roll(one.controls(one.start(), 0.001)).numpy()
    first = nodes[0, 3:, list(SKELETON.contacts), :2]  # the first window, once the feet are down
    assert np.linalg.norm(np.diff(first, axis=1), axis=-1).mean() * 30 < 0.2 * 0.1


def test_learning_is_deterministic_and_goes_on_from_plain_arrays():
    one = learner(kinematic(speed=0.1))
    a, _ = one.learn(one.start(), np.full(3, 0.1), rate=0.1)
    b, _ = one.learn({k: torch.from_numpy(v.numpy().copy()) for k, v in one.start().items()}, np.full(3, 0.1), rate=0.1)
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_what_was_learned_fits_a_body_that_has_sunk_since():
    """Windows are as long as the body takes to fall from its height, which a later round may have changed."""
    first = kinematic(T=200)
    one = learner(first)
    x, _ = one.learn(one.start(), np.full(1, 0.1), rate=0.1)
    for sunk in np.linspace(-0.2, 0.3, 11) * SKELETON.root_height * LENGTH:
        later = learner(kinematic(T=200, sunk=sunk), base=first)
        assert later.controls(x, 0.1).target.shape[0] == later.windows.count == one.windows.count


def test_a_window_that_fell_is_not_trusted():
    t = np.arange(25) / 30
    upside = kinematic()
    R = Rotation.from_rotvec(t[:, None] * np.array([9.0, 0, 0])).as_matrix()  # spins in the air, far up
    nodes = np.einsum("tij,mj->tmi", R, SKELETON.rest() * LENGTH) + upside.position[:, None]
    one = learner(Kinematic(t, upside.position, R, upside.q, nodes, 0 * upside.contact))
    lost = one.simulate(one.start(), 0.0)
    assert lost.report["lost_windows"] == one.windows.count
    assert lost.trust.max() == 0
    assert np.isfinite(lost.nodes).all()


def test_the_term_pulls_towards_the_simulated_nodes_where_they_are_trusted():
    problem = SimpleNamespace(obs=SimpleNamespace(at=torch.arange(0, 10, 2)), kin=Kinematics(SKELETON))
    g = np.random.default_rng(0)
    nodes = g.normal(size=(10, len(SKELETON.names), 3))
    trust = np.ones(10)
    trust[4] = 0
    pull = term(Simulated(nodes, np.zeros((10, 4, 3)), trust), 2.0, problem)  # pyright: ignore[reportArgumentType]
    body = torch.tensor(nodes[::2] / 2.0, dtype=torch.float32)[None]
    state = lambda x: SimpleNamespace(body=SimpleNamespace(nodes=x, length=torch.tensor([0.25])))  # noqa: E731
    assert float(pull(state(body))) == pytest.approx(0, abs=1e-6)
    away = body.clone()
    away[:, :, :, 0] += 0.01
    away.requires_grad_()
    value = pull(state(away))
    assert value.shape == (1,)
    value.sum().backward()
    gradient = away.grad[0]
    assert float(value.detach()) > 0.1
    assert torch.all(gradient[2] == 0)
    assert torch.all(gradient[[0, 1, 3, 4]][..., 0] > 0)
    foot, other = SKELETON.contacts[0], SKELETON.index("nose")
    assert float(gradient[0, foot, 0]) == pytest.approx(3 * float(gradient[0, other, 0]), rel=1e-3)
