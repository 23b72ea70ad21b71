"""The parts of the fit: kinematics, projection, distances, flow, hypotheses."""

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from slomo.ground_path import whittaker
from slomo.pinhole import Intrinsics
from slomo.reconstruct import hypotheses, posture, silhouette
from slomo.reconstruct.hypotheses import GaitHypothesis
from slomo.reconstruct.kinematics import NODE_SPREAD, SHIFT_SPREAD, Kinematics, joint_rotation, rot
from slomo.reconstruct.refine_stage import stretch
from slomo.reconstruct.silhouette import Outline
from slomo.reconstruct.state import State
from slomo.skeleton import list_skeletons, load_skeleton


@pytest.fixture(params=list_skeletons())
def kin(request: pytest.FixtureRequest) -> Kinematics:
    return Kinematics(load_skeleton(request.param))


def _posed(kin: Kinematics, q: torch.Tensor, R: torch.Tensor, shape=None):
    H, T = q.shape[:2]
    return kin.pose(shape or kin.shape_variables(H), torch.zeros(H, T, 3), R.expand(H, T, 3, 3), q)


def test_joint_rotation_is_flexion_then_abduction_then_twist():
    q = torch.tensor([[0.3, -1.1, 0.7]])
    want = Rotation.from_euler("YXZ", [-1.1, 0.3, 0.7]).as_matrix()
    np.testing.assert_allclose(joint_rotation(q)[0].numpy(), want, atol=1e-6)


def test_the_rest_pose_is_the_skeletons(kin: Kinematics):
    body = _posed(kin, torch.zeros(1, 1, kin.B, 3), torch.eye(3))
    np.testing.assert_allclose(body.nodes[0, 0].numpy(), kin.skeleton.rest(), atol=1e-6)


def test_mirrored_angles_give_the_mirrored_body(kin: Kinematics):
    generator = torch.Generator().manual_seed(0)
    q = 0.4 * torch.randn(1, 1, kin.B, 3, generator=generator)
    shape = {k: torch.randn(v.shape, generator=generator) for k, v in kin.shape_variables(1).items()}
    other = torch.as_tensor(kin.skeleton.mirror[: kin.B])
    mirrored = q[:, :, other] * torch.tensor([-1.0, 1.0, -1.0])
    one, two = _posed(kin, q, torch.eye(3), shape), _posed(kin, mirrored, torch.eye(3), shape)
    a, b = one.nodes[0, 0].numpy(), two.nodes[0, 0].numpy()
    np.testing.assert_allclose(b[kin.skeleton.mirror] * [1, -1, 1], a, atol=1e-5)
    # The flesh too; a capsule that goes from left to right is its own mirror image with its ends exchanged.
    other = kin.skeleton.capsule_mirror
    pairs = other != np.arange(len(other))
    for end in ("a", "b"):
        flesh, image = getattr(one, end)[0, 0].numpy(), getattr(two, end)[0, 0].numpy()
        np.testing.assert_allclose(image[other][pairs] * [1, -1, 1], flesh[pairs], atol=1e-5)


def test_a_bone_that_is_not_the_skeletons_is_told_of_but_for_tails():
    kin = Kinematics(load_skeleton("quadruped"))
    shape = kin.shape_variables(1) | {"log_length": torch.tensor([0.7])}
    np.testing.assert_allclose(stretch(kin, shape), 1.0, atol=1e-6)
    node = dict(zip(kin.skeleton.names, kin.node_variable.tolist(), strict=True))
    shape["node"][0, [node["tail_mid"], node["tail_tip"]]] = -6.0
    np.testing.assert_allclose(stretch(kin, shape), 1.0, atol=1e-6)
    shape["node"][0, node["hind_left_hock"]] = 3.0
    changed = stretch(kin, shape)
    assert (changed > 1.3).sum() == 2  # it and the right one
    assert changed.max() < np.exp(3.0 * NODE_SPREAD)  # less, the shorter it is
    assert changed.min() == pytest.approx(1.0)
    shape["node"][0, [node["hind_left_hock"], node["tail_base"]]] = torch.tensor([0.0, 6.0])
    assert stretch(kin, shape).max() > 1.3  # where the tail begins is of the trunk


