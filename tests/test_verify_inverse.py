"""From a reference to joints: against Pinocchio's forward dynamics, out of reach, and with redundant joints."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from references import carrying, follow, standing
from slomo.motion import Reference
from slomo.optimize import problem
from slomo.optimize.inverse import Legs, joint_motion
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot

ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)
BODY = np.array([0.0, 0.0, ROBOT.standing_height, 0, 0, 0, 1])
FEET = ROBOT.nominal_feet * [1, 1, 0]
WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def seen_from_outside(robot, q, v):
    """The point-foot state of a whole robot's, laid out as in `motion.Reference`."""
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, q, v)
    pin.updateFramePlacements(model, data)
    base = model.getFrameId(robot.base)
    twist = pin.getFrameVelocity(model, data, base, WORLD)
    feet = [model.getFrameId(n) for n in robot.foot_names]
    pose = pin.SE3ToXYZQUAT(data.oMf[base])
    spin = data.oMf[base].rotation.T @ twist.angular
    return (
        np.concatenate([pose, *(data.oMf[f].translation for f in feet)]),
        np.concatenate([twist.linear, spin, *(pin.getFrameVelocity(model, data, f, WORLD).linear for f in feet)]),
    )


def test_torques_that_made_the_motion_are_found_again():
    """One step of forward dynamics from a state with everything in motion; the inverse returns its torques."""
    rng = np.random.default_rng(1)
    model, data, h = ROBOT.model, ROBOT.model.createData(), 0.01
    q = ROBOT.q_nominal.copy()
    q[3:7] = Rotation.from_rotvec([0.3, -0.4, 1.0]).as_quat()
    q[7:] += rng.uniform(-0.2, 0.2, 12)
    v = rng.normal(0, 1.0, 18)
    tau, lam = rng.normal(0, 5, 12), rng.normal(0, 20, (4, 3))
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    feet = [model.getFrameId(n) for n in ROBOT.foot_names]
    J = np.vstack([pin.getFrameJacobian(model, data, f, WORLD)[:3] for f in feet])
    a = pin.aba(model, data, q, v, np.concatenate([np.zeros(6), tau]) + J.T @ lam.ravel())
    before, base = seen_from_outside(ROBOT, q, v), model.getFrameId(ROBOT.base)
    # The reference's integrator: the new velocities carry positions; the base's linear one lives in the world.
    v1 = v + h * a
    after = seen_from_outside(ROBOT, pin.integrate(model, q, h * v1), v1)
    speed = seen_from_outside(ROBOT, q, v1)[1]
    pin.forwardKinematics(model, data, q, v, a)
    speed[:3] = before[1][:3] + h * pin.getFrameClassicalAcceleration(model, data, base, WORLD).linear
    r = Reference(
        t=np.array([0, h]), h=np.array([h]), q=np.stack([before[0], after[0]]), v=np.stack([before[1], speed]),
        u=np.zeros((1, 12)), lam=lam[None], point_names=ROBOT.foot_names, robot_digest="",
    )  # fmt: skip
    found = joint_motion(ROBOT, r)
    assert found.miss.max() < 1e-6
    assert np.allclose(found.q[0, 7:], q[7:], atol=1e-5)
    assert np.allclose(found.q[0, :3], q[:3], atol=1e-12)
    assert np.allclose(found.v[0], v, atol=1e-4)
    assert np.allclose(found.tau[0], tau, atol=2e-3)
    assert np.allclose(found.root_wrench[0], 0, atol=2e-3)


def test_standing_torques_are_those_of_statics():
    """The thigh carries its foot's force at its lever; the limb's own weight is the difference to J^T u."""
    rest = standing(MODEL, BODY, FEET, steps=2)
    found = joint_motion(ROBOT, rest)
    assert found.miss.max() < 1e-6
    assert np.abs(found.v).max() < 1e-4
    lever = ROBOT.nominal_feet[0, 0] - ROBOT.nominal_hips[0, 0]
    assert abs(found.tau_static[0, 1]) == pytest.approx(abs(lever) * rest.u[0, 2], rel=1e-3)
    data = ROBOT.model.createData()
    J = pin.computeFrameJacobian(ROBOT.model, data, found.q[0], ROBOT.model.getFrameId(ROBOT.foot_names[0]), WORLD)[:3]
    gravity = pin.computeGeneralizedGravity(ROBOT.model, data, found.q[0])
    assert np.allclose(found.tau[0, :3], (gravity - J.T @ rest.lam[0, 0])[6:9], atol=1e-6)
    assert np.allclose(found.root_wrench[:, :3], 0, atol=1e-3)  # all of the weight is on the feet


