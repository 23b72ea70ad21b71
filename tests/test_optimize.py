"""The optimiser on a small trot, its verifier against tampered references, and the stage."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion, Reference
from slomo.optimize import problem, stage
from slomo.optimize.solve import Settings, solve
from slomo.optimize.verify import verify
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, HeightField, Slope, Terrain

SHARED = Path(__file__).parents[2] / "shared"
ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)


def trot(*, duration=1.0, speed=0.3, turn=0.0, terrain=Terrain()) -> KeypointMotion:  # noqa: B008
    """Key points of a trot of 2.5 strides per second, as retargeting would give them."""
    t = np.linspace(0, duration, round(50 * duration) + 1)
    base = np.zeros((len(t), 3))
    base[:, 0], base[:, 2] = speed * t, ROBOT.standing_height
    R = Rotation.from_euler("z", (turn * t)[:, None])
    hips = base[:, None] + np.stack([R.apply(h) for h in ROBOT.nominal_hips], axis=1)
    feet = np.empty_like(hips)
    for c in range(4):
        phase = 2.5 * t + (0.0 if c in (0, 3) else 0.5)
        k, s = np.floor(phase), phase % 1.0
        swing = np.clip((s - 0.5) / 0.5, 0, 1)
        when = (k + swing * swing * (3 - 2 * swing) - (0.0 if c in (0, 3) else 0.5) + 0.25) / 2.5
        beside = Rotation.from_euler("z", (turn * when)[:, None]).apply(ROBOT.nominal_feet[c] * [1, 1, 0])
        feet[:, c] = np.stack([speed * when, 0 * when, 0.05 * np.sin(np.pi * swing)], axis=1) + beside
    feet[..., 2] += terrain.height(feet)
    base[:, 2] += terrain.height(feet).mean(axis=1)
    hips[..., 2] += terrain.height(feet).mean(axis=1)[:, None]
    names = ("base", *(f"{n}_hip" for n in ROBOT.limb_names), *(f"{n}_foot" for n in ROBOT.limb_names))
    positions = np.concatenate([base[:, None], hips, feet], axis=1)
    return KeypointMotion(t=t, positions=positions, names=names, confidence=np.ones(positions.shape[:2]))


def optimize(motion, *, terrain=Terrain(), **config) -> Artifact:  # noqa: B008
    source = Artifact(npz={"keypoints.npz": motion.to_arrays()}, json={"terrain.json": terrain.to_json()})
    return stage.run(Inputs(artifacts={"retarget": source}, robot=ROBOT), stage.Config(**config), Silent())


@pytest.fixture(scope="module")
def result() -> Artifact:
    return optimize(trot())


@pytest.fixture(scope="module")
def reference(result) -> Reference:
    return Reference.from_arrays(result.npz["reference.npz"])


def test_targets_follow_the_key_points():
    motion = trot(turn=0.5)
    want = problem.targets(motion, MODEL, Terrain(), dt=0.05)
    assert np.allclose(np.diff(want.t), 0.05)
    yaw = Rotation.from_quat(want.q[:, 3:7]).as_euler("ZYX")
    assert np.allclose(yaw, np.stack([0.5 * want.t, 0 * want.t, 0 * want.t], axis=1), atol=1e-3)
    assert np.allclose(want.q[1:, 7:], want.q[:-1, 7:] + 0.05 * want.v[1:, 6:])
    assert np.all(problem.targets(motion, MODEL, Terrain((Box(-9, 9, -9, 9, 0.1),)), dt=0.05).points[..., 2] >= 0.1)


def test_missing_feet_are_bridged_or_put_under_the_hip():
    motion = trot()
    i = motion.index("front_left_foot")
    gap = motion.confidence.copy()
    gap[10:20, i] = 0
    wild = motion.positions.copy()
    wild[10:20, i] = 99.0
    want = problem.targets(replace(motion, confidence=gap, positions=wild), MODEL, Terrain(), dt=0.05)
    assert np.abs(want.points).max() < 2
    assert want.foot_confidence[:, 0].min() == 0
    gap[:, i] = 0
    want = problem.targets(replace(motion, confidence=gap, positions=wild), MODEL, Terrain(), dt=0.05)
    assert np.allclose(want.points[:, 0], (want.q[:, :3] + MODEL.hips[0]) * [1, 1, 0], atol=1e-6)


def test_trot_verifies(result, reference):
    report = result.json["report.json"]
    assert result.failure is None
    assert report["verified"] is True
    assert report["status"] == "converged"
    assert report["dynamics_residual"] < 1e-6
    assert report["complementarity"] <= 1e-4
    assert report["penetration"] < 1e-3
    assert report["slip_per_second"] < 0.01
    assert report["torque_ratio"] < 1
    assert report["body_error"] < 0.02
    assert report["foot_error"] < 0.03
    assert reference.point_names == ROBOT.foot_names
    assert reference.robot_digest == ROBOT.digest
    # It is a trot still: diagonal pairs alternate, and the feet are lifted.
    gap = reference.points[..., 2]
    assert np.all(gap.max(axis=0) > 0.02)
    assert np.corrcoef(gap[:, 0], gap[:, 3])[0, 1] > 0.5
    assert np.corrcoef(gap[:, 0], gap[:, 1])[0, 1] < 0


def test_the_same_input_gives_the_same_output(result):
    again = optimize(trot())
    for name, array in result.npz["reference.npz"].items():
        assert np.array_equal(array, again.npz["reference.npz"][name]), name


def test_a_step_under_the_front_feet():
    ahead = Terrain((Box(0.05, 2.0, -1.0, 1.0, 0.1),))
    out = optimize(trot(speed=0.0), terrain=ahead)
    assert out.failure is None
    points = Reference.from_arrays(out.npz["reference.npz"]).points
    assert points[:, :2, 2].min() >= 0.1
    assert points[:, 2:, 2].min() < 0.001


def test_what_does_not_hold_fails_and_is_kept():
    """Two steps from the start nothing has converged: the stage says so, with the iterate for inspection."""
    out = optimize(trot(speed=0.6), iterations=1, starts=1, kappa=1.0)
    assert out.failure is not None
    assert "complementarity" in out.failure
    assert "the solver ended with" in out.failure
    assert out.json["report.json"]["verified"] is False
    assert np.all(np.isfinite(out.npz["reference.npz"]["q"]))


def test_feet_that_slide_too_far_are_made_to_stick():
    report = optimize(trot(speed=0.6), slip=0.0).json["report.json"]
    assert len(report["attempts"]) > 1
    assert "stick" in report["attempts"][1]
    assert report["verified"]
    assert report["slip_per_second"] < 1e-9


def test_overloaded_joints_get_weaker_legs():
    """With weaker motors the same trot asks less of them, or says which joint it overloads."""
    weak = replace(ROBOT, effort=0.45 * ROBOT.effort)
    source = Artifact(npz={"keypoints.npz": trot().to_arrays()}, json={"terrain.json": Terrain().to_json()})
    strong = stage.run(Inputs({"retarget": source}, robot=ROBOT), stage.Config(), Silent()).json["report.json"]
    out = stage.run(Inputs({"retarget": source}, robot=weak), stage.Config(), Silent())
    assert strong["torque_ratio"] > 0.45
    assert any("overloaded" in what for what in out.json["report.json"]["attempts"])
    assert out.json["report.json"]["torque_ratio"] < strong["torque_ratio"] / 0.45


def test_user_errors():
    with pytest.raises(UsageError, match=r"optimize\.dt"):
        optimize(trot(), dt=0.0)
    with pytest.raises(UsageError, match=r"optimize\.slip"):
        optimize(trot(), slip=-1.0)
    motion = trot()
    short = KeypointMotion(
        t=motion.t[:3], positions=motion.positions[:3], names=motion.names, confidence=motion.confidence[:3]
    )
    with pytest.raises(InvalidData, match="shorter than two steps"):
        optimize(short)
    renamed = replace(motion, names=("root", *motion.names[1:]))
    with pytest.raises(InvalidData, match="base"):
        optimize(renamed)
    blind = replace(motion, confidence=np.zeros_like(motion.confidence))
    with pytest.raises(InvalidData, match="no confidence"):
        optimize(blind)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cat00", "dog_cpr"])
def test_key_points_of_the_paper(name):
    from slomo.formats import load_keypoints
    from slomo.retarget import stage as retarget

    path = SHARED / "keypoints" / f"{name}.json"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    motion = load_keypoints(path, note=lambda message: None)
    dt = float(motion.t[1] - motion.t[0])
    config = retarget.Config(start=26 * dt, end=108 * dt, step_height=0.1) if name == "dog_cpr" else retarget.Config()
    raw = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    source = retarget.run(Inputs(artifacts={"import": raw}, robot=ROBOT), config, Silent())
    out = stage.run(Inputs(artifacts={"retarget": source}, robot=ROBOT), stage.Config(), Silent())
    assert out.failure is None


def test_a_cycle_closes_and_repeats():
    """The end of the cycle is its start, moved: a second cycle may follow, and the verifier holds over both."""
    out = optimize(trot(duration=2.0, turn=0.2), cyclic=True)
    report, r = out.json["report.json"], Reference.from_arrays(out.npz["reference.npz"])
    assert out.failure is None
    assert 0.25 <= r.t[-1] <= 1.0
    assert r.cycle[3] == pytest.approx(0.2 * r.t[-1], abs=0.02)
    assert report["cycle"][1] - report["cycle"][0] == pytest.approx(r.t[-1])
    turn = Rotation.from_euler("z", r.cycle[3])
    q, v = r.q.copy(), r.v.copy()
    q[:, 3:7] = (turn * Rotation.from_quat(q[:, 3:7])).as_quat()
    for i in (0, 7, 10, 13, 16):
        q[:, i : i + 3] = turn.apply(q[:, i : i + 3]) + r.cycle[:3]
    for i in (0, 6, 9, 12, 15):
        v[:, i : i + 3] = turn.apply(v[:, i : i + 3])
    forces = [np.stack([turn.apply(x) for x in y.reshape(-1, 4, 3)]) for y in (r.u, r.lam)]
    assert report["cycle_gap"] <= 1e-6
    late = replace(r, v=np.vstack([r.v[:-1], r.v[-1:] + 2e-6]))
    assert not verify(MODEL, late, terrain=Terrain())["cycle_gap"].holds
    assert q[0] == pytest.approx(r.q[-1], abs=1e-6)
    assert v[0] == pytest.approx(r.v[-1], abs=1e-6)
    twice = Reference(
        t=np.concatenate([r.t, r.t[-1] + r.t[1:]]), h=np.tile(r.h, 2), q=np.vstack([r.q, q[1:]]),
        v=np.vstack([r.v, v[1:]]), u=np.vstack([r.u, forces[0].reshape(len(r.u), -1)]),
        lam=np.concatenate([r.lam, forces[1]]), point_names=r.point_names, robot_digest=r.robot_digest,
    )  # fmt: skip
    checks = verify(MODEL, twice, terrain=Terrain())
    assert [n for n, c in checks.items() if not c.holds and n != "dynamics_residual"] == []
    assert checks["dynamics_residual"].value < 1e-5  # what the end misses, over one step


def test_legs_spread_far_beside_a_high_body_stay_within_the_joints():
    motion = trot(speed=0.0)
    spread = motion.positions.copy()
    for name, side in (("front_left", 1), ("hind_left", 1), ("front_right", -1), ("hind_right", -1)):
        spread[:, motion.index(f"{name}_foot"), 1] += 0.16 * side
    spread[:, [motion.index(n) for n in ("base", *(n for n in motion.names if n.endswith("_hip")))], 2] += 0.06
    out = optimize(replace(motion, positions=spread))
    assert out.failure is None
    assert out.json["report.json"]["joint_miss"] < 5e-3


def test_no_cycle_without_swings():
    motion = trot()
    standing = replace(motion, positions=np.tile(motion.positions[:1], (len(motion.t), 1, 1)))
    with pytest.raises(InvalidData, match="every foot swings"):
        optimize(standing, cyclic=True)


def test_strides_too_long_for_the_legs_make_the_motion_smaller():
    motion = trot(speed=0.3)
    large = replace(motion, positions=motion.positions * [1.0, 1.0, 1.7])
    fixed, free = optimize(large), optimize(large, free_scale=True)
    scale = free.json["report.json"]["scale"]
    assert fixed.json["report.json"]["scale"] == 1.0
    assert 0.6 <= scale < 0.95
    assert free.json["report.json"]["body_error"] < fixed.json["report.json"]["body_error"]


def test_free_step_lengths_stay_within_their_bounds_and_help():
    fixed, free = optimize(trot(speed=0.6)), optimize(trot(speed=0.6), shortest_step=0.7, longest_step=1.3)
    h = free.npz["reference.npz"]["h"]
    assert free.failure is None
    assert np.ptp(h) > 1e-4
    assert 0.035 - 1e-9 <= h.min() <= h.max() <= 0.065 + 1e-9
    assert free.json["report.json"]["cost"] < fixed.json["report.json"]["cost"]


@pytest.mark.parametrize(
    "terrain",
    [
        Terrain(slopes=(Slope(-5, 5, -5, 5, height=-1.0, slope_x=0.2, slope_y=0.05),)),
        Terrain(field=HeightField(-2, -2, 0.5, tuple(tuple(0.03 * ((i + j) % 3) for j in range(9)) for i in range(9)))),
    ],
    ids=["slope", "height field"],
)
def test_ground_that_is_not_level(terrain):
    out = optimize(trot(terrain=terrain), terrain=terrain)
    report = out.json["report.json"]
    assert out.failure is None, out.failure
    assert report["foot_error"] < 0.03
    r = Reference.from_arrays(out.npz["reference.npz"])
    n = terrain.normal(r.points[1:])
    gamma = np.sum(n * r.lam, axis=2)
    assert np.mean(gamma > 1.0) > 0.3
    assert np.all(np.linalg.norm(r.lam - gamma[..., None] * n, axis=2) <= 0.6 * gamma + 1e-6)


def test_a_turn_through_two_radians_and_a_body_pitched_by_sixty_degrees():
    """Rotations are exact: nothing of the motion depends on the heading, and a steep body is reached and verifies."""
    turned = optimize(trot(duration=2.0, speed=0.1, turn=1.2))
    heading = Rotation.from_quat(turned.npz["reference.npz"]["q"][[0, -1], 3:7]).as_euler("ZYX")[:, 0]
    assert turned.failure is None
    assert np.ptp(heading) == pytest.approx(2.4, abs=0.1)
    motion = trot(duration=1.0, speed=0.0)
    t = motion.t[:, None]
    pitch = Rotation.from_euler("y", -np.radians(60) * np.sin(np.pi * t / 1.0) ** 2)
    positions = motion.positions.copy()
    for c in range(4):
        positions[:, 1 + c] = positions[:, 0] + pitch.apply(MODEL.hips[c])
    confidence = motion.confidence.copy()
    confidence[:, 5:7] = 0.0  # the front feet go where they may
    # Weights that prefer the posture to everything else.
    reared = replace(motion, positions=positions, confidence=confidence)
    out = optimize(reared, orientation=5e3, position=10.0, foot=10.0, foot_height=10.0)
    steepest = Rotation.from_quat(out.npz["reference.npz"]["q"][:, 3:7]).as_euler("ZYX")[:, 1].min()
    assert out.failure is None or "joint" in out.failure, out.failure
    assert np.degrees(steepest) == pytest.approx(-60, abs=4)
    assert out.json["report.json"]["dynamics_residual"] < 1e-9


def test_other_starts_when_the_first_one_fails():
    """One Newton step is not enough from any start: all are tried, and the failure is told."""
    want = problem.targets(trot(), MODEL, Terrain(), dt=0.05)
    task = problem.make_task(MODEL, want, Terrain(), problem.Weights())
    start, told = problem.make_start(MODEL, want, task), []
    few = Settings(iterations=1, rounds=1, starts=3)
    out = solve(MODEL, task, start, terrain=Terrain(), settings=few, report=lambda f, m: told.append(m))
    assert not out.converged
    assert out.starts == 3
    assert sum("another one" in m for m in told) == 2
    assert solve(MODEL, task, start, terrain=Terrain()).starts == 1


def test_heading_does_not_matter():
    motion = trot()
    R = Rotation.from_euler("z", 1.1)
    there = replace(motion, positions=R.apply(motion.positions.reshape(-1, 3)).reshape(motion.positions.shape))
    a, b = (optimize(m).npz["reference.npz"]["q"] for m in (motion, there))
    assert R.apply(a[:, :3]) == pytest.approx(b[:, :3], abs=2e-3)
