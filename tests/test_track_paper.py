"""The paper's quadruped motions through retarget, optimize and track, on the Go1."""

import json
from pathlib import Path

import pytest

from slomo.formats import load_keypoints
from slomo.optimize import stage as optimize
from slomo.retarget import stage as retarget
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.track import stage as track

KEYPOINTS = Path(__file__).parents[2] / "shared" / "keypoints"

# m, m, degrees: body and feet of the cat under inverse kinematics and PD with the true state, in an earlier study.
LIMITS = {"body_rmse": 0.016, "foot_rmse": 0.035, "orientation_rmse": 2.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "step", "frames"), [("cat00", 0.0, None), ("dog_cpr", 0.1, (26, 108))], ids=["cat", "dog on a step"]
)
def test_paper_motion_is_tracked(name, step, frames):
    path = KEYPOINTS / f"{name}.json"
    if not path.is_file():
        pytest.skip(f"no {path}")
    dt = json.loads(path.read_text())["FrameDuration"]
    part = {"start": frames[0] * dt, "end": frames[1] * dt} if frames else {}
    robot = load_robot("go1")
    source = Artifact(npz={"keypoints.npz": load_keypoints(path).to_arrays()})
    moved = retarget.run(Inputs({"import": source}, {}, robot), retarget.Config(step_height=step, **part), Silent())
    reference = optimize.run(Inputs({"retarget": moved}, {}, robot), optimize.Config(), Silent())
    assert reference.failure is None
    artifact = track.run(Inputs({"optimize": reference}, {}, robot), track.Config(), Silent())
    metrics = artifact.json["metrics.json"]
    assert artifact.failure is None
    assert {k: metrics[k] for k in LIMITS if metrics[k] > LIMITS[k]} == {}
    assert metrics["simulated_seconds"] > 3
    assert metrics["torque_ratio_p99"] < 1
