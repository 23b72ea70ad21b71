"""What is tried when the verifier objects: each remedy on joints that are made to object."""

from dataclasses import replace

import numpy as np
import pytest

from slomo.motion import Reference
from slomo.optimize import plan, problem, stage
from slomo.optimize.inverse import JointMotion, joint_motion
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.robot_workspace import directions
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Terrain
from test_optimize import MODEL, ROBOT, optimize, trot


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference.from_arrays(optimize(trot()).npz["reference.npz"])


@pytest.fixture(scope="module")
def joints(reference) -> JointMotion:
    return joint_motion(ROBOT, reference)


def test_forces_are_limited_around_an_overloaded_step_and_for_that_limb_only(reference, joints):
    want = problem.targets(trot(), MODEL, Terrain(), dt=0.05)
    task = problem.make_task(MODEL, want, Terrain(), problem.Weights())
    tau = np.zeros_like(joints.tau)
    j = ROBOT.joint_names.index("FL_calf_joint")
    tau[8, j] = 2.0 * ROBOT.effort[j]
    limited = plan._limit_forces(ROBOT, replace(joints, tau=tau), reference, task)
    changed = np.argwhere(np.any(limited.u_high < task.u_high, axis=1)).ravel()
    assert 8 in changed
    assert np.all(np.abs(changed - 8) <= 2)
    c = ROBOT.foot_names.index("FL_foot")
    others = [i for i in range(12) if i // 3 != c]
    assert np.array_equal(limited.u_high[:, others], task.u_high[:, others])
    assert np.array_equal(limited.u_low, -limited.u_high)
    assert np.all(limited.u_high > 0)


def test_a_leg_that_is_missed_along_itself_gets_shorter(reference, joints):
    c, k = 0, 5
    root = reference.q[k, :3] + MODEL.leg_roots[c]  # the trot is level and straight
    along = (reference.points[k, c] - root) / np.linalg.norm(reference.points[k, c] - root)
    reached, miss = reference.points.copy(), np.zeros_like(joints.miss)
    reached[k, c] -= 0.02 * along
    miss[k, c] = 0.02
    less = plan._less_room(replace(joints, reached=reached, miss=miss), reference, MODEL)
    assert less.leg_max[c] < MODEL.leg_max[c]
    assert np.array_equal(np.delete(less.leg_max, c), np.delete(MODEL.leg_max, c))
    assert np.array_equal(less.workspace, MODEL.workspace)


def test_a_point_that_is_missed_sideways_gets_less_room_there(reference, joints):
    c, k = 0, 5
    reached, miss = reference.points.copy(), np.zeros_like(joints.miss)
    reached[k, c, 1] -= 0.02
    miss[k, c] = 0.02
    less = plan._less_room(replace(joints, reached=reached, miss=miss), reference, MODEL)
    n = np.flatnonzero(less.workspace[c] < MODEL.workspace[c])
    assert len(n) == 1
    assert directions()[n[0], 1] > 0.9
    assert np.array_equal(less.leg_max, MODEL.leg_max)


def test_the_trunk_is_told_from_the_legs():
    robot = load_robot("g1")
    nothing = JointMotion(*(np.zeros((1, 1)) for _ in range(5)), miss=np.zeros((1, 6)), reached=np.zeros((1, 6, 3)))
    for name, trunk in (("waist_roll_joint", True), ("left_knee_joint", False), ("left_shoulder_roll_joint", True)):
        tau = np.zeros((1, len(robot.effort)))
        j = robot.joint_names.index(name)
        tau[0, j] = 1.1 * robot.effort[j]
        assert plan._trunk_overloaded(robot, replace(nothing, tau=tau)) == trunk


def test_a_motion_that_no_force_limit_saves_is_slowed_down_and_says_so():
    weak = replace(ROBOT, effort=0.3 * ROBOT.effort)
    source = Artifact(npz={"keypoints.npz": trot(speed=0.8).to_arrays()}, json={"terrain.json": Terrain().to_json()})
    out = stage.run(Inputs({"retarget": source}, robot=weak), stage.Config(), Silent())
    report, r = out.json["report.json"], Reference.from_arrays(out.npz["reference.npz"])
    assert len(report["attempts"]) <= plan.ATTEMPTS
    assert any("slowed down" in what for what in report["attempts"])
    assert r.t[-1] == pytest.approx(report["slowed"])  # of one second
    assert report["dynamics_residual"] < 1e-9
    assert report["verified"] == (out.failure is None)
    assert PointFootModel.from_robot(weak).total_mass == pytest.approx(MODEL.total_mass)
