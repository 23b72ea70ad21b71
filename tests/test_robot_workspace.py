"""The hull of what a limb's joints reach."""

import numpy as np
import pinocchio as pin
import pytest

from slomo.robot import load_robot
from slomo.robot_workspace import directions


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_every_pose_within_the_joint_limits_is_inside(name):
    robot = load_robot(name)
    n, data, rng = directions(), robot.model.createData(), np.random.default_rng(0)
    assert np.linalg.norm(n, axis=1) == pytest.approx(np.ones(len(n)))
    assert np.all(robot.nominal_feet @ n.T < robot.workspace)
    q, beyond = robot.q_nominal.copy(), []
    T_base = robot.model.getFrameId(robot.base)
    for _ in range(2000):
        q[7:] = rng.uniform(robot.lower, robot.upper)
        pin.framesForwardKinematics(robot.model, data, q)
        for c, foot in enumerate(robot.foot_names):
            x = data.oMf[T_base].actInv(data.oMf[robot.model.getFrameId(foot)].translation)
            if x[2] <= -robot.clearance[c]:
                beyond.append((n @ x - robot.workspace[c]).max())
    # Other samples than those that made the hull: few lie outside, an arm of seven joints by some centimetres.
    assert np.max(beyond) < 0.05
    assert np.mean(np.array(beyond) > 0.005) < 0.005


def test_a_foot_across_the_body_is_outside():
    """Within the length of a Go1's leg, but not within its hip's range (1.05 rad)."""
    robot = load_robot("go1")
    across = np.array([robot.nominal_feet[0, 0], robot.leg_roots[0, 1] - 0.24, -0.2])
    length = np.linalg.norm(across - robot.leg_roots[0])
    assert robot.root_reach[0, 0] < length < robot.root_reach[0, 1]
    assert np.any(directions() @ across > robot.workspace[0])
