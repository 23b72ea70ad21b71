"""Known answers of the roll-out: falling, standing, sliding, holding, momentum; its gradients; masses and inertias."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from slomo.flesh import Cone
from slomo.gravity import GRAVITY
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.physics.model import Body, Mechanics, build, solid
from slomo.reconstruct.physics.rollout import LEARNED, Controls, RollOut
from slomo.skeleton import load_skeleton

SKELETON = load_skeleton("quadruped")
LENGTH = 0.5


def animal(mechanics=None, skeleton=SKELETON, length=LENGTH) -> Body:
    """A skeleton's body as it is written."""
    kin = Kinematics(skeleton)
    still = torch.zeros(1, 1, 3), torch.eye(3)[None, None], torch.zeros(1, 1, kin.B, 3)
    return build(skeleton, kin.pose(kin.shape_variables(1), *still), unit=length, mechanics=mechanics)


def block(*, contacts: bool) -> Body:
    """One link of 2 kg, 0.4 x 0.4 x 0.1 m about its origin, with its lower corners as contact points."""
    corners = np.array([[x, y, -0.05] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])[: 4 if contacts else 0]
    n, inertia = len(corners), 2 / 12 * np.diag([0.17, 0.17, 0.32])
    return Body(
        np.array([-1]), np.array([-1]), np.zeros((1, 3)), np.array([2.0]), np.zeros((1, 3)), inertia[None],
        np.zeros(n, int), corners.reshape(-1, 3), np.zeros(n), np.full(n, -1), 0.4, Mechanics(),
    )  # fmt: skip


def controls(body: Body, steps: int, *, height: float, windows: int = 1) -> Controls:
    """At rest at a height, targets at zero."""
    N, B, m = windows, len(body.parent), body.mechanics
    place = torch.tensor([0.0, 0.0, height]).expand(N, 3).clone()
    upright = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(N, 4).clone()
    return Controls(
        target=torch.zeros(N, steps + 1, B, 3), position=place, quaternion=upright, velocity=torch.zeros(N, 3),
        spin=torch.zeros(N, 3), mass_scale=torch.ones(N, B), ke=torch.full((N,), m.ke * body.weight / body.length),
        kd=torch.full((N,), m.kd / np.sqrt(GRAVITY * body.length)), gravity=torch.full((N,), GRAVITY),
        assistance=torch.zeros(N), guide_position=place[:, None].expand(N, steps + 1, 3).clone(),
        guide_quaternion=upright[:, None].expand(N, steps + 1, 4).clone(),
    )  # fmt: skip


def roll_out(body: Body, c: Controls, *, dt: float = 0.002):
    N, steps = c.target.shape[0], c.target.shape[1] - 1
    roll = RollOut(body, np.linspace(0, steps, 11)[None].repeat(N, 0), steps=steps, dt=dt)
    return roll, roll(c)


def test_a_free_body_falls_with_g_and_keeps_its_spin():
    body = block(contacts=False)
    c = controls(body, 200, height=5.0)
    c.velocity[:] = torch.tensor([0.3, 0.0, 1.0])
    c.spin[:] = torch.tensor([0.0, 0.0, 2.0])
    seen = roll_out(body, c)[0].watched()
    t = 0.4
    assert seen.p[0, -1, 0] == pytest.approx([0.3 * t, 0, 5 + t - GRAVITY * t * (t + 0.002) / 2], abs=1e-4)
    assert seen.w[0, -1, 0] == pytest.approx([0, 0, 2], abs=1e-5)
    assert 2 * np.arctan2(seen.q[0, -1, 0, 2], seen.q[0, -1, 0, 3]) == pytest.approx(2 * t, abs=1e-4)


def test_standing_forces_sum_to_the_weight_and_joints_hold():
    body = animal()
    roll, _ = roll_out(body, controls(body, 1500, height=SKELETON.root_height * LENGTH))
    seen = roll.watched()
    force = seen.force[0, -250:].sum(1).mean(0)
    assert force[2] == pytest.approx(body.weight, rel=0.01)
    assert abs(force[:2]).max() < 0.02 * body.weight
    # Only the feet carry, and the body has sunk by little: joints and ground are springs.
    carried = seen.force[0, -1, body.contact_node >= 0, 2].sum()
    assert carried == pytest.approx(seen.force[0, -1, :, 2].sum(), rel=0.02)
    assert seen.p[0, -1, 0, 2] == pytest.approx(SKELETON.root_height * LENGTH, abs=0.05 * LENGTH)
    feet = [SKELETON.link[c] for c in SKELETON.contacts]
    assert np.abs(seen.p[0, -1, feet] - seen.p[0, 250, feet])[:, :2].max() < 0.003