def test_bones_keep_their_lengths(kin: Kinematics):
    q = torch.randn(1, 5, kin.B, 3, generator=torch.Generator().manual_seed(1))
    x = _posed(kin, q, torch.eye(3)).nodes[0].numpy()
    link = kin.skeleton.link
    lengths = np.linalg.norm(x[:, 1:] - x[:, link[1:]], axis=-1)
    np.testing.assert_allclose(lengths, np.tile(np.linalg.norm(kin.skeleton.offset[1:], axis=1), (5, 1)), atol=1e-5)


def test_a_body_beside_its_feet_is_out_of_balance(kin: Kinematics):
    q = torch.zeros(3, 3, kin.B, 3)
    legs = [limb.swing for limb in kin.skeleton.limbs]
    if kin.skeleton.kind == "human":
        q[:, :, legs, 1] = 0.07  # feet a little behind: the weight is on the soles
    q[1, :, legs, 0] = 0.15  # all legs to the same side
    q[2, :, legs, 1] = -0.2  # all legs ahead
    body = _posed(kin, q, torch.eye(3))
    state = cast(State, SimpleNamespace(body=body, kin=kin, R_root=torch.eye(3).expand(3, 3, 3, 3)))
    straight, leaning, back = posture.balance(state).tolist()
    assert straight == pytest.approx(0, abs=0.02)
    assert leaning > 1
    assert back > 1 if kin.skeleton.kind == "human" else back == pytest.approx(0, abs=1e-6)


@pytest.fixture
def person() -> Kinematics:
    return Kinematics(load_skeleton("human"))


def _upright(kin: Kinematics, q: torch.Tensor, shape: dict[str, torch.Tensor]) -> torch.Tensor:
    R = torch.eye(3).expand(*q.shape[:2], 3, 3)
    body = kin.pose(shape, torch.zeros(*q.shape[:2], 3), R, q)
    return posture.upright(cast(State, SimpleNamespace(body=body, kin=kin, R_root=R, q=q, shape=shape)))


def test_who_rears_is_seen_to_and_pays_little_more_than_who_tilts(kin: Kinematics):
    q, pitch = torch.zeros(3, 2, kin.B, 3), torch.tensor([0.0, 0.3, 1.0])
    R = rot(1, -pitch)[:, None].expand(3, 2, 3, 3)
    cost = posture.limits(cast(State, SimpleNamespace(kin=kin, R_root=R, q=q)))
    level, tilted, rears = (cost - cost[0]).tolist()
    assert level == 0 < tilted < rears < 5 * tilted  # its square is eight times as large


def test_people_hold_trunk_and_head_upright_and_who_bends_down_pays_no_more_than_so_much(person: Kinematics):
    names, bends = person.skeleton.names, [0.0, 0.2, 0.4, 1.2, 1.4]
    assert [(names[a], names[b]) for a, b in person.upright] == [("pelvis", "neck"), ("neck", "head_top")]
    assert Kinematics(load_skeleton("quadruped")).upright == []
    for joint in ("spine_mid", "neck"):
        q = torch.zeros(len(bends), 2, person.B, 3)
        q[:, :, names.index(joint), 1] = torch.tensor(bends)[:, None]
        cost = _upright(person, q, person.shape_variables(len(bends)))
        assert cost[0] < 0.3  # at rest the head is a little ahead of the neck
        assert (cost.diff() > 0).all()
        assert cost[2] - cost[0] > 5 * (cost[4] - cost[3])


