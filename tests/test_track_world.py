"""The simulated world: motors, ground, disturbances, motions that repeat."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from slomo.cli import app
from slomo.errors import UsageError
from slomo.gravity import GRAVITY
from slomo.motion import Reference
from slomo.pipeline import Project
from slomo.robot import load_robot
from slomo.terrain import Box, HeightField, Slope, Terrain
from slomo.track.actuators import Motors, torque_limits
from slomo.track.cyclic import repeated
from slomo.track.disturbance import PUSH_SECONDS, Disturbance, Push
from slomo.track.joint_space import JointCommand
from slomo.track.sensors import SensorErrors, SensorSample, SimulatedSensors
from slomo.track.simulation import Simulation

ROBOT = load_robot("go1")


def command(q=0.0, tau=0.0, kp=0.0, kd=0.0):
    return JointCommand(*(np.full(12, x) for x in (q, 0.0, tau, kp, kd)))


def test_torque_falls_from_the_knee_speed_to_nothing_and_brakes_fully():
    knee, top, effort = ROBOT.knee_speed, ROBOT.velocity, ROBOT.effort
    for v, want in ((0 * top, 1.0), (knee, 1.0), ((knee + top) / 2, 0.5), (top, 0.0), (1.2 * top, 0.0)):
        low, high = torque_limits(ROBOT, v)
        np.testing.assert_allclose(high, want * effort, atol=1e-9)
        np.testing.assert_allclose(low, -effort)
        np.testing.assert_allclose(torque_limits(ROBOT, -v), (-high, effort))


def test_a_command_counts_when_it_has_arrived():
    motors = Motors(ROBOT, delay=0.003)
    q = v = np.zeros(12)
    motors.send(0.0, command(tau=1.0))
    np.testing.assert_array_equal(motors.asked(0.0, q, v), 1.0)  # the first counts at once
    motors.send(0.002, command(q=0.1, kp=50.0))
    np.testing.assert_array_equal(motors.asked(0.004, q, v), 1.0)
    np.testing.assert_allclose(motors.asked(0.005, q, v), 5.0)
    np.testing.assert_array_equal(motors.limited(np.full(12, 1e3), v), ROBOT.effort)


def test_sensors_are_late_biased_and_noisy_and_the_same_again():
    nothing, x = np.zeros(3), np.ones(12)
    true = [SensorSample(0.001 * k, k * x, k * x, k * x, nothing, nothing) for k in range(2000)]
    late = SimulatedSensors(12, seed=3, errors=SensorErrors(0, 0, 0, 0, 0, 0, 0, 0, 0, delay=0.004))
    read = [late.read(s) for s in true[:50]]
    assert [r.t for r in read[:4]] == [0.0] * 4
    assert [round(s.t - r.t, 6) for s, r in zip(true[10:50], read[10:], strict=True)] == [0.004] * 40
    a, b = ([SimulatedSensors(12, seed=3).read(s) for s in true[:3]] for _ in range(2))
    np.testing.assert_array_equal(a[2].q, b[2].q)
    e, noisy = SensorErrors(), SimulatedSensors(12, seed=3)
    gyro = np.array([noisy.read(s).gyro for s in true])
    np.testing.assert_allclose(gyro.mean(axis=0), noisy._gyro_bias, atol=4 * e.gyro / np.sqrt(len(true)))
    np.testing.assert_allclose(gyro.std(axis=0), e.gyro, rtol=0.1)


TERRAINS = {
    "slopes": Terrain(
        slopes=(Slope(0.3, 1.5, -0.5, 0.7, 0.0, 0.3, -0.1), Slope(-1.5, -0.4, -1.0, 1.0, -0.2, 0.1, 0.0))
    ),
    "field": Terrain(
        field=HeightField(-1.0, -0.8, 0.4, ((0.0, 0.1, 0.2, 0.1, 0.0),) * 3 + ((-0.1, 0.0, 0.3, 0.2, 0.1),) * 3)
    ),
    "boxes": Terrain(boxes=(Box(0.2, 0.6, -0.4, 0.3, 0.12), Box(0.4, 0.9, -0.1, 0.3, 0.2))),
}


@pytest.mark.parametrize("name", TERRAINS)
def test_the_ground_is_as_high_in_mujoco_as_in_the_terrain(name):
    terrain = TERRAINS[name]
    sim = Simulation(ROBOT, terrain)
    start = ROBOT.q_nominal.copy()
    start[2] += 20.0  # the robot is out of the rays' way
    sim.reset(start)
    rng, geom = np.random.default_rng(0), np.zeros(1, np.int32)
    xy = rng.uniform([-2, -1.2], [2, 1.2], (200, 2))
    edges = np.abs(terrain.height(xy + 0.004) - terrain.height(xy - 0.004)) > 0.02
    for x, y in xy[~edges]:
        from_above = np.array([x, y, 5.0])
        z = 5.0 - mujoco.mj_ray(sim.model, sim.data, from_above, np.array([0, 0, -1.0]), None, 1, -1, geom)
        # Between points MuJoCo's field is two triangles, a terrain's bilinear.
        assert z == pytest.approx(float(terrain.height(np.array([x, y]))), abs=0.003 if name == "field" else 1e-4)


def test_payload_mass_and_push_do_what_they_say():
    plain = Simulation(ROBOT, Terrain())
    heavy = Simulation(ROBOT, Terrain(), payload=2.0, mass_scale=1.1)
    mass = plain.model.body_subtreemass[0]
    assert heavy.model.body_subtreemass[0] == pytest.approx(1.1 * mass + 2.0)
    start = ROBOT.q_nominal.copy()
    start[2] += 5.0  # in free fall a push is momentum
    plain.reset(start)
    push = Push.parse("12@0.01,90")
    for k in range(300):
        plain.push(push.force(k * 1e-3))
        plain.step(np.zeros(12))
    plain.model.opt.timestep = 1e-3
    mujoco.mj_subtreeVel(plain.model, plain.data)
    momentum = mass * plain.data.subtree_linvel[0]
    assert momentum[1] == pytest.approx(12.0, rel=0.02)
    assert abs(momentum[0]) < 0.1
    assert momentum[2] == pytest.approx(-mass * GRAVITY * 0.3, rel=0.02)


def test_pushes_by_name():
    assert Push.parse(" 6.5 @ 2 , -45 ") == Push(6.5, 2.0, -45.0)
    both = Disturbance(pushes=(Push(1.0, 0.0, 0.0), Push(2.0, 0.0, 90.0)))
    np.testing.assert_allclose(both.force(0.05) * PUSH_SECONDS, [1, 2, 0], atol=1e-12)
    np.testing.assert_array_equal(both.force(PUSH_SECONDS), 0)
    for wrong in ("12", "12@1", "12@a,3", "x12@1,3"):
        with pytest.raises(UsageError, match=r"12@1\.5,90"):
            Push.parse(wrong)


def test_steps_that_are_higher_or_gone():
    terrain = Terrain((Box(0, 1, 0, 1, 0.1), Box(2, 3, 0, 1, 0.02)), slopes=(Slope(5, 6, 0, 1, 0.1),))
    assert [b.height for b in Disturbance(step_height=0.02).ground(terrain).boxes] == pytest.approx([0.12, 0.04])
    lower = Disturbance(step_height=-0.02).ground(terrain)
    assert [b.height for b in lower.boxes] == pytest.approx([0.08])
    assert lower.slopes == terrain.slopes


def turning(*, angle=0.3, forward=0.2, T=9, h=0.05):
    """A cycle whose end is its start turned and moved."""
    s = np.linspace(0, 1, T)
    q, v = np.zeros((T, 19)), np.zeros((T, 18))
    turn = Rotation.from_euler("z", angle * s[:, None])
    q[:, 3:7] = turn.as_quat()
    q[:, 0], q[:, 2] = forward * s, 0.3
    offsets = np.array([[0.2, 0.1, -0.3], [0.2, -0.1, -0.3], [-0.2, 0.1, -0.3], [-0.2, -0.1, -0.3]])
    for c, p in enumerate(offsets):
        q[:, 7 + 3 * c : 10 + 3 * c] = turn.apply(p) + q[:, :3]
    v[:, 5] = 7.0
    v[:, :3] = turn.apply([1.0, 0.0, 0.0])
    u = np.tile(turn.apply([3.0, 1.0, 40.0])[:-1], 4)
    return Reference(
        s * (T - 1) * h, np.full(T - 1, h), q, v, u, u.reshape(T - 1, 4, 3), ROBOT.foot_names, "",
        cycle=np.array([forward, 0.0, 0.0, angle]),
    )  # fmt: skip


def test_a_cycle_goes_on_where_it_ended():
    one = turning()
    many = repeated(one, 1.3)
    n = len(one.h)
    assert len(many.h) == 4 * n
    assert many.t[-1] == pytest.approx(4 * one.t[-1])
    np.testing.assert_allclose(np.diff(many.t), many.h)
    np.testing.assert_allclose(many.q[: n + 1], one.q)
    # Seen from the body every cycle is the same.
    for k in range(1, 4):
        rows = slice(k * n, (k + 1) * n + 1)
        R = Rotation.from_quat(many.q[rows, 3:7])
        for c in range(4):
            relative = R.inv().apply(many.points[rows, c] - many.q[rows, :3])
            first = Rotation.from_quat(one.q[:, 3:7]).inv().apply(one.points[:, c] - one.q[:, :3])
            np.testing.assert_allclose(relative, first, atol=1e-9)
        step = R.inv().apply(np.gradient(many.q[rows, :3], axis=0))
        np.testing.assert_allclose(
            step[1:-1],
            Rotation.from_quat(one.q[:, 3:7]).inv().apply(np.gradient(one.q[:, :3], axis=0))[1:-1],
            atol=1e-9,
        )
        forces = R[:-1].inv().apply(many.lam[k * n : (k + 1) * n, 2])
        np.testing.assert_allclose(forces, np.tile([3.0, 1.0, 40.0], (n, 1)), atol=1e-9)
    np.testing.assert_array_equal(many.v[:, 5], 7.0)


def test_only_cycles_repeat():
    with pytest.raises(UsageError, match="--cyclic"):
        repeated(dataclasses.replace(turning(), cycle=np.zeros(0)), 5.0)


def test_options_of_the_command_reach_the_stage(tmp_path):
    """There is nothing to track here, but what is asked for is written down first."""
    ground = tmp_path / "ground.json"
    ground.write_text('{"slopes": [{"x_min": 0, "x_max": 1, "y_min": 0, "y_max": 1, "slope_x": 0.1}]}')

    def call(*options):
        args = ["track", "--sim", "--robot", "go1", "--project", str(tmp_path), *options]
        assert CliRunner().invoke(app, args).exit_code == 3
        return Project(tmp_path, "go1")

    project = call(
        "--push", "12@1.5,90", "--push", "3@2,0", "--payload", "2.5", "--latency", "0.01", "--friction", "0.4",
        "--state", "truth", "--seconds", "60", "--terrain", str(ground),
    )  # fmt: skip
    config = project.config("track")
    want = Disturbance(payload=2.5, pushes=(Push(12, 1.5, 90), Push(3, 2, 0)), latency=0.01)
    assert config.disturbance() == want
    assert (config.friction, config.state, config.seconds) == (0.4, "truth", 60.0)
    assert Terrain.load(project.files("track")["world"]).slopes[0].slope_x == 0.1
    project = call("--push", "none", "--terrain", "none")
    assert project.config("track").disturbance().pushes == ()
    assert project.files("track") == {}