def test_a_sliding_body_slows_down_with_mu_g_and_then_rests():
    body = replace(block(contacts=True), mechanics=Mechanics(mu=0.5))
    c = controls(body, 500, height=0.05 - 0.4 / 400)
    c.velocity[:] = torch.tensor([2.0, 0.0, 0.0])
    seen = roll_out(body, c)[0].watched()
    v = seen.v[0, :, 0, 0]
    assert (v[50] - v[150]) / 0.2 == pytest.approx(0.5 * GRAVITY, rel=0.02)
    assert abs(v[-1]) < 1e-3
    push = seen.force[0, 150:]
    assert np.all(np.linalg.norm(push[..., :2], axis=-1) <= 0.5 * push[..., 2] * 1.05 + 1e-3)


def test_momentum_is_kept_without_gravity_and_ground():
    body = animal(Mechanics(stiffness=0.3))
    c = controls(body, 200, height=3.0)
    c.gravity[:] = 0
    c.velocity[:] = torch.tensor([0.4, -0.2, 0.1])
    c.spin[:] = torch.tensor([0.5, 0.8, -0.3])
    wave = torch.sin(torch.linspace(0, 1, 201))[None, :, None, None]
    c.target[:] = 0.4 * wave * torch.randn(1, 1, len(body.parent), 3, generator=torch.Generator().manual_seed(0))
    seen = roll_out(body, c, dt=0.0005)[0].watched()
    momentum = np.array([_momentum(body, seen, s) for s in (0, 100, 200)])
    size = np.abs(momentum).max(0)
    assert momentum[1:] == pytest.approx(np.broadcast_to(momentum[0], (2, 6)), abs=0.005 * size.max())


def _momentum(body: Body, seen, s: int) -> np.ndarray:
    """Linear momentum, and angular momentum about the place of the centre of mass."""
    from scipy.spatial.transform import Rotation

    p, v, w = seen.p[0, s], seen.v[0, s], seen.w[0, s]
    R = Rotation.from_quat(seen.q[0, s]).as_matrix()
    c = (R @ body.com[..., None])[..., 0]
    m = body.mass[:, None]
    vc = v + np.cross(w, c)
    middle = (m * (p + c)).sum(0) / m.sum()
    own = body.inertia - body.mass[:, None, None] * np.array([x @ x * np.eye(3) - np.outer(x, x) for x in body.com])
    spin = (R @ own @ R.transpose(0, 2, 1) @ w[..., None])[..., 0]
    return np.concatenate([(m * vc).sum(0), (spin + np.cross(p + c - middle, m * vc)).sum(0)])


def test_assistance_holds_the_root_and_is_reported():
    body = animal()
    c = replace(controls(body, 1000, height=1.0), assistance=torch.ones(1))
    seen = roll_out(body, c)[0].watched()
    assert np.abs(seen.p[0, -1, 0] - [0, 0, 1]).max() < 0.1 * LENGTH
    assert seen.wrench[0, -1, 0, 2] == pytest.approx(body.weight, rel=0.02)


