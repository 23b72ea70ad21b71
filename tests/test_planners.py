"""The planners that the MPC is compared with, the contact schedule, and where the MPC wants feet after a push."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from references import carrying, follow, standing
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.terrain import Terrain
from slomo.track.convex_mpc import ConvexMpc, _condensed
from slomo.track.mpc import Mpc, MpcConfig
from slomo.track.open_loop import OpenLoop
from slomo.track.schedule import Schedule

ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)
BODY = np.array([0, 0, ROBOT.standing_height, 0, 0, 0, 1.0])
FEET = ROBOT.nominal_feet + [0, 0, ROBOT.standing_height]


@pytest.fixture(scope="module")
def stand():
    return standing(MODEL, BODY, FEET)


@pytest.fixture(scope="module")
def lift():
    """The front left foot is in the air from 0.3 to 0.6 s, while the others stand."""
    h, steps = 0.05, 20
    points = np.tile(FEET, (steps + 1, 1, 1))
    up = np.zeros(steps + 1)
    up[7:12] = [0.01, 0.03, 0.04, 0.03, 0.01]
    points[:, 0, 2] += up
    lam = np.tile(carrying(MODEL, BODY[:3], FEET), (steps, 1, 1))
    lam[6:12, 0] = 0.0
    return follow(MODEL, np.full(steps, h), points, lam, body=BODY)


def test_schedule_reads_contacts_off_the_forces(lift):
    schedule = Schedule(lift, Terrain())
    stance = schedule.stance(np.array([0.0, 0.29, 0.31, 0.59, 0.61, 5.0]))
    assert stance[:, 0].tolist() == [True, True, False, False, True, True]
    assert stance[:, 1:].all()
    swing = schedule.progress(0.25, np.array([0.25, 0.3, 0.45, 0.6, 0.7]))
    np.testing.assert_allclose(swing[:, 0], [0, 0, 0.5, 1, 1], atol=1e-6)
    assert not swing[:, 1:].any()
    late = schedule.forces(np.array([99.0]))[0]
    assert late[:, 2].sum() == pytest.approx(lift.lam[:, :, 2].sum(axis=1).mean())


def test_condensed_dynamics_against_steps():
    """A roll-out of the discrete model of Di Carlo et al., step by step."""
    rng = np.random.default_rng(0)
    H, h, mass, g = 4, 0.03, 12.0, 9.81
    inertia, x0, yaw = np.diag([0.1, 0.3, 0.35]), rng.normal(size=12), rng.normal(size=H)
    arms, forces = rng.normal(0, 0.3, (H, 4, 3)), rng.normal(0, 30, (H, 4, 3))
    free, S = _condensed(x0, yaw, arms, mass, inertia, g, h)
    got = (free + S @ forces.ravel()).reshape(H, 12)
    angle, p, w, v = x0[:3].copy(), x0[3:6].copy(), x0[6:9].copy(), x0[9:].copy()
    for k in range(H):
        Rz = Rotation.from_euler("z", yaw[k]).as_matrix()
        a = forces[k].sum(axis=0) / mass - [0, 0, g]
        b = np.linalg.solve(Rz @ inertia @ Rz.T, np.cross(arms[k], forces[k]).sum(axis=0))
        angle, p = angle + Rz.T @ (h * w + h * h / 2 * b), p + h * v + h * h / 2 * a
        w, v = w + h * b, v + h * a
        np.testing.assert_allclose(got[k], np.concatenate([angle, p, w, v]), atol=1e-9)


def test_convex_mpc_carries_a_standing_robot(stand):
    mpc = ConvexMpc(MODEL, stand, terrain=Terrain(), config=MpcConfig())
    plan = mpc.step(0.1, stand.q[0], stand.v[0])
    assert plan.status == 0
    assert plan.lam[:, :, 2].sum(axis=1) == pytest.approx(np.full(10, MODEL.total_mass * MODEL.g), rel=0.01)
    np.testing.assert_allclose(plan.q[-1], stand.q[-1], atol=1e-3)
    # What the feet do to the body is the ground's force less the feet's weight.
    assert plan.u[:, 2::3].sum(axis=1) == pytest.approx(np.full(10, MODEL.mass * MODEL.g), rel=0.01)


def test_convex_mpc_brakes_within_the_friction_cone(stand):
    config = MpcConfig(mu=0.3)
    mpc = ConvexMpc(MODEL, stand, terrain=Terrain(), config=config)
    v = stand.v[0].copy()
    v[:2] = 1.0
    plan = mpc.step(0.1, stand.q[0], v)
    side, normal = np.linalg.norm(plan.lam[..., :2], axis=-1), plan.lam[..., 2]
    assert np.all(plan.lam[0, :, :2].sum(axis=0) < -0.15 * MODEL.total_mass * MODEL.g)
    assert np.all(side <= 0.3 * normal + 1e-4)
    assert np.all(normal >= -1e-6)


def test_convex_mpc_keeps_to_the_schedule_and_steps_after_a_push(lift):
    mpc = ConvexMpc(MODEL, lift, terrain=Terrain(), config=MpcConfig())
    mpc.step(0.25, lift.q[5], lift.v[5])
    q, v = lift.q[9].copy(), lift.v[9].copy()
    v[1] += 0.5
    plan = mpc.step(0.45, q, v)
    swinging = plan.t[:-1] + 0.5 * np.diff(plan.t) < 0.6
    assert np.all(plan.lam[swinging, 0] == 0)
    assert np.all(plan.lam[~swinging, 0, 2] > 0)
    aside = plan.q[-1, 8] - FEET[0, 1]  # the foot that swings lands where the body is going, by the capture point
    height = (MODEL.mass * q[2] + MODEL.foot_mass @ q[9::3]) / MODEL.total_mass - q[9::3].min()
    assert aside == pytest.approx(np.sqrt(height / MODEL.g) * 0.5 * MODEL.mass / MODEL.total_mass, rel=0.01)
    np.testing.assert_allclose(plan.q[:, 10:12], np.tile(FEET[1, :2], (11, 1)), atol=1e-9)


def test_convex_mpc_carries_a_body_that_is_off_its_place(stand):
    """The feet have stayed: forces are to balance about where the body is, not only in the first step."""
    mpc = ConvexMpc(MODEL, stand, terrain=Terrain(), config=MpcConfig())
    q = stand.q[0].copy()
    q[1] += 0.05
    plan = mpc.step(0.1, q, stand.v[0])
    np.testing.assert_allclose(plan.q[:, 7:], np.tile(q[7:], (11, 1)), atol=1e-9)
    assert plan.q[-1, 1] < q[1] - 0.02
    centre = (MODEL.mass * plan.q[:-1, :3] + MODEL.foot_mass @ FEET) / MODEL.total_mass
    moment = np.cross(FEET - centre[:, None], plan.lam).sum(axis=1)
    assert np.all(np.abs(moment[:2, 0]) < 0.25 * MODEL.total_mass * MODEL.g * 0.05)


def test_convex_mpc_does_not_put_off_where_feet_should_be(lift):
    mpc = ConvexMpc(MODEL, lift, terrain=Terrain(), config=MpcConfig())
    mpc.step(0.25, lift.q[5], lift.v[5])
    q = lift.q[9].copy()
    q[7:9] -= 0.03
    q[9] = 0.0
    swinging = mpc.step(0.45, q, lift.v[9]).at(0.45).points[0]
    np.testing.assert_allclose(swinging, lift.q[9, 7:10], atol=2e-3)
    q[9] = 0.02  # still in the air when it should stand
    landed = mpc.step(0.62, q, lift.v[12]).at(0.64).points[0]
    np.testing.assert_allclose(landed, [q[7], q[8], 0.0], atol=2e-3)


def test_convex_mpc_keeps_its_plan_without_a_state(stand):
    mpc = ConvexMpc(MODEL, stand, terrain=Terrain(), config=MpcConfig())
    good = mpc.step(0.1, stand.q[0], stand.v[0])
    bad = mpc.step(0.11, np.full(19, np.nan), stand.v[0])
    assert bad.status == 1
    assert np.array_equal(bad.q, good.q)


def test_open_loop_does_not_look(lift):
    planner = OpenLoop(MODEL, lift, terrain=Terrain(), config=MpcConfig())
    plan = planner.step(0.4, lift.q[0], lift.v[0])
    other = planner.step(0.4, lift.q[5] + 1.0, lift.v[5] + 1.0)
    np.testing.assert_allclose(plan.at(0.4).points.ravel(), lift.q[8, 7:], atol=1e-12)
    np.testing.assert_array_equal(other.at(0.4).points, plan.at(0.4).points)
    assert not plan.feedback(0.4, lift.q[0], lift.v[0]).any()


def wanted(stand, v=(0.0, 0.0), away=(0.0, 0.0)):
    """(4, 2) m by how much the MPC's wanted places of the feet move."""
    mpc = Mpc(MODEL, stand, terrain=Terrain())
    mpc.warm_up()
    q, w = stand.q[0].copy(), stand.v[0].copy()
    q[:2] += away
    w[:2] += v
    mpc.step(0.1, q, w)
    places = mpc._task.q_ref[:, 7:].reshape(-1, 4, 3) - FEET
    assert not places[..., 2].any()
    assert np.ptp(places, axis=0).max() < 1e-12
    return places[0, :, :2]