def test_joint_speeds_follow_the_knots():
    """The body sinks at constant speed between feet that stand still."""
    rest = standing(MODEL, BODY, FEET, steps=10)
    q, v = rest.q.copy(), rest.v.copy()
    q[:, 2] -= 0.1 * rest.t
    v[:, 2] = -0.1
    found = joint_motion(ROBOT, replace(rest, q=q, v=v))
    assert np.allclose(found.q[1:, 7:] - found.q[:-1, 7:], rest.h[:, None] * found.v[1:, 6:])
    assert np.allclose(found.v[0, 6:], found.v[1, 6:], atol=0.02)
    for k in (0, 5):
        assert np.allclose(seen_from_outside(ROBOT, found.q[k], found.v[k])[1][6:], 0, atol=3e-3 if k else 1e-6)


def test_out_of_reach_is_missed_by_as_little_as_the_limits_allow():
    points = FEET.copy()
    points[0, 2] -= 0.5
    found = joint_motion(ROBOT, standing(MODEL, BODY, points, steps=1))
    hip = ROBOT.nominal_hips[0] + BODY[:3]
    assert found.miss[0, 1:].max() < 1e-6
    assert found.miss[0, 0] == pytest.approx(np.linalg.norm(points[0] - hip) - ROBOT.leg_reach[0, 1], abs=5e-3)
    assert np.all((found.q[:, 7:] >= ROBOT.lower) & (found.q[:, 7:] <= ROBOT.upper))


def test_a_joint_at_its_limit_is_made_up_for_by_others():
    """With one hip locked the foot cannot go sideways, but the joints below still do what they can."""
    points = FEET.copy()
    points[0] += [0.05, 0.03, 0.0]
    locked = ROBOT.upper.copy()
    locked[0] = ROBOT.q_nominal[7] + 1e-3
    found = joint_motion(replace(ROBOT, upper=locked), standing(MODEL, BODY, points, steps=1))
    assert 0.02 < found.miss[0, 0] < 0.031
    assert found.q[0, 7] == pytest.approx(locked[0])


def reaching(robot):
    """A humanoid that bends, turns and raises its hands while it lifts a foot: a reference that is only kinematics."""
    t = np.linspace(0, 3, 61)
    size = robot.standing_height
    body = size * np.stack([0.06 * np.sin(3 * t), 0.04 * np.sin(2 * t), 0.06 * np.cos(4 * t) - 0.09], axis=1)
    body[:, 2] += robot.standing_height
    turn = Rotation.from_euler("zyx", np.stack([0.3 * np.sin(2 * t), 0.2 * np.sin(3 * t), 0.1 * np.sin(t)], axis=1))
    points = np.tile(robot.nominal_feet + [0, 0, robot.standing_height], (61, 1, 1))
    lift = 0.13 * size * np.maximum(0, np.sin(2 * np.pi * t / 1.5))
    points[:, :2, 2] += lift[:, None]
    raised = 0.2 * size * (1 - np.cos(2 * t))
    points[:, 4:, 2] += raised[:, None]
    points[:, 4, :2] += 0.1 * size * np.stack([np.sin(2 * t), np.sin(3 * t)], axis=1)
    q = np.concatenate([body, turn.as_quat(), points.reshape(61, -1)], axis=1)
    lam = np.zeros((60, 6, 3))
    lam[:, 2:4, 2] = robot.mass * 9.81 / 2
    zero = np.zeros((60, 18))
    return Reference(t, np.diff(t), q, problem.velocities(t, q), zero, lam, robot.foot_names, robot.digest)


