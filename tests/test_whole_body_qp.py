"""The whole-body QP: statics, limits, soles, what it does when nothing can be solved, and humanoids that stand."""

from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from slomo.motion import Reference
from slomo.robot import load_robot
from slomo.stage import Silent
from slomo.terrain import Terrain
from slomo.track.actuators import torque_limits
from slomo.track.config import Config, resolved
from slomo.track.disturbance import Disturbance
from slomo.track.floating_base import FloatingBase
from slomo.track.loop import simulate
from slomo.track.plan import PlanPoint
from slomo.track.posture import standing_pose
from slomo.track.sole import contact_points, half_widths
from slomo.track.whole_body_qp import WholeBodyQp

H = 0.02
FLAT = Terrain()


@cache
def robot_of(name):
    return load_robot(name)


def standing(robot, *, seconds=0.4, sway=0.0) -> Reference:
    """Standing still, or the body sways sideways (m); the weight shared by the feet."""
    t = np.arange(round(seconds / H) + 1) * H
    T, C, w = len(t), len(robot.limbs), 2 * np.pi
    q, v = np.zeros((T, 7 + 3 * C)), np.zeros((T, 6 + 3 * C))
    points = robot.nominal_feet + [0, 0, robot.standing_height]
    points[robot.feet, 2] = 0.0
    com = (robot.body.mass * np.zeros(3) + robot.foot_mass @ points) / robot.mass
    shift = (points[robot.feet].mean(axis=0) - com)[:2]
    q[:, 2], q[:, 6] = robot.standing_height, 1.0
    q[:, :2] = shift
    q[:, 1] += sway * np.sin(w * t)
    v[:, 1] = sway * w * np.cos(w * t)
    q[:, 7:] = points.ravel()
    hands = [c for c in range(C) if c not in robot.feet]
    for c in hands:
        q[:, 7 + 3 * c : 9 + 3 * c] += q[:, :2]
        v[:, 7 + 3 * c] += v[:, 1]
    u = np.zeros((T - 1, C, 3))
    u[:, hands, 2] = -9.81 * robot.foot_mass[hands]
    load = 9.81 * (robot.body.mass + robot.foot_mass[hands].sum())
    u[:, robot.feet, 2] = load / len(robot.feet)
    lam = np.where(np.isin(np.arange(C), robot.feet)[:, None], u + [0, 0, 9.81] * robot.foot_mass[:, None], 0.0)
    return Reference(t, np.full(T - 1, H), q, v, u.reshape(T - 1, -1), lam, robot.foot_names, robot.digest)


def plan(reference, t=0.0) -> PlanPoint:
    C = len(reference.point_names)
    return PlanPoint(
        reference.q[0, :3], reference.q[0, 3:7], np.zeros(3), np.zeros(3), reference.points[0], np.zeros((C, 3)),
        reference.u[0].reshape(C, 3), reference.lam[0], t=t,
    )  # fmt: skip


def at_rest(name, **changes):
    """A QP of a standing robot, its solution, and the state."""
    robot, reference = robot_of(name), standing(robot_of(name))
    qp = WholeBodyQp(robot, reference, terrain=FLAT, mu=0.6)
    q, v = standing_pose(robot, reference.q[0]), np.zeros(robot.model.nv)
    now, ahead = plan(reference), plan(reference, 0.02)
    return robot, qp, qp.solve(now, ahead, u=changes.get("u", now.u), q=q, v=v), q, v


