"""The optimiser on a small trot, its verifier against tampered references, and the stage."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion, Reference
from slomo.optimize import problem, stage
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, Terrain

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
        x = (k + swing * swing * (3 - 2 * swing) - (0.0 if c in (0, 3) else 0.5) + 0.25) / 2.5 * speed
        feet[:, c] = np.stack([x, 0 * x, 0.05 * np.sin(np.pi * swing)], axis=1) + ROBOT.nominal_feet[c] * [1, 1, 0]
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
    """Without a cost on it, feet slide: the stage says so, with the iterate for inspection."""
    out = optimize(trot(speed=0.6), slip=0.0)
    assert out.failure is not None
    assert "slip_per_second" in out.failure
    assert out.json["report.json"]["verified"] is False
    assert np.all(np.isfinite(out.npz["reference.npz"]["q"]))


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
