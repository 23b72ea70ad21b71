"""State estimation: the filter's Jacobians, known answers, and a robot that is not where it is thought to be."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from slomo.gravity import GRAVITY
from slomo.robot import load_robot
from slomo.terrain import Box, Terrain
from slomo.track import inekf
from slomo.track.actuators import Motors
from slomo.track.estimator import Estimator
from slomo.track.foot_force import FootForces, contact_probability
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorErrors, SensorSample, SimulatedSensors
from slomo.track.simulation import Simulation

N = 4
SIZE = 15 + 3 * N


def random_state(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=seed).as_matrix()
    return R, rng.normal(size=3), rng.normal(size=3), rng.normal(size=(N, 3)), 0.1 * rng.normal(size=6)


def exponential(w):
    E, J = np.empty((3, 3)), np.empty((3, 3))
    inekf._exponential(np.asarray(w, float), E, J)
    return E, J


def off_by(state, xi):
    """The state that an estimate with the error xi has: exp(xi) X, biases moved."""
    R, v, p, d, bias = (x.copy() for x in state)
    E, J = exponential(xi[:3])
    v, p = E @ v + J @ xi[3:6], E @ p + J @ xi[6:9]
    d = d @ E.T + (J @ xi[9:-6].reshape(N, 3).T).T
    return E @ R, v, p, d, bias + xi[-6:]


def error(estimate, true):
    """xi of two states (first order is enough here)."""
    w = Rotation.from_matrix(estimate[0] @ true[0].T).as_rotvec()
    E, J = exponential(w)
    out = [w]
    for a, b in ((estimate[1], true[1]), (estimate[2], true[2]), *zip(estimate[3], true[3], strict=True)):
        out.append(np.linalg.solve(J, a - E @ b))
    return np.concatenate([*out, estimate[4] - true[4]])


def advance(state, gyro, acceleration, dt):
    R, v, p, d, bias = (x.copy() for x in state)
    P = np.zeros((SIZE, SIZE))
    inekf.predict(R, v, p, d, bias, P, gyro, acceleration, np.zeros((N, 3)), dt, GRAVITY, np.zeros(4), np.zeros(N))
    return R, v, p, d, bias


def test_exponential_is_scipys_and_its_jacobian_a_derivative():
    for w in ([0.3, -0.8, 1.1], [1e-8, 0, 2e-8]):
        E, J = exponential(w)
        np.testing.assert_allclose(E, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
        for i in range(3):
            step = 1e-6 * np.eye(3)[i]
            turned = Rotation.from_rotvec(w + step) * Rotation.from_rotvec(w).inv()
            np.testing.assert_allclose(J[:, i], turned.as_rotvec() / 1e-6, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_transition_is_the_derivative_of_the_propagation(seed):
    state, rng, dt = random_state(seed), np.random.default_rng(seed), 1e-4
    gyro, acceleration = rng.normal(size=3), 10 * rng.normal(size=3)
    Phi, G = np.empty((SIZE, SIZE)), np.empty((SIZE, 6))
    R, v, p, d, _ = state
    inekf.transition(R, v, p, d, dt, GRAVITY, Phi, G)
    eps, after = 1e-5, advance(state, gyro, acceleration, dt)
    for i in range(SIZE):
        xi = np.zeros(SIZE)
        xi[i] = eps
        moved = advance(off_by(state, xi), gyro, acceleration, dt)
        np.testing.assert_allclose(error(moved, after) / eps, Phi[:, i], atol=3e-3 * dt**0.5, err_msg=str(i))
    for i in range(6):  # noise enters as a change of what is measured
        step = 1e-3 * np.eye(6)[i]
        moved = advance(state, gyro + step[:3], acceleration + step[3:], dt)
        np.testing.assert_allclose(error(moved, after) / 1e-3, G[:, i] * dt, atol=1e-5, err_msg=str(i))


@pytest.mark.parametrize("measure", ["legs", "height"])
def test_a_precise_measurement_removes_the_error_that_it_sees(measure):
    true, rng = random_state(7), np.random.default_rng(7)
    xi = np.concatenate([0.01 * rng.normal(size=SIZE - 6), np.zeros(6)])
    estimate = off_by(true, xi)
    P = 1e-4 * np.eye(SIZE)
    h = (true[3] - true[2]) @ true[0]
    if measure == "legs":
        before = np.abs(estimate[3] - estimate[2] - h @ estimate[0].T).max()
        inekf.correct_legs(*estimate, P, h, 1e-6)
        after = np.abs(estimate[3] - estimate[2] - h @ estimate[0].T).max()
    else:
        before = abs(estimate[3][1, 2] - true[3][1, 2])
        inekf.correct_height(*estimate, P, 1, true[3][1, 2], 1e-6)
        after = abs(estimate[3][1, 2] - true[3][1, 2])
    assert after < 0.02 * before
    assert np.linalg.eigvalsh(P).min() > -1e-12
    assert np.trace(P) < 1e-4 * SIZE


def walked(seconds, state, P):
    """The filter on legs that say what is true, of a robot that stands still while its feet take turns in the air."""
    R, v, p, d, bias = state
    h, up = (d - p) @ R, R.T @ [0.0, 0.0, GRAVITY]
    noise = np.array([4e-4, 2e-2, 2e-5, 1e-3])
    for k in range(round(seconds * 1000)):
        swing = np.where(np.arange(N) == (k // 200) % N, 3.0, 5e-3)
        inekf.predict(R, v, p, d, bias, P, bias[:3], up + bias[3:], np.zeros((N, 3)), 1e-3, GRAVITY, noise, swing)
        inekf.correct_legs(R, v, p, d, bias, P, h, 2e-3)
    return P


def test_the_covariance_stays_symmetric():
    """Rounding grew with the fourth power of time, and after six minutes of walking the filter broke."""
    state = random_state(3)
    P = walked(1.0, (state[0], np.zeros(3), *state[2:]), 1e-4 * np.eye(SIZE))
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0


def test_heading_and_place_are_forgotten_and_nothing_else():
    """What any measurement is compared with stays as uncertain, and in a moved world the covariance is the same."""
    state, rng = random_state(5), np.random.default_rng(5)
    root = rng.normal(size=(SIZE, SIZE))
    before, P = root @ root.T, root @ root.T
    inekf.forget_place(P, 1e-3, 1e-2)
    np.testing.assert_array_equal(P, P.T)
    assert P[2, 2] == pytest.approx(1e-6)
    np.testing.assert_allclose(P[6:8, 6:8], 1e-4 * np.eye(2), atol=1e-12)
    rows = np.zeros((3 * N + N, SIZE))
    for c in range(N):
        for i in range(3):
            rows[3 * c + i, [6 + i, 9 + 3 * c + i]] = 1.0, -1.0
        rows[3 * N + c, [0, 1, 11 + 3 * c]] = state[3][c, 1], -state[3][c, 0], 1.0
    np.testing.assert_allclose(rows @ P @ rows.T, rows @ before @ rows.T, atol=1e-9)
    kept = [i for i in range(SIZE) if i not in (2, *range(6, SIZE - 6, 3), *range(7, SIZE - 6, 3))]
    np.testing.assert_array_equal(P[np.ix_(kept, kept)], before[np.ix_(kept, kept)])


def test_a_walk_of_any_length_leaves_heading_and_place_bounded():
    estimator = Estimator(load_robot("go1"), Terrain())
    estimator.warm_up()
    sample = estimator._last
    estimator._P[2, 2] = 0.3**2  # as after minutes
    estimator.sense(replace(sample, t=sample.t + 1e-3), np.ones(4, bool))
    assert estimator._P[2, 2] < 0.01**2
    assert np.linalg.eigvalsh(estimator._P).min() > 0


def test_a_round_foot_that_rolls_takes_the_filters_point_along():
    """Predicted with the drift of a rolling sphere, a point moves by turn times radius."""
    state = random_state(0)
    P, drift = np.zeros((SIZE, SIZE)), np.tile([0.02, 0, 0], (N, 1))
    R, v, p, d, bias = (x.copy() for x in state)
    inekf.predict(R, v, p, d, bias, P, np.zeros(3), np.zeros(3), drift, 0.5, GRAVITY, np.zeros(4), np.full(N, 0.1))
    np.testing.assert_allclose(d - state[3], drift * 0.5)
    np.testing.assert_allclose(np.diag(P)[9:-6], 0.1**2 * 0.5)


def hold(robot, *, seconds, start=None, errors=None, terrain=None, world=None, seed=0, sway=0.0):
    """A robot that stands under PD, and may sway soon after the start; the estimator, and what is true."""
    sim = Simulation(robot, world or Terrain())
    q0 = robot.q_nominal.copy()
    sim.reset(q0)
    motors, nj = Motors(robot), len(robot.joint_names)
    sensors = SimulatedSensors(nj, seed=seed, errors=errors)
    estimator = Estimator(robot, terrain or Terrain())
    at_start = q0
    tau, on = np.zeros(nj), np.ones(len(robot.limbs), bool)
    for k in range(round((seconds + 0.4) * 1000)):
        t = k * 1e-3
        target = q0[7:] + sway * np.sin(2 * np.pi * max(t - 0.5, 0.0)) ** 2 * np.tile([0.3, 1.0, -1.0], 4)
        gains = np.full(nj, 80.0), np.full(nj, 3.0)
        motors.send(t, JointCommand(target, np.zeros(nj), np.zeros(nj), *gains))
        q, v = sim.q, sim.v
        sample = sensors.read(SensorSample(t, q[7:], v[6:], tau, v[3:6], sim.acceleration))
        if k == 400:
            at_start = q
            estimator.start(sample, start if start is not None else q)
        elif k > 400:
            estimator.sense(sample, on)
        tau = motors.limited(motors.asked(t, q[7:], v[6:]), v[6:])
        sim.step(tau)
    return estimator, sim, sensors, at_start


PERFECT = SensorErrors(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def test_perfect_sensors_on_a_swaying_robot_give_the_true_state():
    robot = load_robot("go1")
    estimator, sim, *_ = hold(robot, seconds=1.5, errors=PERFECT, sway=0.1)
    q, v = estimator.state(estimator._last.t)
    np.testing.assert_allclose(q[:3], sim.q[:3], atol=0.003)
    turn = (Rotation.from_quat(q[3:7]).inv() * Rotation.from_quat(sim.q[3:7])).magnitude()
    assert np.degrees(turn) < 0.2
    np.testing.assert_allclose(v[:3], sim.v[:3], atol=0.03)
    np.testing.assert_allclose(estimator.contact, 1, atol=0.05)
    np.testing.assert_allclose(estimator.force.sum(axis=0)[2], robot.mass * GRAVITY, rtol=0.1)


def test_noisy_sensors_and_a_wrong_start():
    """Roll, pitch, height and the gyro's bias are found; the place on the ground stays as wrong as it was told."""
    robot = load_robot("go1")
    start = robot.q_nominal.copy()
    start[:3] += [0.2, -0.1, 0.05]
    start[3:7] = Rotation.from_euler("ZYX", [0.0, 0.15, -0.2]).as_quat()
    estimator, sim, sensors, at_start = hold(robot, seconds=1.5, start=start, sway=0.1)
    q, _ = estimator.state(estimator._last.t)
    np.testing.assert_allclose(q[:2] - start[:2], sim.q[:2] - at_start[:2], atol=0.005)
    assert abs(q[2] - sim.q[2]) < 0.01
    tilt = (Rotation.from_quat(q[3:7]) * Rotation.from_quat(sim.q[3:7]).inv()).as_rotvec()[:2]
    assert np.degrees(np.linalg.norm(tilt)) < 1.5
    np.testing.assert_allclose(estimator.gyro_bias, sensors._gyro_bias, atol=3e-3)


