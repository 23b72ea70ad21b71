"""Reach, forces and trunk of limbs with known answers."""

import numpy as np
import pinocchio as pin
import pytest

from slomo.robot_limbs import Point, force_limits, leg_root, reach, underside


def chain(*lengths):
    """Revolute joints about y on a free-flyer, each a length (m) along x after the last; (model, joint ids)."""
    model = pin.Model()
    parent = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    for i, offset in enumerate([0.0, *lengths[:-1]]):
        place = pin.SE3(np.eye(3), np.array([offset, 0, 0]))
        parent = model.addJoint(parent, pin.JointModelRY(), place, f"joint{i}")
    return model, parent


@pytest.mark.parametrize(
    ("knee", "nearest", "farthest"),
    [
        ((-3.0, 3.0), np.hypot(0.3 + 0.2 * np.cos(3.0), 0.2 * np.sin(3.0)), 0.5),  # the knee passes through straight
        ((0.5, 2.0), np.sqrt(0.13 + 0.12 * np.cos(2.0)), np.sqrt(0.13 + 0.12 * np.cos(0.5))),
    ],
)
def test_reach_of_two_links(knee, nearest, farthest):
    model, foot = chain(0.3, 0.2)
    limits = np.array([[-1.0, knee[0]], [1.0, knee[1]]])
    q = np.concatenate([pin.neutral(model)[:7], limits.mean(axis=0)])
    got = reach(model, q, Point(1, np.zeros(3)), Point(foot, np.array([0.2, 0, 0])), lower=limits[0], upper=limits[1])
    np.testing.assert_allclose(got, [nearest, farthest], rtol=1e-6)


def test_reach_of_seven_links_is_their_length():
    lengths = np.array([0.2, 0.1, 0.15, 0.1, 0.05, 0.1, 0.08])
    model, hand = chain(*lengths)
    bounds = np.full(7, 2.5)
    q = np.concatenate([pin.neutral(model)[:7], np.full(7, 0.7)])
    root, tip = Point(1, np.zeros(3)), Point(hand, np.array([0.08, 0, 0]))
    nearest, farthest = reach(model, q, root, tip, lower=-bounds, upper=bounds)
    assert farthest == pytest.approx(lengths.sum(), rel=1e-6)
    assert nearest < 1e-3


@pytest.mark.parametrize(
    ("offset", "at"),
    [
        ([0.0, 0.08, 0.0], [0.2, 0.1, 0.05]),  # across the leg: its length does not depend on the first joint
        ([0.05, 0.0, 0.0], [0.25, 0.1, 0.05]),  # along the first joint's axis: it moves no hip
    ],
)
def test_leg_root(offset, at):
    """A hip joint about x at (0.2, 0.1, 0.05) carries, at an offset, a thigh joint about y and a foot 0.4 m below."""
    model = pin.Model()
    trunk = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    first = model.addJoint(trunk, pin.JointModelRX(), pin.SE3(np.eye(3), np.array([0.2, 0.1, 0.05])), "hip")
    thigh = model.addJoint(first, pin.JointModelRY(), pin.SE3(np.eye(3), np.array(offset)), "thigh")
    model.addFrame(pin.Frame("thigh_link", thigh, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    model.addFrame(pin.Frame("foot", thigh, 0, pin.SE3(np.eye(3), np.array([0, 0, -0.4])), pin.FrameType.BODY))
    q = pin.neutral(model)
    q[:3] = 3.0, 2.0, 1.0
    root = leg_root(model, q, "thigh_link", "foot", lower=np.full(2, -1.0), upper=np.full(2, 1.0))
    assert root.joint == 1
    np.testing.assert_allclose(root.at, at, atol=1e-12)


def test_force_limits_of_one_leg():
    """A joint about y with an arm of 0.5 m along x bears 20 / 0.5 N of height, and one about z the same to the side."""
    J = np.zeros((1, 3, 2))
    J[0, 2, 0] = 0.5
    J[0, 1, 1] = 0.5
    np.testing.assert_allclose(force_limits(J, np.array([20.0, 10.0])), [[20.0, 20.0, 40.0]])


def test_a_shared_joint_is_shared_and_the_rest_goes_to_who_can_use_it():
    """Toe and heel load the knee (joint 0) alike; an ankle (joint 1) is weak under the toe, the heel gets the rest."""
    J = np.zeros((2, 3, 2))
    J[:, 2, 0] = 0.1  # knee
    J[:, 2, 1] = [0.15, -0.05]  # ankle: opposite ways
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    toe, heel = force_limits(J, np.array([100.0, 30.0]))[:, 2]
    assert toe == pytest.approx(200.0)  # 30 / 0.15
    assert heel == pytest.approx(600.0)  # 30 / 0.05, under the knee's 100 / 0.1 - 200
    toe, heel = force_limits(J, np.array([50.0, 30.0]))[:, 2]
    assert toe == pytest.approx(200.0)
    assert heel == pytest.approx(300.0)  # what the knee has left


def test_horizontal_limits_turn_with_nothing():
    rng = np.random.default_rng(0)
    J, effort = rng.normal(size=(3, 3, 5)), rng.uniform(1, 20, 5)
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    limits = force_limits(J, effort)
    np.testing.assert_allclose(force_limits(np.einsum("ij,cjk->cik", R, J), effort), limits)
    np.testing.assert_allclose(force_limits(J, 3 * effort), 3 * limits)


@pytest.mark.parametrize(
    ("shape", "rpy", "low"),
    [
        ('<box size="0.2 0.4 0.6"/>', "0 0 0", -0.3),
        ('<box size="0.2 0.4 0.6"/>', "1.5707963267948966 0 0", -0.2),
        ('<sphere radius="0.1"/>', "1 2 3", -0.1),
        ('<cylinder radius="0.1" length="0.6"/>', "0 0 0", -0.3),
        ('<cylinder radius="0.1" length="0.6"/>', "0 1.5707963267948966 0", -0.1),
        ('<cylinder radius="0.1" length="0.6"/>', "0.7853981633974483 0 0", -0.4 * np.sqrt(0.5)),
        ('<capsule radius="0.1" length="0.6"/>', "0 0 0", -0.4),
    ],
)
def test_underside(tmp_path, shape, rpy, low):
    urdf = tmp_path / "a.urdf"
    urdf.write_text(
        f'<robot name="a"><link name="trunk"><collision><origin xyz="1 2 0.05" rpy="{rpy}"/>'
        f'<geometry>{shape}</geometry></collision></link><link name="bare"/></robot>'
    )
    place = pin.SE3(np.eye(3), np.array([0, 0, 0.5]))
    assert underside(urdf, (), {"trunk": place}) == pytest.approx(low + 0.55)
    assert underside(urdf, (), {"bare": place}) == np.inf