@pytest.mark.parametrize("name", ["go1", "anymal_c", "g1", "atlas"])
def test_affine_map_satisfies_the_equations_of_motion(name):
    robot, rng = robot_of(name), np.random.default_rng(0)
    body, contacts = FloatingBase(robot, robot.rotor_inertia), contact_points(robot)
    q = pin.integrate(robot.model, robot.q_nominal, 0.3 * rng.normal(size=robot.model.nv))
    v = rng.normal(size=robot.model.nv)
    body.update(q, v)
    a0, A, t0, T = body.affine(contacts)
    x = rng.normal(size=A.shape[1])
    f = 20 * x[body.nj :].reshape(-1, 3)
    x[body.nj :] = f.ravel()
    # Inverse dynamics with the forces at the contact points, by Pinocchio.
    outer = [pin.Force.Zero() for _ in range(robot.model.njoints)]
    for point, force in zip(contacts, f, strict=True):
        frame = body.model.frames[point.frame]
        T_world_joint = body.data.oMi[frame.parentJoint]
        at = body.placement(point.frame).act(point.offset)
        lever = T_world_joint.actInv(at)
        local = T_world_joint.rotation.T @ force
        outer[frame.parentJoint] += pin.Force(local, np.cross(lever, local))
    tau = pin.rnea(body.model, body.model.createData(), q, v, a0 + A @ x, outer)
    np.testing.assert_allclose(tau[:6], 0, atol=1e-8)
    np.testing.assert_allclose(tau[6:], t0 + T @ x, atol=1e-8)


@pytest.mark.parametrize("name", ["go1", "hyq", "g1", "talos"])
def test_standing_forces_sum_to_the_weight_and_torques_are_those_of_statics(name):
    robot, _, solution, q, _ = at_rest(name)
    np.testing.assert_allclose(solution.f.sum(axis=0), [0, 0, robot.mass * 9.81], rtol=0.03, atol=0.03 * robot.mass)
    assert np.all(solution.f[:, 2] > 0)
    assert np.abs(solution.a).max() < 2
    model, data = robot.model, robot.model.createData()
    gravity = pin.computeGeneralizedGravity(model, data, q)[6:].copy()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    for point, force in zip(solution.contacts, solution.f, strict=True):
        J = pin.getFrameJacobian(model, data, point.frame, pin.LOCAL_WORLD_ALIGNED)[:, 6:]
        lever = data.oMf[point.frame].rotation @ point.offset
        gravity -= J[:3].T @ force + J[3:].T @ np.cross(lever, force)
    inertia = np.abs(pin.crba(model, data, q)).max()
    np.testing.assert_allclose(solution.tau, gravity, atol=3 * inertia * np.abs(solution.a).max() + 1e-6)


def test_hard_limits_hold_whatever_is_asked():
    robot, qp, _, q, _ = at_rest("go1")
    reference, rng = standing(robot), np.random.default_rng(1)
    for _ in range(30):
        u = plan(reference).u + rng.normal(size=(4, 3)) * 300
        fast = rng.normal(size=robot.model.nv) * 5
        fast[6:] = np.clip(fast[6:], -0.9 * robot.velocity, 0.9 * robot.velocity)
        solution = qp.solve(plan(reference), plan(reference, 0.02), u=u, q=q, v=fast)
        assert solution is not None
        low, high = torque_limits(robot, fast[6:])
        assert np.all((solution.tau >= low) & (solution.tau <= high))
        assert np.all(solution.f[:, 2] >= -1e-6)
        assert np.all(np.abs(solution.f[:, :2]) <= 0.6 / np.sqrt(2) * solution.f[:, 2:] + 1e-4)


def test_a_joint_stops_before_its_limit():
    robot, qp, _, q, v = at_rest("go1")
    reference = standing(robot)
    q, v = q.copy(), v.copy()
    q[9], v[8] = robot.lower[2] + 0.01, -3.0  # the calf is about to hit
    solution = qp.solve(plan(reference), plan(reference, 0.02), u=plan(reference).u, q=q, v=v)
    m = qp.config.margin
    assert q[9] + m * v[8] + m**2 / 2 * solution.a[8] >= robot.lower[2] - 1e-3


