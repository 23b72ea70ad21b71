"""The whole body: derivatives, known answers, a trot, a verifier that catches what is wrong, and what cannot be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.motion import Reference, WholeBody
from slomo.optimize.verify import cycle_gap, dynamics_defect
from slomo.optimize.whole_body import Settings, refine
from slomo.optimize.whole_body_model import WholeBodyModel, minus, plus
from slomo.optimize.whole_body_verify import point_foot_reference, verify_whole_body
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.terrain import Box, Slope, Terrain

SHARED = Path(__file__).parents[2] / "shared"
ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)
FLAT = Terrain()


def reference(base, points, lam, *, h=0.05, robot=ROBOT) -> Reference:
    """Of base positions (T, 3), level, points (T, C, 3) and forces (T - 1, C, 3): only as physical as these are."""
    T = len(base)
    q = np.concatenate([base, np.tile([0, 0, 0, 1.0], (T, 1)), points.reshape(T, -1)], axis=1)
    v = np.diff(np.delete(q, range(3, 7), axis=1), axis=0) / h
    v = np.insert(np.concatenate([v[:1], v]), 3, np.zeros((3, 1)), axis=1)
    return Reference(
        t=h * np.arange(T), h=np.full(T - 1, h), q=q, v=v, u=np.zeros((T - 1, points[0].size)), lam=lam,
        point_names=robot.foot_names, robot_digest=robot.digest,
    )  # fmt: skip


def standing(*, T=6, robot=ROBOT, height=0.0) -> Reference:
    base = np.tile([0, 0, robot.standing_height + height], (T, 1))
    points = robot.nominal_feet + base[:, None]
    points[:, robot.feet, 2] = height
    C = len(robot.limbs)
    share = np.isin(np.arange(C), robot.feet) / len(robot.feet)
    lam = np.tile([0, 0, robot.mass * 9.81], (T - 1, C, 1)) * share[:, None]
    return reference(base, points, lam, robot=robot)


def trotting(*, T=17, speed=0.3) -> Reference:
    """Diagonal pairs in turn carry the weight, with feet that jump to their next place in an arc."""
    t = 0.05 * np.arange(T)
    base = np.stack([speed * t, 0 * t, np.full(T, ROBOT.standing_height)], axis=1)
    points, lam = np.empty((T, 4, 3)), np.zeros((T - 1, 4, 3))
    for c in range(4):
        phase = 2.5 * t + (0.0 if c in (0, 3) else 0.5)
        swing = np.clip(2 * (phase % 1.0) - 1, 0, 1)
        x = (np.floor(phase) + swing - (0.0 if c in (0, 3) else 0.5) + 0.25) / 2.5 * speed
        points[:, c] = np.stack([x, 0 * x, 0.05 * np.sin(np.pi * swing)], axis=1) + ROBOT.nominal_feet[c] * [1, 1, 0]
        lam[:, c, 2] = np.where(swing[1:] > 0, 0.0, ROBOT.mass * 9.81 / 2)
    return reference(base, points, lam)


@pytest.fixture(scope="module")
def trot():
    return refine(ROBOT, trotting(), terrain=FLAT, mu=0.6)


def test_derivatives_against_finite_differences():
    model, rng, e = WholeBodyModel(ROBOT), np.random.default_rng(0), 1e-6
    K, nv = 3, ROBOT.model.nv
    q = plus(np.tile(ROBOT.q_nominal, (K + 2, 1)), 0.3 * rng.normal(size=(K + 2, nv)))
    h, lam = rng.uniform(0.3, 0.6, K + 1), 30 * rng.normal(size=(K, 4, 3))
    D, kinematics = model.steps(q, h, lam).D, model.kinematics(q)
    assert D is not None
    coupled, moved = model.structure()
    assert np.all(coupled[:6])
    assert coupled[6:, 6:].sum() == 4 * 3 * 3
    assert not np.any(D[:, :, ~coupled])
    assert not np.any(kinematics.J[:, ~moved.repeat(3, axis=0).reshape(4, 3, nv)])
    for i in range(nv):
        for n in range(K + 2):
            d = np.zeros((K + 2, nv))
            d[n, i] = e
            change = model.steps(plus(q, d), h).residual(lam) - model.steps(plus(q, -d), h).residual(lam)
            want = np.array([D[k, n - k, :, i] if 0 <= n - k <= 2 else np.zeros(nv) for k in range(K)])
            assert np.allclose(change / (2 * e), want, atol=1e-4)
        d = np.zeros((K + 2, nv))
        d[:, i] = e
        up, down = model.kinematics(plus(q, d)), model.kinematics(plus(q, -d))
        assert np.allclose((up.points - down.points) / (2 * e), kinematics.J[..., i], atol=1e-6)
        assert np.allclose(minus(up.base, down.base) / (2 * e), kinematics.J_base[..., i], atol=1e-6)


def test_minus_undoes_plus():
    rng = np.random.default_rng(1)
    d = rng.normal(size=(5, ROBOT.model.nv))
    q = np.tile(ROBOT.q_nominal, (5, 1))
    assert np.allclose(minus(plus(q, d), q), d)


def test_standing_has_the_torques_of_statics():
    """In its middle: near its ends, where a force moves the body little, the equal forces that were asked for pull."""
    out = refine(ROBOT, standing(T=31), terrain=FLAT, mu=0.6)
    m = out.motion
    assert out.status == "converged"
    assert all(c.holds for c in verify_whole_body(ROBOT, m, terrain=FLAT, mu=0.6).values())
    assert np.allclose(m.lam[10:20].sum(axis=1), [0, 0, ROBOT.mass * 9.81], atol=0.1)
    # Without motion, torques are gravity less what the ground carries.
    data = ROBOT.model.createData()
    for q, tau, lam in zip(m.q[10:20], m.tau[10:20], m.lam[10:20], strict=True):
        gravity = pin.computeGeneralizedGravity(ROBOT.model, data, q)[6:].copy()
        pin.computeJointJacobians(ROBOT.model, data, q)
        pin.updateFramePlacements(ROBOT.model, data)
        for name, force in zip(ROBOT.foot_names, lam, strict=True):
            frame = ROBOT.model.getFrameId(name)
            gravity -= pin.getFrameJacobian(ROBOT.model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3, 6:].T @ force
        assert np.allclose(tau, gravity, atol=0.02)
    assert np.abs(m.tau).max() > 2


def test_free_fall_needs_no_torque():
    start = standing(T=8, height=1.0)
    drop = 9.81 * 0.05**2 * np.arange(8) * (np.arange(8) + 1) / 2  # what the semi-implicit step makes of it
    points = start.points - drop[:, None, None] * [0, 0, 1]
    air = reference(start.q[:, :3] - drop[:, None] * [0, 0, 1], points, 0 * start.lam)
    v = air.v.copy()
    v[0] = 2 * v[1] - v[2]
    air = replace(air, v=v)
    out = refine(ROBOT, air, terrain=FLAT, mu=0.6)
    assert out.status == "converged"
    com = np.array([pin.centerOfMass(ROBOT.model, ROBOT.model.createData(), q) for q in out.motion.q])
    assert np.allclose(np.diff(com, 2, axis=0) / 0.05**2, [0, 0, -9.81], atol=1e-2)
    assert np.abs(out.motion.tau).max() < 0.02
    assert out.motion.lam.max() < 1e-4


def test_trot_verifies(trot):
    checks = verify_whole_body(ROBOT, trot.motion, terrain=FLAT, mu=0.6)
    assert trot.status == "converged"
    assert all(c.holds for c in checks.values()), {n: c for n, c in checks.items() if not c.holds}
    assert checks["dynamics_residual"].value < 1e-7
    assert checks["slip_per_second"].value < 1e-3
    # It is the trot that was asked for.
    ours = point_foot_reference(ROBOT, MODEL, trot.motion)
    assert np.linalg.norm(ours.points - trotting().points, axis=2).mean() < 0.01
    assert np.all(ours.points[..., 2].max(axis=0) > 0.02)


def test_turning_changes_nothing():
    """The same motion heading elsewhere has the same torques."""
    there = trotting(T=9)
    R = Rotation.from_euler("z", 2.0)
    turned = R.apply(there.points.reshape(-1, 3)).reshape(there.points.shape)
    q = np.concatenate(
        [R.apply(there.q[:, :3]), (R * Rotation.from_quat(there.q[:, 3:7])).as_quat(), turned.reshape(9, -1)], axis=1
    )
    v = np.concatenate(
        [R.apply(there.v[:, :3]), there.v[:, 3:6], R.apply(there.v[:, 6:].reshape(-1, 3)).reshape(9, -1)], axis=1
    )
    a = refine(ROBOT, there, terrain=FLAT, mu=0.6)
    b = refine(ROBOT, replace(there, q=q, v=v), terrain=FLAT, mu=0.6)
    assert np.allclose(a.motion.tau, b.motion.tau, atol=1e-2)


@pytest.mark.parametrize(
    "terrain", [Terrain((Box(-9, 9, -9, 9, 0.1),)), Terrain(slopes=(Slope(-9, 9, -9, 9, 0.8, 0.1, 0.05),))]
)
def test_ground_that_is_not_zero(terrain):
    start = standing()
    up = terrain.height(start.points)
    lifted = reference(
        start.q[:, :3] + up.mean(axis=1)[:, None] * [0, 0, 1], start.points + up[..., None] * [0, 0, 1], start.lam
    )
    out = refine(ROBOT, lifted, terrain=terrain, mu=0.6)
    assert out.status == "converged"
    assert all(c.holds for c in verify_whole_body(ROBOT, out.motion, terrain=terrain, mu=0.6).values())


def test_weak_motors_are_named():
    weak = replace(ROBOT, effort=0.1 * ROBOT.effort)
    out = refine(weak, standing(T=21), terrain=FLAT, mu=0.6, settings=Settings(iterations=12))
    assert out.status != "converged"
    checks = verify_whole_body(weak, out.motion, terrain=FLAT, mu=0.6)
    assert not all(c.holds for c in checks.values())


def test_the_point_foot_view_keeps_every_points_equation(trot):
    ours = point_foot_reference(ROBOT, MODEL, trot.motion)
    defect = dynamics_defect(MODEL, ours)
    assert defect[:, 3:].max() < 1e-9
    assert defect[:, :2].max() < 1e-9
    assert np.allclose(ours.lam, trot.motion.lam)


def test_arrays_round_trip(trot):
    again = WholeBody.from_arrays(trot.motion.to_arrays())
    for name, array in trot.motion.to_arrays().items():
        assert np.array_equal(array, again.to_arrays()[name])
    with pytest.raises(InvalidData, match="tau"):
        replace(trot.motion, tau=trot.motion.tau[:, 1:])


@pytest.mark.parametrize(
    ("check", "name", "index", "value"),
    [
        ("dynamics_residual", "tau", (3, 2), 0.01),
        ("dynamics_residual", "lam", (3, 0, 1), 0.01),
        ("dynamics_residual", "v", (4, 4), 1e-4),
        ("dynamics_residual", "q", (5, 1), 1e-4),
        ("dynamics_residual", "q", (5, 9), 1e-4),
        ("dynamics_residual", "t", (5,), 1e-3),
        ("complementarity", "lam", (slice(None), slice(None), 2), 5.0),
        ("penetration", "q", (slice(None), 2), -0.002),
        ("friction_violation", "lam", (slice(None), slice(None), 1), 60.0),
        ("pull", "lam", (3, slice(None), 2), -100.0),
        ("slip_per_second", "q", (slice(None), 0), np.linspace(0, 0.1, 17)),
        ("torque_ratio", "tau", (2, 5), 40.0),
        ("speed_ratio", "v", (4, 8), 40.0),
        ("joint_range", "q", (4, 9), -3.0),
    ],
)
def test_the_verifier_catches(trot, check, name, index, value):
    assert verify_whole_body(ROBOT, trot.motion, terrain=FLAT, mu=0.6)[check].holds
    x = getattr(trot.motion, name).copy()
    x[index] += value
    assert not verify_whole_body(ROBOT, replace(trot.motion, **{name: x}), terrain=FLAT, mu=0.6)[check].holds


def test_a_motion_of_another_robot_is_refused(trot):
    with pytest.raises(InvalidData, match="another robot"):
        verify_whole_body(ROBOT, replace(trot.motion, robot_digest="other"), terrain=FLAT, mu=0.6)


def test_a_cycle_closes():
    """One stride forwards, and one that turns: the end is the start, carried on, of robot and point-foot view."""
    open_ended = trotting(T=9)
    turn, speed = 0.2, 0.3 * 0.4
    cycle = np.array([speed, 0.0, 0.0, 0.0])
    out = refine(ROBOT, replace(open_ended, cycle=cycle), terrain=FLAT, mu=0.6)
    checks = verify_whole_body(ROBOT, out.motion, terrain=FLAT, mu=0.6)
    assert out.status == "converged"
    assert all(c.holds for c in checks.values()), {n: c for n, c in checks.items() if not c.holds}
    assert checks["cycle_gap"].value < 1e-6
    assert cycle_gap(point_foot_reference(ROBOT, MODEL, out.motion)).max() < 1e-6
    turned = refine(ROBOT, replace(open_ended, cycle=np.append(cycle[:3], turn)), terrain=FLAT, mu=0.6)
    assert verify_whole_body(ROBOT, turned.motion, terrain=FLAT, mu=0.6)["cycle_gap"].holds
    q = turned.motion.q.copy()
    q[-1, 0] += 1e-4
    assert not verify_whole_body(ROBOT, replace(turned.motion, q=q), terrain=FLAT, mu=0.6)["cycle_gap"].holds


def test_a_humanoid_stands():
    """Toe and heel of each foot share its weight, hands carry nothing."""
    robot = load_robot("g1")
    out = refine(robot, standing(T=7, robot=robot), terrain=FLAT, mu=0.6)
    assert out.status == "converged"
    checks = verify_whole_body(robot, out.motion, terrain=FLAT, mu=0.6)
    assert all(c.holds for c in checks.values()), {n: c for n, c in checks.items() if not c.holds}
    assert out.motion.lam[3].sum(axis=0)[2] == pytest.approx(robot.mass * 9.81, rel=0.02)
    assert out.motion.lam[:, 4:].max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "name"), [("go1", "cat00"), ("a1", "cat00"), ("go2", "dog_cpr")])
def test_key_points_of_the_paper(robot, name):
    from slomo.formats import load_keypoints
    from slomo.optimize import stage
    from slomo.retarget import stage as retarget
    from slomo.stage import Artifact, Inputs, Silent

    path = SHARED / "keypoints" / f"{name}.json"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    motion = load_keypoints(path, note=lambda message: None)
    config = retarget.Config(step_height=0.1 if name == "dog_cpr" else 0.0)
    raw, robot = Artifact(npz={"keypoints.npz": motion.to_arrays()}), load_robot(robot)
    source = retarget.run(Inputs(artifacts={"import": raw}, robot=robot), config, Silent())
    out = stage.run(Inputs(artifacts={"retarget": source}, robot=robot), stage.Config(model="whole-body"), Silent())
    report = out.json["report.json"]
    assert out.failure is None
    assert report["whole_body"]["status"] == "converged"
    assert report["body_error"] < 0.02
    assert report["foot_error"] < 0.03
    WholeBody.from_arrays(out.npz["whole_body.npz"])
