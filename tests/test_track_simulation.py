"""The simulated robot against Pinocchio's, and its inverse kinematics."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from slomo.robot import load_robot
from slomo.terrain import Box, Terrain
from slomo.track.joint_space import JointSpace
from slomo.track.plan import PlanPoint
from slomo.track.simulation import Simulation

NAMES = ("go1", "a1", "go2")


def random_state(robot, seed):
    rng = np.random.default_rng(seed)
    q = pin.randomConfiguration(robot.model, np.full(robot.model.nq, -1.0), np.full(robot.model.nq, 1.0))
    quat = rng.normal(size=4)
    q[:3], q[3:7] = rng.normal(size=3), quat / np.linalg.norm(quat)
    q[7:] = rng.uniform(robot.lower, robot.upper)
    return q, rng.normal(size=robot.model.nv)


def point_foot_standing(robot):
    base = [0.0, 0.0, robot.standing_height]
    feet = robot.nominal_feet + base
    return np.concatenate([base, [0, 0, 0, 1.0], feet.ravel()])


def plan_point(q, v):
    zero = np.zeros((4, 3))
    return PlanPoint(q[:3], q[3:7], v[:3], v[3:6], q[7:].reshape(-1, 3), v[6:].reshape(-1, 3), zero, zero)


@pytest.mark.parametrize("name", NAMES)
def test_mujoco_agrees_with_pinocchio(name):
    robot = load_robot(name)
    sim, data = Simulation(robot, Terrain()), robot.model.createData()
    assert sim.model.body_subtreemass[0] == pytest.approx(robot.mass, abs=1e-9)
    for seed in range(3):
        q, v = random_state(robot, seed)
        sim.reset(q, v)
        np.testing.assert_allclose(sim.q, q, atol=1e-12)
        np.testing.assert_allclose(sim.v, v, atol=1e-12)
        pin.framesForwardKinematics(robot.model, data, q)
        feet = [data.oMf[robot.model.getFrameId(n)].translation for n in robot.foot_names]
        np.testing.assert_allclose(sim.feet, feet, atol=1e-9)

        # M in Pinocchio's velocity coordinates: MuJoCo's base velocity is in the world, its joints in another order.
        dofs = [int(sim.model.joint(n).dofadr[0]) for n in robot.joint_names]
        T = np.zeros((robot.model.nv, robot.model.nv))
        T[:3, :3] = data.oMi[1].rotation
        T[3:6, 3:6] = np.eye(3)
        T[dofs, range(6, robot.model.nv)] = 1
        M = np.zeros((robot.model.nv, robot.model.nv))
        mujoco.mj_fullM(sim.model, sim.data, M)
        want = np.array(pin.crba(robot.model, data, q))
        want = np.triu(want) + np.triu(want, 1).T
        want[range(6, robot.model.nv), range(6, robot.model.nv)] += robot.rotor_inertia
        np.testing.assert_allclose(T.T @ M @ T, want, atol=2e-6)


@pytest.mark.parametrize("name", NAMES)
def test_stands_and_carries_its_weight(name):
    robot = load_robot(name)
    sim = Simulation(robot, Terrain())
    q0 = robot.q_nominal
    sim.reset(q0)
    for _ in range(1500):
        sim.step(40 * (q0[7:] - sim.q[7:]) - 1.0 * sim.v[6:])
    forces, body_down = sim.contacts()
    assert not body_down
    assert sim.q[2] > 0.75 * q0[2]
    np.testing.assert_allclose(forces.sum(axis=0)[2], robot.mass * 9.81, rtol=0.02)
    assert np.all(forces[:, 2] > 5)
    assert np.all(np.hypot(*forces[:, :2].T) <= 0.8 * forces[:, 2] + 1e-6)


def test_without_torque_the_body_goes_down():
    robot = load_robot("go1")
    sim = Simulation(robot, Terrain())
    sim.reset(robot.q_nominal)
    down = False
    for _ in range(1500):
        sim.step(np.zeros(12))
        down |= sim.contacts()[1]
    assert down


def test_motors_saturate():
    robot = load_robot("go1")
    sim = Simulation(robot, Terrain())
    sim.reset(robot.q_nominal)
    sim.step(np.full(12, 1e4))
    np.testing.assert_allclose(sim.data.actuator_force, robot.effort)


def test_boxes_carry_the_feet():
    robot = load_robot("go1")
    box = Box(0.1, 1.0, -1.0, 1.0, 0.1)
    sim = Simulation(robot, Terrain((box,)))
    q_point = point_foot_standing(robot)
    q_point[2] += 0.05
    q_point[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0, -0.26, 0)).coeffs()
    feet = q_point[7:].reshape(-1, 3)
    feet[:2, 2] += 0.1
    joints = JointSpace(robot)
    q = joints.pose(q_point)
    sim.reset(q)
    np.testing.assert_allclose(sim.feet[:, 2], [0.12, 0.12, 0.02, 0.02], atol=1e-4)
    for _ in range(1000):
        sim.step(60 * (q[7:] - sim.q[7:]) - 2.0 * sim.v[6:])
    forces, down = sim.contacts()
    assert not down
    assert np.all(forces[:, 2] > 5)
    np.testing.assert_allclose(sim.feet[:2, 2], 0.12, atol=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_inverse_kinematics(name):
    robot = load_robot(name)
    joints, rng = JointSpace(robot), np.random.default_rng(0)
    for _ in range(50):
        inside = np.clip(robot.q_nominal[7:] + rng.uniform(-0.4, 0.4, 12), robot.lower, robot.upper)
        q = np.concatenate([robot.q_nominal[:7], inside])
        joints.reset()
        feet = robot.frames_in_base(q, robot.foot_names)
        np.testing.assert_allclose(joints.solve(feet), inside, atol=2e-3)
    for _ in range(3):
        q = joints.solve(robot.nominal_feet - [0, 0, 0.5])
    assert np.all((q >= robot.lower) & (q <= robot.upper))
    reached = robot.frames_in_base(np.concatenate([robot.q_nominal[:7], q]), robot.foot_names)
    assert np.all(reached[:, 2] < -0.34)


def test_state_and_pose_are_inverse_and_velocities_are_derivatives():
    robot = load_robot("go1")
    joints = JointSpace(robot)
    q, v = random_state(robot, 1)
    q[7:] = robot.q_nominal[7:] + 0.1
    q_point, v_point = joints.state(q, v)
    difference = pin.difference(robot.model, q, joints.pose(q_point))
    np.testing.assert_allclose(difference, 0, atol=1e-4)
    dt = 1e-6
    ahead, _ = joints.state(pin.integrate(robot.model, q, v * dt), v)
    np.testing.assert_allclose((ahead[:3] - q_point[:3]) / dt, v_point[:3], atol=1e-4)
    np.testing.assert_allclose((ahead[7:] - q_point[7:]) / dt, v_point[6:], atol=1e-4)
    command = joints.command(point := plan_point(q_point, v_point), point, u=np.zeros((4, 3)), q=q, v=v)
    np.testing.assert_allclose(command.v, v[6:], atol=1e-2)


def test_forces_of_the_legs_are_those_of_statics():
    """Virtual work: -u on the feet does the work of the joint torques."""
    robot = load_robot("go1")
    joints = JointSpace(robot)
    q = robot.q_nominal.copy()
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.2, -0.3, 1.0)).coeffs()
    u = np.tile([5.0, -3.0, 30.0], (4, 1))
    q_point, v_point = joints.state(q, np.zeros(18))
    point = plan_point(q_point, v_point)
    tau = joints.command(point, point, u=u, q=q, v=v_point).tau
    for j in range(12):
        v = np.zeros(18)
        v[6 + j] = 1.0
        _, speeds = joints.state(q, v)
        assert tau[j] == pytest.approx(-u.ravel() @ speeds[6:], abs=1e-9)