@pytest.mark.parametrize("name", ["g1", "talos"])
def test_redundant_joints_move_smoothly_and_soles_stay_flat(name):
    robot = load_robot(name)
    r = reaching(robot)
    found = joint_motion(robot, r)
    assert found.miss.max() < 5e-3
    assert np.median(found.miss) < 1e-6
    joints = found.q[:, 7:]
    assert np.all((joints >= robot.lower) & (joints <= robot.upper))
    # No jump: no joint turns much faster than feet and body, which move at 1 m/s at most.
    assert np.abs(found.v[:, 6:]).max() < 6.0
    for toe, heel in robot.pairs:
        frame = robot.model.getFrameId(robot.foot_names[toe])
        sole = rotation(robot, robot.q_nominal, frame).T @ [0, 0, 1]
        for k in (0, 20, 40):
            across = np.cross([0, 0, 1], r.points[k, toe] - r.points[k, heel])
            assert abs(across @ rotation(robot, found.q[k], frame) @ sole) < 0.01 * np.linalg.norm(across)


def rotation(robot, q, frame):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[frame].rotation


def test_a_standing_humanoid_needs_no_help_at_its_root():
    robot = load_robot("g1")
    model = PointFootModel.from_robot(robot)
    body = np.array([0.0, 0.0, robot.standing_height, 0, 0, 0, 1])
    points = robot.nominal_feet + body[:3]
    on = np.isin(np.arange(6), robot.feet)
    lam = carrying(model, body[:3], points, on=on)
    rest = follow(model, np.full(3, 0.05), np.tile(points, (4, 1, 1)), np.tile(lam, (3, 1, 1)), body=body)
    found = joint_motion(robot, rest)
    assert found.miss.max() < 1e-9
    assert np.allclose(found.q[:, 7:], robot.q_nominal[7:], atol=1e-9)
    assert np.allclose(found.root_wrench, 0, atol=1e-6)
    assert np.all(np.abs(found.tau) < robot.effort)


@pytest.mark.parametrize(("name", "share"), [("go1", 0.6), ("talos", 0.2), ("atlas", 0.2)])
def test_what_joints_can_reach_is_reached(name, share):
    """Poses drawn at random, `share` of the way from the nominal joints to any within their limits."""
    robot, rng = load_robot(name), np.random.default_rng(0)
    C = len(robot.limbs)
    for _ in range(10):
        q = robot.q_nominal.copy()
        q[7:] += share * (rng.uniform(robot.lower, robot.upper) - q[7:])
        x, _ = seen_from_outside(robot, q, np.zeros(robot.model.nv))
        r = Reference(
            t=np.array([0, 1.0]), h=np.ones(1), q=np.stack([x, x]), v=np.zeros((2, 6 + 3 * C)),
            u=np.zeros((1, 3 * C)), lam=np.zeros((1, C, 3)), point_names=robot.foot_names, robot_digest="",
        )  # fmt: skip
        assert joint_motion(robot, r).miss.max() < 1e-4


def test_a_limb_comes_back_from_its_limits_when_its_points_do():
    """A foot that starts turned backwards leads its leg into another minimum; what comes next is reached."""
    robot = load_robot("g1")
    legs = Legs(robot)
    x, _ = seen_from_outside(robot, robot.q_nominal, np.zeros(robot.model.nv))
    root, nominal = legs.root(x, np.zeros(6))[:7], x[7:].reshape(-1, 3)
    toe, heel = (list(robot.foot_names).index(n) for n in ("right_toe", "right_heel"))
    foot = [toe, heel]
    middle = nominal[foot].mean(axis=0)
    points = np.tile(nominal, (12, 1, 1))
    for k, angle in enumerate(np.linspace(-np.pi, 0.0, 12)):
        turned = Rotation.from_rotvec([0, 0, angle]).apply(nominal[foot] - middle)
        points[k, foot] = middle + [0.1, 0.0, 0.0] + turned
    home = np.tile(robot.q_nominal[7:], (12, 1))
    _, error = legs.sweep(np.tile(root, (12, 1)), points, home, np.full(12, 0.9))
    assert np.abs(error[0]).max() > 0.03
    assert np.abs(error[-3:]).max() < 1e-4