def test_ground_that_is_not_where_the_terrain_has_it():
    """Told of a step that is not there: the filter believes the legs more than the terrain."""
    robot = load_robot("go1")
    step = Terrain((Box(0.05, 2.0, -1.0, 1.0, 0.03),))
    estimator, sim, *_ = hold(robot, seconds=1.0, terrain=step)
    q, _ = estimator.state(estimator._last.t)
    tilt = (Rotation.from_quat(q[3:7]) * Rotation.from_quat(sim.q[3:7]).inv()).as_rotvec()
    assert np.degrees(abs(tilt[1])) < 2.0  # the step would tilt it by 4.8 degrees
    assert np.ptp(estimator.feet[:, 2]) < 0.015


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_forces_of_a_posed_robot_by_virtual_work(name):
    """Torques that hold known foot forces at rest are told apart into just these."""
    robot = load_robot(name)
    model, data, q = robot.model, robot.model.createData(), robot.q_nominal
    forces = FootForces(robot)
    F = len(robot.feet)
    want = np.tile([3.0, -2.0, robot.mass * GRAVITY / F], (F, 1))
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    R = data.oMi[1].rotation
    J = np.vstack([
        pin.getFrameJacobian(model, data, model.getFrameId(robot.foot_names[c]), pin.LOCAL_WORLD_ALIGNED)[:3, 6:]
        for c in robot.feet
    ])  # fmt: skip
    nj = len(robot.joint_names)
    tau = pin.rnea(model, data, q, np.zeros(model.nv), np.zeros(model.nv))[6:] - J.T @ want.ravel()
    sample = SensorSample(0.0, q[7:], np.zeros(nj), tau, np.zeros(3), R.T @ [0, 0, GRAVITY])
    got = forces.update(sample) @ R.T
    if len(robot.pairs):  # what toe and heel bear is known together only
        got, want = got.sum(axis=0), want.sum(axis=0)
    np.testing.assert_allclose(got, want, rtol=0.05, atol=1.0)


def test_contact_is_believed_by_force_first_and_by_plan_in_doubt():
    weight = 130.0
    assert contact_probability(40.0, False, weight) > 0.95
    assert contact_probability(0.0, False, weight) < 0.02
    assert contact_probability(0.0, True, weight) < 0.4
    doubt = 0.08 * weight
    assert contact_probability(doubt, True, weight) > 0.8 > 0.2 > contact_probability(doubt, False, weight)