def test_without_a_solution_the_last_torques_go_on():
    robot, qp, _, q, v = at_rest("go1")
    reference = standing(robot)
    now, ahead = plan(reference), plan(reference, 0.02)
    before = qp.command(now, ahead, u=now.u, q=q, v=v).tau
    after = qp.command(now, ahead, u=now.u, q=q, v=v * np.nan)
    assert qp.failures == 1
    np.testing.assert_array_equal(after.tau, before)
    qp.reset()
    assert qp.failures == 0


def test_planned_force_is_followed_where_statics_leave_a_choice():
    robot, _, even, _, _ = at_rest("go1")
    u = plan(standing(robot)).u.copy()
    u[[0, 3], 2] += 15  # the diagonals can share the weight in any way
    u[[1, 2], 2] -= 15
    _, _, diagonal, _, _ = at_rest("go1", u=u)
    assert np.all(diagonal.f[[0, 3], 2] > even.f[[0, 3], 2] + 10)


def test_feet_in_the_air_bear_nothing():
    robot, qp, _, q, v = at_rest("g1")
    reference = standing(robot)
    q = q.copy()
    q[2] += 0.1
    solution = qp.solve(plan(reference), plan(reference, 0.02), u=plan(reference).u, q=q, v=v)
    assert solution.contacts == ()
    # They are to bear load, so they come down.
    assert qp.tasks.look(plan(reference), plan(reference, 0.02)).late[robot.feet].all()


def test_soles_are_as_wide_as_the_urdf_says():
    width = {name: {c: np.linalg.norm(x) for c, x in half_widths(robot_of(name)).items()} for name in ("g1", "atlas")}
    assert width["g1"] == pytest.approx({0: 0.03, 1: 0.025, 2: 0.03, 3: 0.025})
    assert width["atlas"] == pytest.approx(dict.fromkeys(range(4), 0.065))
    assert half_widths(robot_of("go1")) == {}
    assert len(contact_points(robot_of("go1"))) == 4
    assert len(contact_points(robot_of("g1"))) == 8


def test_the_horizon_grows_with_the_robot():
    assert resolved(Config(), robot_of("go1")).horizon == 10
    assert resolved(Config(), robot_of("g1")).horizon > 14
    assert resolved(Config(horizon=5), robot_of("g1")).horizon == 5


def test_a_stand_arrives_however_far_the_hands_are():
    """Half-way through its inverse kinematics TALOS had a hand 18 cm off, or stood on the edge of a sole."""
    robot = robot_of("talos")
    q = standing(robot).q[0]
    for c, side in ((4, 1.0), (5, -1.0)):  # up, from hanging
        q[7 + 3 * c : 10 + 3 * c] = q[:3] + robot.standing_height * np.array([0.0, 0.3 * side, 1.0])
    data, pose = robot.model.createData(), standing_pose(robot, q)
    pin.framesForwardKinematics(robot.model, data, pose)
    points = [data.oMf[robot.model.getFrameId(name)].translation for name in robot.foot_names]
    np.testing.assert_allclose(points, q[7:].reshape(-1, 3), atol=1e-4)
    for p in contact_points(robot):
        assert data.oMf[p.frame].act(p.offset)[2] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("name", ["g1", "atlas", "talos"])
def test_a_humanoid_sways_without_falling(name):
    """With the rotors of a small robot, Atlas's feet shook under motors strong enough to hold it, and it fell over."""
    robot = robot_of(name)
    outcome = simulate(
        robot, standing(robot, seconds=0.5, sway=0.02), terrain=FLAT, config=Config(state="truth", settle=0.1),
        disturbance=Disturbance(), progress=Silent(),
    )  # fmt: skip
    r = outcome.rollout
    on = r.t >= 0
    assert outcome.fall is None
    assert np.linalg.norm(r.body[on, :3] - r.body_ref[on, :3], axis=1).max() < 0.03
    assert np.abs(r.points[on][:, robot.feet] - r.points_ref[on][:, robot.feet]).max() < 0.01
    assert r.lam[on].sum(axis=1)[:, 2].mean() == pytest.approx(robot.mass * 9.81, rel=0.05)
