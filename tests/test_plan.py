"""What is tried when the verifier objects: each remedy on joints that are made to object."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.optimize import feedback, plan, problem, stage
from slomo.optimize.inverse import JointMotion, joint_motion
from slomo.optimize.load import load_excess
from slomo.optimize.reach import reach_excess
from slomo.optimize.solve import Settings, solve
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Terrain
from test_optimize import MODEL, ROBOT, optimize, trot


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference.from_arrays(optimize(trot()).npz["reference.npz"])


@pytest.fixture(scope="module")
def joints(reference) -> JointMotion:
    return joint_motion(ROBOT, reference)


def test_torques_and_speeds_are_exact_where_they_were_looked_at(reference, joints):
    load, speed = feedback.torques(ROBOT, joints, reference), feedback.speeds(ROBOT, joints, reference)
    at = load_excess(load, reference.u) + load.most, load_excess(speed, reference.v) + speed.most
    assert at[0] == pytest.approx(np.abs(joints.tau) / ROBOT.effort)
    assert at[1] == pytest.approx(np.abs(joints.v[:, 6:]) / ROBOT.velocity)


def test_torques_and_speeds_follow_forces_and_velocities(reference, joints):
    load, speed = feedback.torques(ROBOT, joints, reference), feedback.speeds(ROBOT, joints, reference)
    k, c = 7, ROBOT.foot_names.index("FL_foot")
    own = [i for i, name in enumerate(ROBOT.joint_names) if name.startswith("FL")]
    u = reference.u.copy()
    u[k, 3 * c : 3 * c + 3] += [3.0, -2.0, 5.0]
    lam = reference.lam.copy()
    lam[k, c] += [3.0, -2.0, 5.0]  # what holds the foot where it was
    change = joint_motion(ROBOT, replace(reference, u=u, lam=lam)).tau - joints.tau
    assert np.einsum("kjf,kf->kj", load.arm, u - reference.u) * ROBOT.effort == pytest.approx(change, abs=1e-9)
    # A foot that moves with the body, which also turns, moves no joint; one that moves in it moves its leg's.
    v, w = np.array([0.3, -0.2, 0.1]), np.array([0.4, 0.5, -0.6])
    turn = Rotation.from_quat(reference.q[k, 3:7]).apply(w)
    carried = np.concatenate([v, w, (v + np.cross(turn, reference.points[k] - reference.q[k, :3])).ravel()])
    assert speed.arm[k] @ carried == pytest.approx(0.0, abs=1e-9)
    carried[6 + 3 * c] += 0.1
    moved = speed.arm[k] @ carried * ROBOT.velocity
    assert np.all(np.abs(np.delete(moved, own)) < 1e-9)
    assert (joints.jacobian[k] @ moved)[3 * c] == pytest.approx(0.1, abs=0.01)


def test_where_a_foot_was_missed_its_limb_gets_less_room_and_no_other(reference, joints):
    c, k = 1, 5
    reached, miss = reference.points.copy(), np.zeros_like(joints.miss)
    reached[k, c] -= [0.0, 0.012, 0.016]
    miss[k, c] = 0.02
    reach = feedback.reach(ROBOT, replace(joints, reached=reached, miss=miss), reference)
    assert np.argwhere(np.isfinite(reach.most)).tolist() == [[n, c] for n in range(k - 2, k + 3)]
    beyond = reach_excess(reach, reference.q)
    assert beyond[k, c] == pytest.approx(0.02, abs=2e-3)
    assert beyond[k, c] - 0.02 > 0  # a little less than what was reached
    points = reference.q.copy()
    points[:, 7:] = reached.reshape(len(points), -1)
    assert reach_excess(reach, points)[k, c] == pytest.approx(beyond[k, c] - 0.02)


def test_toe_and_heel_of_a_foot_share_one_half_space():
    robot = load_robot("g1")
    points = np.random.default_rng(0).normal(size=(2, 6, 3))
    q = np.column_stack([np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)), points.reshape(2, -1)])
    toe, heel = robot.pairs[0]
    reached = points.copy()
    reached[0, toe, 2] -= 0.03
    reached[0, heel, 2] += 0.04
    miss = np.linalg.norm(points - reached, axis=2)
    joints = JointMotion(*(np.zeros((1, 1)) for _ in range(6)), miss=miss, reached=reached)
    reference = Reference(
        t=np.array([0.0, 0.1]), h=np.array([0.1]), q=q, v=np.zeros((2, 24)), u=np.zeros((1, 18)),
        lam=np.zeros((1, 6, 3)),
        point_names=robot.foot_names, robot_digest=robot.digest,
    )  # fmt: skip
    reach = feedback.reach(robot, joints, reference)
    assert reach.most.shape == (2, 4)
    assert np.isfinite(reach.most[0]).sum() == 1
    normal = reach.normal[0, np.flatnonzero(np.isfinite(reach.most[0]))[0]].reshape(6, 3)
    assert normal[[toe, heel], 2] == pytest.approx([0.6, -0.8])


def test_the_trunk_is_told_from_the_legs():
    robot = load_robot("g1")
    nothing = JointMotion(*(np.zeros((1, 1)) for _ in range(6)), miss=np.zeros((1, 6)), reached=np.zeros((1, 6, 3)))
    for name, trunk in (("waist_roll_joint", True), ("left_knee_joint", False), ("left_shoulder_roll_joint", True)):
        tau = np.zeros((1, len(robot.effort)))
        j = robot.joint_names.index(name)
        tau[0, j] = 1.1 * robot.effort[j]
        assert feedback.trunk_overloaded(robot, replace(nothing, tau=tau)) == trunk


def test_a_motion_that_no_force_limit_saves_is_slowed_down_and_says_so():
    weak = replace(ROBOT, effort=0.1 * ROBOT.effort)
    source = Artifact(npz={"keypoints.npz": trot(speed=0.8).to_arrays()}, json={"terrain.json": Terrain().to_json()})
    out = stage.run(Inputs({"retarget": source}, robot=weak), stage.Config(), Silent())
    report, r = out.json["report.json"], Reference.from_arrays(out.npz["reference.npz"])
    assert len(report["attempts"]) <= plan.ATTEMPTS
    assert any("slowed down" in what for what in report["attempts"])
    assert r.t[-1] == pytest.approx(report["slowed"])  # of one second
    assert report["dynamics_residual"] < 1e-9
    assert report["verified"] == (out.failure is None)
    assert PointFootModel.from_robot(weak).total_mass == pytest.approx(MODEL.total_mass)


def test_after_an_attempt_that_did_not_converge_the_next_is_slower_and_starts_from_the_last_that_did(monkeypatch):
    real, starts, solutions = plan._solver("ddp"), [], []

    def solver(model, task, start, **how):
        solution = real(model, task, start, **how)
        if len(solutions) == 1:
            solution = replace(solution, status="iteration limit")
        starts.append(start)
        solutions.append(solution)
        return solution

    monkeypatch.setattr(plan, "_solver", lambda name: solver)
    monkeypatch.setattr(plan, "ATTEMPTS", 3)
    weak = replace(ROBOT, effort=0.15 * ROBOT.effort)
    source = Artifact(npz={"keypoints.npz": trot(speed=0.8).to_arrays()}, json={"terrain.json": Terrain().to_json()})
    report = stage.run(Inputs({"retarget": source}, robot=weak), stage.Config(), Silent()).json["report.json"]
    assert "back to the last motion that converged" in report["attempts"][2]
    first, again = solutions[0].iterate, starts[2]
    assert np.array_equal(again.qs, first.qs)
    assert again.vs * 1.15 == pytest.approx(first.vs)
    assert "slowed down to 87 %" in report["attempts"][2]


def test_an_attempt_that_gets_nowhere_is_given_up():
    source = trot(speed=0.8)
    want = problem.targets(source, MODEL, Terrain(), dt=0.05)
    task = problem.make_task(MODEL, want, Terrain(), problem.Weights())
    start = problem.make_start(MODEL, want, task)
    settings = Settings(kappas=(1e-4,), iterations=1, starts=1, patience=2)
    solution = solve(MODEL, task, start, terrain=Terrain(), settings=settings)
    assert (solution.status, solution.iterations) == ("iteration limit", 2)