@pytest.mark.parametrize("name", LEARNED)
def test_gradients_are_the_finite_differences(name):
    body = animal(Mechanics(stiffness=1.0))
    g = torch.Generator().manual_seed(1)
    c = controls(body, 60, height=SKELETON.root_height * LENGTH + 0.005, windows=2)
    c.velocity[:] = torch.tensor([0.5, 0.1, -0.3])
    c.assistance[:] = 0.1
    t = torch.linspace(0, 0.5, 61)[None, :, None, None]
    random = lambda: torch.randn(2, 1, len(body.parent), 3, generator=g)  # noqa: E731
    c.target[:] = 0.1 * torch.sin(3 * t + random())
    size = dict(
        target=0.2, position=0.01, quaternion=0.05, velocity=0.1, spin=1.0, mass_scale=0.3, ke=0.3, kd=0.5, gravity=2.0
    )[name]
    x = getattr(c, name)
    way = random() * torch.sin(5 * t) if name == "target" else torch.randn(x.shape, generator=g)
    if name in ("ke", "kd"):
        way = way * x
    elif name == "quaternion":  # only its own turns are rotations
        way[:, 3] = 0
    weights = torch.randn(2, 11, len(SKELETON.names), 3, generator=g)

    def value(x: torch.Tensor) -> torch.Tensor:
        if name == "quaternion":
            x = torch.nn.functional.normalize(x, dim=-1)
        return (roll_out(body, replace(c, **{name: x}))[1].double() * weights).sum()

    x = x.clone().requires_grad_()
    value(x).backward()
    along = float((x.grad * way).sum()) * size
    h = 0.004 if name in ("target", "position", "quaternion") else 0.1  # contact is far from linear

    def slope(h: float) -> float:
        with torch.no_grad():
            return float(value(x + h * size * way) - value(x - h * size * way)) / (2 * h)

    # Richardson: what central differences err by falls with the square of the step.
    assert along == pytest.approx((4 * slope(h / 2) - slope(h)) / 3, rel=0.01, abs=2e-4)


def test_it_is_deterministic_and_windows_do_not_touch_each_other():
    body = animal()
    c = controls(body, 100, height=0.5, windows=3)
    c.velocity[1] = 1.0
    a, b = roll_out(body, c)[1], roll_out(body, c)[1]
    assert torch.equal(a, b)
    assert torch.equal(a[0], a[2])
    alone = Controls(**{f.name: getattr(c, f.name)[1:2] for f in fields(Controls)})
    assert torch.equal(roll_out(body, alone)[1][0], a[1])


def test_mass_and_inertia_of_a_capsule_are_known():
    r, h = 0.1, 0.3
    volume, first, second = solid([Cone(0, np.array([0.2, 0, 0]), np.array([0.2, 0, h]), r, r)], 1, cell=0.005)
    cylinder, ball = np.pi * r**2 * h, 4 / 3 * np.pi * r**3
    assert volume[0] == pytest.approx(cylinder + ball, rel=0.01)
    assert first[0] / volume[0] == pytest.approx([0.2, 0, h / 2], abs=0.001)
    along = cylinder * r**2 / 2 + ball * 0.4 * r**2
    across = cylinder * (h**2 / 12 + r**2 / 4) + ball * (0.4 * r**2 + h**2 / 4 + 3 / 8 * h * r)
    about = second[0] - np.outer(first[0], first[0]) / volume[0]
    inertia = np.eye(3) * np.trace(about) - about
    assert np.diag(inertia) == pytest.approx([across, across, along], rel=0.015)
    assert inertia[0, 2] == pytest.approx(0, abs=0.001 * across)


def test_flesh_where_cones_overlap_counts_once():
    cone = Cone(0, np.zeros(3), np.array([0.0, 0, 0.3]), 0.1, 0.1)
    alone = solid([cone], 2, cell=0.01)[0]
    both = solid([cone, replace(cone, bone=1, a=np.array([0.0, 0, 0.1]))], 2, cell=0.01)[0]
    assert both.sum() == pytest.approx(alone.sum())


@pytest.mark.parametrize("name", ["quadruped", "human"])
def test_bodies_are_plausible(name):
    skeleton = load_skeleton(name)
    length = skeleton.typical_length
    body = animal(skeleton=skeleton, length=length)
    assert body.offset == pytest.approx(skeleton.offset * length, abs=1e-6)
    if name == "human":
        assert 45 < body.mass.sum() < 95
    own = body.inertia - body.mass[:, None, None] * np.array([x @ x * np.eye(3) - np.outer(x, x) for x in body.com])
    moments = np.linalg.eigvalsh(own)
    assert moments.min() > 0
    assert np.all(moments[:, 2] < moments[:, 0] + moments[:, 1] + 1e-9)
    assert np.all(np.diff(body.contact_link) >= 0)
    # At rest on its feet nothing else touches the ground.
    rest = skeleton.rest() * length
    other = body.contact_node < 0
    z = rest[body.contact_link, 2] + body.contact_place[:, 2] + skeleton.root_height * length - body.contact_radius
    assert z[other].min() > -0.011 * length
    assert z[~other] == pytest.approx(0, abs=0.011 * length)
