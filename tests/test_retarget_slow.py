"""Jumps in slow motion are played as fast as jumps are."""

from pathlib import Path

import numpy as np
import pytest

from slomo.formats import load_keypoints
from slomo.motion import KeypointMotion
from slomo.retarget import stage
from slomo.retarget.feet import slow_motion
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent

PAPER = Path(__file__).parents[2] / "shared" / "keypoints" / "human_jumping_jack.json"


def flights(seconds, *, dt=0.02):
    """(T, 2) bool: three of them."""
    standing = np.ones((300, 2), bool)
    for start in (50, 120, 190):
        standing[start : start + round(seconds / dt)] = False
    return standing


def test_flights_that_are_too_long_are_made_as_long_as_a_jump():
    assert slow_motion(flights(0.48), dt=0.02) == pytest.approx(3.0)
    assert slow_motion(flights(0.3), dt=0.02) == 1.0
    assert slow_motion(np.ones((50, 2), bool), dt=0.02) == 1.0
    one_foot = flights(0.6)
    one_foot[:, 1] = True
    assert slow_motion(one_foot, dt=0.02) == 1.0


def test_jumping_jacks_are_jumps():
    if not PAPER.exists():
        pytest.skip(f"{PAPER} is not there")
    raw = load_keypoints(PAPER)
    robot = load_robot("g1")
    out = stage.run(
        Inputs({"import": Artifact(npz={"keypoints.npz": raw.to_arrays()})}, {}, robot), stage.Config(), Silent()
    )
    faster = out.json["report.json"]["played_faster"]
    motion = KeypointMotion.from_arrays(out.npz["keypoints.npz"])
    assert 2 < faster < 3.5
    assert motion.t[-1] == pytest.approx((raw.t[-1] - raw.t[0]) / faster, abs=0.1)
    toes = motion["left_toe"] - motion["right_toe"]
    assert np.ptp(np.linalg.norm(toes[:, :2], axis=1)) > 0.2
