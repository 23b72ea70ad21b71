"""The verifier: a good reference, then the same a little spoilt, so that one check after the other fails alone."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from references import carrying, follow, standing
from slomo.motion import Reference
from slomo.optimize.check import as_report, failure
from slomo.optimize.inverse import joint_motion
from slomo.optimize.verify import cycle_gap, tracking_table, verify
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.terrain import Box, Slope, Terrain

ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)
FLAT = Terrain()
BODY = np.array([0.0, 0.0, ROBOT.standing_height, 0, 0, 0, 1])
FEET = ROBOT.nominal_feet * [1, 1, 0]
REST = standing(MODEL, BODY, FEET)
LEG = np.linalg.norm(MODEL.leg_roots + BODY[:3] - FEET, axis=1)
LEFT, RIGHT, HIND_LEFT = 0, 1, 2


def spoilt(points=None, lam=None) -> Reference:
    """Standing, with edits of the points and forces; the dynamics still hold."""
    p, f = REST.points.copy(), REST.lam.copy()
    if points:
        points(p)
    if lam:
        lam(f)
    return follow(MODEL, REST.h, p, f, body=BODY)


def lifted(height: float) -> Reference:
    """The front left foot bears nothing in the last step and ends at that height (m)."""

    def points(p):
        p[-1, LEFT, 2] = height

    def lam(f):
        f[-1] = carrying(MODEL, BODY[:3], FEET, on=[False, True, True, True])

    return spoilt(points, lam)


def edited(name: str, index, change) -> Reference:
    """Standing, with one array changed and nothing else."""
    arrays = {k: np.array(v) for k, v in REST.to_arrays().items()}
    arrays[name][index] += change
    return Reference.from_arrays(arrays)


def failing(model, reference, terrain=FLAT, robot=ROBOT) -> list[str]:
    return [n for n, c in verify(model, reference, terrain=terrain, robot=robot).items() if not c.holds]


@dataclass
class Case:
    """`reference` fails `check` alone, at `point` and t[knot]; `REST` passes with the same model and robot."""

    check: str
    reference: Reference
    knot: int
    point: str
    model: PointFootModel = MODEL
    robot: object = ROBOT


def weak_knees() -> np.ndarray:
    """(12,) N m: the knees have a little more than standing needs."""
    needs = 1.05 * np.abs(joint_motion(ROBOT, REST).tau).max(axis=0)
    return np.where(["calf" in n for n in ROBOT.joint_names], needs, ROBOT.effort)


def _raise_one(p):
    p[7, LEFT, 2] = 1e-5


def _sideways(p):
    p[7, LEFT, 1] += 1.5e-3


def _creep(p):
    p[1:-1:2, LEFT, 0] += 1e-3
    p[7, LEFT, 0] += 1e-3


def _drag(f):
    push = 1.1 * MODEL.mu * f[9, LEFT, 2]
    f[9, LEFT, 0], f[9, HIND_LEFT, 0] = push, -push  # along one line: the body feels nothing
    f[9, HIND_LEFT, 2] *= 1.2


def _stamp(f):
    f[-1, LEFT, 2] *= 1.3


def _pull(f):
    f[-1] = carrying(MODEL, BODY[:3], FEET, on=[False, True, True, True])
    f[-1, LEFT, 2] = -0.5


def cyclic(points=None, lam=None) -> Reference:
    """Standing as a cycle that goes nowhere; the end is turned by nothing."""
    return replace(spoilt(points, lam), cycle=np.zeros(4))


def _elsewhere(p):
    p[-1, LEFT, 1] += 1e-4


def _pushed_there(f):
    f[-1, LEFT, 1] += MODEL.foot_mass[LEFT] * 1e-4 / REST.h[-1] ** 2  # by the ground: the body feels nothing


CASES = {
    "an input": Case("dynamics_residual", edited("u", (4, 2), 0.01), 5, "front_left"),
    "a contact force": Case("dynamics_residual", edited("lam", (4, 1, 0), 0.01), 5, "front_right"),
    "a body speed": Case("dynamics_residual", edited("v", (-1, 4), 1e-4), -1, "body velocity"),
    "a body place": Case("dynamics_residual", edited("q", (-1, 0), 1e-4), -1, "body position"),
    "a quaternion's length": Case("dynamics_residual", edited("q", (-1, 6), 1e-3), -1, "body rotation"),
    "a foot's place": Case("dynamics_residual", edited("q", (-1, 8), 1e-4), -1, "front_left"),
    "a time": Case("dynamics_residual", edited("t", -1, 1e-3), -1, "time"),
    "a step length": Case("dynamics_residual", edited("h", 8, 1e-4), 9, "time"),
    "force at a gap": Case("complementarity", spoilt(_raise_one), 7, "front_left"),
    "a foot in the ground": Case("penetration", lifted(-0.002), -1, "front_left"),
    "a foot outside of its cone": Case("friction_violation", spoilt(lam=_drag), 10, "front_left"),
    "a sticky foot": Case("pull", spoilt(lam=_pull), -1, "front_left"),
    "a creeping foot": Case("slip_per_second", spoilt(_creep), 7, "front_left"),
    "a strong leg": Case(
        "input_ratio", spoilt(lam=_stamp), -2, "front_left",
        model=replace(MODEL, u_max=1.05 * np.abs(REST.u).max(axis=0).reshape(4, 3) + 1),
    ),
    "a short leg": Case("leg_length", lifted(0.003), -1, "front_left", model=replace(MODEL, leg_min=LEG - 1e-3)),
    "toe and heel": Case(
        "pair_distance", spoilt(_sideways), 7, "front_left to front_right",
        model=replace(MODEL, pairs=[[0, 1]], pair_length=[FEET[0, 1] - FEET[1, 1]]),
    ),
    "a foot at the belly": Case(
        "body_clearance", lifted(0.003), -1, "front_left", model=replace(MODEL, clearance=np.full(4, BODY[2] - 1e-3))
    ),
    "a cycle that does not close": Case("cycle_gap", cyclic(_elsewhere, _pushed_there), -1, "front_left"),
    "a weak motor": Case(
        "torque_ratio", spoilt(lam=_stamp), -2, "FL_calf_joint", robot=replace(ROBOT, effort=weak_knees())
    ),
    "a slow motor": Case(
        "speed_ratio", lifted(0.003), -1, "FL_calf_joint", robot=replace(ROBOT, velocity=np.full(12, 0.3))
    ),
    "narrow joints": Case(
        "joint_miss", lifted(0.02), -1, "front_left",
        robot=replace(ROBOT, lower=ROBOT.q_nominal[7:] - 0.02, upper=ROBOT.q_nominal[7:] + 0.02),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_one_flaw_fails_one_check(case):
    assert failing(case.model, REST, robot=case.robot) == []
    checks = verify(case.model, case.reference, terrain=FLAT, robot=case.robot)
    assert [n for n, c in checks.items() if not c.holds] == [case.check]
    worst = checks[case.check]
    assert worst.point == case.point
    assert worst.t == pytest.approx(case.reference.t[case.knot])
    report, line = as_report(checks), failure(checks)
    assert report["verified"] is False
    assert report["worst"]["check"] == case.check
    assert line is not None
    assert f"{case.check} " in line
    assert f"({case.point}, t = {worst.t:.2f} s)" in line


def test_every_required_check_has_a_flaw():
    model = replace(MODEL, pairs=[[0, 1]], pair_length=[FEET[0, 1] - FEET[1, 1]], clearance=np.zeros(4))
    checks = verify(model, cyclic(), terrain=FLAT, robot=ROBOT, want=Wanted())
    assert {n for n, c in checks.items() if c.required} == {case.check for case in CASES.values()}


def test_a_cycle_turns_and_moves():
    """Standing again elsewhere, turned by 0.7 rad: the same state, seen from there."""
    turn, move = Rotation.from_euler("z", 0.7), np.array([0.3, -0.2, 0.0])
    q, v = REST.q.copy(), REST.v.copy()
    v[0, :6] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    q[-1, :3], q[-1, 3:7] = turn.apply(q[0, :3]) + move, (turn * Rotation.from_quat(q[0, 3:7])).as_quat()
    q[-1, 7:] = (turn.apply(REST.points[0]) + move).ravel()
    v[-1, :3], v[-1, 3:6] = turn.apply(v[0, :3]), v[0, 3:6]
    r = replace(REST, q=q, v=v, cycle=np.append(move, 0.7))
    assert cycle_gap(r).max() < 1e-12
    assert cycle_gap(replace(r, cycle=np.append(move, 0.71))).max() == pytest.approx(0.01, rel=0.1)


def test_standing_is_verified():
    checks = verify(MODEL, REST, terrain=FLAT, robot=ROBOT)
    assert failure(checks) is None
    assert as_report(checks)["verified"] is True


class Wanted:
    """What was wanted: `REST`, moved."""

    def __init__(self, body=0.0, left=0.0):
        self.q = REST.q.copy()
        self.q[5:9, 0] += body
        self.q[:, 7] += left
        self.body_confidence, self.foot_confidence = np.ones(21), np.ones((21, 4))

    @property
    def points(self):
        return self.q[:, 7:].reshape(21, 4, 3)


def test_poor_tracking_is_a_warning():
    for want, name, point, value in (
        (Wanted(body=0.1), "body_error", "body", 0.4 / 21),
        (Wanted(left=0.12), "foot_error", "front_left", 0.03),
    ):
        checks = verify(MODEL, REST, terrain=FLAT, want=want)
        assert [n for n, c in checks.items() if not c.kept] == [name]
        assert checks[name].value == pytest.approx(value)
        assert checks[name].point == point
        assert failure(checks) is None
        assert as_report(checks)["verified"] is True
    table = tracking_table(REST, Wanted(body=0.1, left=0.12), MODEL.names)
    assert table["body"] == {"mean": pytest.approx(0.4 / 21), "max": pytest.approx(0.1), "t": pytest.approx(0.25)}
    assert table["front_left"]["mean"] == pytest.approx(0.12)
    assert table["hind_right"]["max"] == 0


def test_what_was_not_seen_is_not_judged():
    want = Wanted(left=0.12)
    want.foot_confidence[:, LEFT] = 0
    assert verify(MODEL, REST, terrain=FLAT, want=want)["foot_error"].value == 0


def test_the_ground_that_is_there():
    raised = Terrain((Box(-9, 9, -9, 9, 0.05),))
    assert verify(MODEL, REST, terrain=raised)["penetration"].value == pytest.approx(0.05)
    pit = Terrain(slopes=(Slope(-9, 9, -9, 9, height=-0.05),))
    checks = verify(MODEL, REST, terrain=pit)
    assert checks["penetration"].value == 0
    assert checks["complementarity"].value == pytest.approx(0.05 * REST.lam[..., 2].max())