def test_a_person_is_not_built_leaning(person: Kinematics):
    """A trunk whose joints lie one ahead of the other by three hundredths costs more than an arm that is built so."""
    q, names = torch.zeros(1, 2, person.B, 3), person.skeleton.names
    rest = _upright(person, q, person.shape_variables(1))
    for part, costs in (("chest", True), ("left_hip", True), ("left_elbow", False), ("left_toe", False)):
        shape = person.shape_variables(1)
        shape["shift"][0, person.node_variable[names.index(part)], 0] = 0.03 / SHIFT_SPREAD
        assert bool(_upright(person, q, shape) - rest > 0.9) == costs


def test_arms_that_are_long_for_their_legs_cost_and_short_ones_do_not(person: Kinematics):
    names = person.skeleton.names
    assert [names[m] for m in person.of_arms] == ["left_elbow", "right_elbow", "left_wrist", "right_wrist"]
    assert not len(Kinematics(load_skeleton("quadruped")).of_arms)
    group = list(person.skeleton.group_names)
    shape = person.shape_variables(5)
    for n, (name, factor) in enumerate([("arm", 1.2), ("arm", 0.8), ("leg", 0.8), ("leg", 1.2)]):
        k = group.index(name)
        shape["group"][n + 1, k] = math.log(factor) / person.group_spread[k]
    shape["log_length"][:] = torch.tensor([0.0, 0.7, 0.0, -0.3, 0.0])  # a taller person's arms are longer
    cost = posture.short(cast(State, SimpleNamespace(kin=person, shape=shape)))
    np.testing.assert_allclose(cost.numpy(), [0, math.log(1.2), 0, -math.log(0.8), 0], atol=1e-5)


def _random_outline(generator: torch.Generator) -> list[torch.Tensor]:
    ends = 40 * torch.rand(4, 1, 1, 5, generator=generator, dtype=torch.float64)
    r = 1 + 4 * torch.rand(1, 1, 5, generator=generator, dtype=torch.float64)
    return [e.clone().requires_grad_() for e in (*ends, r, r)]


def test_distance_gradient_against_finite_differences():
    """With equal radii at both ends the written-out gradient is exact (see `_Distance`)."""
    generator = torch.Generator().manual_seed(3)
    args = _random_outline(generator)
    u, v = (40 * torch.rand(1, 6, generator=generator, dtype=torch.float64) for _ in range(2))
    z = torch.ones(1, 1, 5, dtype=torch.float64)

    def sd(ua, va, ub, vb, r):
        return silhouette.distances(Outline(ua, va, z, ub, vb, z, r, r), u, v)[0]

    assert torch.autograd.gradcheck(sd, args[:5], eps=1e-5, atol=1e-4)


def test_minima_and_their_gradients():
    """The smooth minimum is the logarithm of a sum of exponentials, and the gradients are those of what it says."""
    generator = torch.Generator().manual_seed(4)
    sd = 200 * torch.rand(1, 2, 3, 5, generator=generator, dtype=torch.float64)
    near = (sd.amin(-1, keepdim=True) + 3 * torch.rand(sd.shape, generator=generator, dtype=torch.float64)).clone()
    for x in (sd, near):
        soft, least, which = silhouette.nearest(x, 0.7)
        torch.testing.assert_close(soft, -0.7 * torch.logsumexp(x / -0.7, -1))
        torch.testing.assert_close(least, x.amin(-1))
        assert torch.equal(which, x.argmin(-1))
        assert torch.autograd.gradcheck(
            lambda y: silhouette.nearest(y, 0.7)[:2], [x.clone().requires_grad_()], atol=1e-5
        )
    of = torch.randint(5, (1, 2, 3, 2, 3), generator=generator)
    expected = sd.gather(-1, of.flatten(-2)).unflatten(-1, (2, 3)).amin(-1)
    torch.testing.assert_close(silhouette.least_of(sd, of), expected)
    assert torch.autograd.gradcheck(lambda y: silhouette.least_of(y, of), [sd.requires_grad_()], atol=1e-5)