def test_feet_are_wanted_at_the_capture_point(stand):
    T, dead = np.sqrt(BODY[2] / MODEL.g), 0.1 * BODY[2]
    np.testing.assert_allclose(wanted(stand), 0, atol=1e-12)
    np.testing.assert_allclose(wanted(stand, v=(0.1, 0), away=(0, 0.02)), 0, atol=1e-12)
    np.testing.assert_allclose(wanted(stand, v=(1.0, 0))[:, 0], T - dead, rtol=1e-6)
    np.testing.assert_allclose(wanted(stand, away=(0, -0.2))[:, 1], -0.2 + dead, rtol=1e-6)


def test_hands_are_not_moved_after_a_push():
    robot = load_robot("g1")
    model = PointFootModel.from_robot(robot)
    body = np.array([0, 0, robot.standing_height, 0, 0, 0, 1.0])
    still = standing(model, body, robot.nominal_feet + [0, 0, robot.standing_height])
    mpc = Mpc(model, still, terrain=Terrain())
    v = still.v[0].copy()
    v[0] = 1.0
    mpc.step(0.0, still.q[0], v)
    moved = mpc._task.q_ref[1, 7:].reshape(-1, 3) - still.points[0]
    assert np.all(moved[:4, 0] > 0.1)
    assert not moved[4:].any()
