"""The point-foot model of every robot: it weighs, swings, reaches and pushes as the robot does."""

import itertools

import numpy as np
import pinocchio as pin
import pytest

from slomo.errors import InvalidData
from slomo.pointfoot import PointFootModel
from slomo.robot import list_robots, load_robot

every_robot = pytest.mark.parametrize("robot", [load_robot(name) for name in list_robots()], ids=lambda r: r.name)


def point_inertia(x):
    return x @ x * np.eye(3) - np.outer(x, x)


@every_robot
def test_mass_balance_and_inertia_are_the_robots(robot):
    model, whole = PointFootModel.from_robot(robot), robot.composite
    assert model.total_mass == pytest.approx(robot.mass, rel=1e-9)
    # The base is the body's centre of mass, so that body and feet together balance where the robot does.
    com = model.foot_mass @ robot.nominal_feet / model.total_mass
    np.testing.assert_allclose(com, whole.lever, atol=1e-9)
    np.testing.assert_allclose(robot.body.lever, 0, atol=1e-12)
    # Together they turn as the robot does; a quadruped's feet weigh with their rotors.
    inertia = model.inertia + model.mass * point_inertia(com)
    for m, foot in zip(model.foot_mass, robot.nominal_feet, strict=True):
        inertia = inertia + m * point_inertia(foot - com)
    ratio = np.diag(inertia) / np.diag(whole.inertia)
    assert np.all((ratio > 0.999) & (ratio < (2.0 if robot.kind == "quadruped" else 1.25)))
    moments = np.linalg.eigvalsh(model.inertia)
    assert 0 < moments[0] <= moments[2] <= moments[0] + moments[1]


@every_robot
def test_legs_reach_the_nominal_pose_and_what_random_joints_reach(robot):
    model, data = PointFootModel.from_robot(robot), robot.model.createData()
    nominal = np.linalg.norm(robot.nominal_feet - model.leg_roots, axis=1)
    assert np.all((model.leg_min < nominal) & (nominal < model.leg_max))
    assert np.all(robot.nominal_feet[:, 2] <= -model.clearance)
    rng = np.random.default_rng(0)
    single = [c for c in range(model.C) if c not in model.pairs]
    for _ in range(300):
        q = np.concatenate([robot.q_nominal[:7], rng.uniform(robot.lower, robot.upper)])
        pin.framesForwardKinematics(robot.model, data, q)
        feet, hips = (
            np.array([data.oMf[robot.model.getFrameId(n)].translation for n in names])
            for names in (robot.foot_names, [limb.hip for limb in robot.limbs])
        )
        length = np.linalg.norm(feet - hips, axis=1)
        assert np.all(length >= robot.leg_reach[:, 0] - 1e-6)
        assert np.all(length[single] <= robot.leg_reach[single, 1] + 1e-6)
        if robot.kind == "quadruped":  # one joint carries the hip: its axis bounds the foot exactly
            root = np.linalg.norm(robot.frames_in_base(q, robot.foot_names) - model.leg_roots, axis=1)
            assert np.all((root >= robot.root_reach[:, 0] - 1e-6) & (root <= robot.root_reach[:, 1] + 1e-6))
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(feet[model.pairs], axis=1)[:, 0], axis=1), model.pair_length, atol=1e-9
        )


@every_robot
def test_forces_are_what_the_joints_bear_and_no_less(robot):
    model, data = PointFootModel.from_robot(robot), robot.model.createData()
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    pin.computeJointJacobians(robot.model, data, robot.q_nominal)
    pin.updateFramePlacements(robot.model, data)
    J = [pin.getFrameJacobian(robot.model, data, robot.model.getFrameId(n), world)[:3, 6:] for n in robot.foot_names]
    np.testing.assert_array_equal(model.u_max[:, 0], model.u_max[:, 1])  # any heading

    loads = np.array([np.abs(j).max(axis=0) > 1e-6 for j in J])  # (C, nj), which limb loads which joint
    reached = np.zeros((2, model.C))
    directions = [(0, np.array([np.cos(a), np.sin(a), 0.0])) for a in np.linspace(0, np.pi, 37)]
    for on in itertools.product([0.0, 1.0], repeat=model.C):
        for kind, d in [*directions, (1, np.array([0.0, 0.0, 1.0]))]:
            forces = np.outer(on * model.u_max[:, 2 * kind], d)
            ratio = np.abs(sum(j.T @ f for j, f in zip(J, forces, strict=True))) / robot.effort
            assert ratio.max() <= 1 + 1e-9
            reached[kind] = np.maximum(reached[kind], np.array(on) * np.where(loads, ratio, 0).max(axis=1))
    # No limit could be greater: alone or with the others, each takes a joint that it loads to its effort.
    assert np.all(reached > 0.99)
    # The legs carry the robot.
    assert model.u_max[robot.feet, 2].sum() > 1.5 * model.total_mass * model.g


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pairs": np.array([[0, 4]]), "pair_length": np.array([0.2])}, "columns of 0 to 3"),
        ({"pairs": np.array([[0, 0]]), "pair_length": np.array([0.2])}, "different columns"),
        ({"pairs": np.array([[0, 1]]), "pair_length": np.array([0.0])}, "above 0"),
        ({"clearance": np.zeros(3)}, "clearance"),
    ],
)
def test_nonsense(changes, message):
    values = {f: getattr(PointFootModel.from_robot(load_robot("go1")), f) for f in PointFootModel.__dataclass_fields__}
    with pytest.raises(InvalidData, match=message):
        PointFootModel(**(values | changes))