def test_distance_of_a_tapered_capsule():
    one = lambda x: torch.tensor([[[float(x)]]])  # noqa: E731
    o = Outline(one(0), one(0), one(1), one(10), one(0), one(1), one(2), one(1))
    sd, h = silhouette.distances(o, torch.tensor([[5.0, -3.0, 12.0]]), torch.tensor([[4.0, 0.0, 0.0]]))
    np.testing.assert_allclose(sd[0, 0, :, 0].numpy(), [2.5, 1.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(h[0, 0, :, 0].numpy(), [0.5, 0.0, 1.0], atol=1e-5)


def test_the_surface_point_lies_on_the_pixels_ray_and_in_front():
    K = Intrinsics(100, 100, 50, 30, 100, 60)
    a, b = torch.tensor([[[[-0.2, 0.0, 2.0]]]]), torch.tensor([[[[0.2, 0.0, 2.0]]]])
    o = silhouette.outline(K, a, b, torch.tensor([[[0.1, 0.1]]]))
    u, v = torch.tensor([[50.0]]), torch.tensor([[30.0]])
    sd, h = silhouette.distances(o, u, v)
    c, meets = silhouette.visible(K, o, sd, h)
    assert meets.all()
    X = silhouette.surface(K, o, c, u, v)[0, 0, 0]
    np.testing.assert_allclose(X.numpy(), [0, 0, 1.9], atol=2e-3)


def test_the_nearer_of_two_capsules_is_seen():
    K = Intrinsics(100, 100, 50, 30, 100, 60)
    a = torch.tensor([[[[-0.2, 0.0, 2.0], [-0.2, 0.0, 1.5]]]])
    o = silhouette.outline(K, a, a + torch.tensor([0.4, 0, 0]), torch.full((1, 2, 2), 0.1))
    sd, h = silhouette.distances(o, torch.tensor([[50.0]]), torch.tensor([[30.0]]))
    assert int(silhouette.visible(K, o, sd, h)[0]) == 1


def test_feet_of_a_hypothetical_walk_go_back_in_stance_and_forward_in_swing():
    kin = Kinematics(load_skeleton("quadruped"))
    walk = next(g for g in kin.skeleton.gaits if g.name == "walk")
    t = np.linspace(0, 2, 200)
    g = GaitHypothesis("walk", 1.0, 0.0)
    q, contact = hypotheses.gait_pose(kin, walk, g, t, clock=t, speed=np.full(200, 0.8), leg=0.75)
    assert contact.mean(0) == pytest.approx([walk.duty] * 4, abs=0.02)
    body = _posed(kin, torch.as_tensor(q, dtype=torch.float32)[None], torch.eye(3))
    for n, limb in enumerate(kin.skeleton.limbs):
        x = body.nodes[0, :, limb.contact].numpy()
        v = np.gradient(x[:, 0], t)
        stands = contact[:, n] > 0
        inner = stands & np.roll(stands, 5) & np.roll(stands, -5)
        assert v[inner].mean() == pytest.approx(-0.8, rel=0.25)
        assert v[~stands].mean() > 0.5
        assert x[~stands, 2].max() > x[stands, 2].mean() + 0.05


def test_whittaker_keeps_a_line_and_drops_an_outlier():
    t = np.arange(60.0)
    y = np.stack([2 * t, -t], 1)
    y[30] += 500
    x = whittaker(y, np.ones(60), 4.0)
    np.testing.assert_allclose(x[20:25], y[20:25], atol=1.0)


def test_posture_angles_hold_every_combination(kin: Kinematics):
    angles, names = hypotheses.posture_angles(kin)
    assert len(angles) == math.prod(1 + len(p) for p in kin.skeleton.postures)
    assert names[0] == "rest"
    assert not angles[0].any()
    inside = (angles >= kin.lower) & (angles <= kin.upper)
    assert inside[:, 1:].all()
