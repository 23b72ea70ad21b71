"""Tracking: entering a motion, following it, falling, and what is reported."""

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import MissingInput, UsageError
from slomo.motion import Reference, Rollout
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, Terrain
from slomo.track import metrics
from slomo.track.lead_in import with_lead_in
from slomo.track.loop import _fallen
from slomo.track.stage import Config, run

H = 0.02


def sway(robot, *, seconds=1.0, shift=0.03, jump=0.0):
    """The body sways over standing feet, or (with a jump, m) also rises to where no leg reaches."""
    t = np.arange(round(seconds / H) + 1) * H
    T, w = len(t), 2 * np.pi
    q, v = np.zeros((T, 19)), np.zeros((T, 18))
    q[:, 6], q[:, 2] = 1.0, robot.standing_height + jump * t / seconds
    q[:, 1], v[:, 1] = shift * np.sin(w * t), shift * w * np.cos(w * t)
    q[:, 7:] = (robot.nominal_feet + [0, 0, robot.standing_height]).ravel()
    u = np.tile([0.0, 0.0, robot.mass * 9.81 / 4], (T - 1, 4))
    return Reference(t, np.full(T - 1, H), q, v, u, u.reshape(T - 1, 4, 3), robot.foot_names, robot.digest)


def track(reference, robot, terrain=None, **config):
    terrain = terrain or Terrain()
    upstream = Artifact(npz={"reference.npz": reference.to_arrays()}, json={"terrain.json": terrain.to_json()})
    return run(Inputs({"optimize": upstream}, {}, robot), Config(**config), Silent())


@cache
def swayed(name="go1"):
    robot = load_robot(name)
    return track(sway(robot), robot)


@pytest.mark.parametrize("name", ["go1", "a1", "go2"])
def test_sways_without_falling(name):
    artifact = swayed(name)
    m = artifact.json["metrics.json"]
    assert artifact.failure is None
    assert not m["fell"]
    assert m["body_rmse"] < 0.02
    assert m["foot_rmse"] < 0.02
    assert m["orientation_rmse"] < 3
    assert m["torque_ratio_p99"] < 1
    assert m["state"] == "estimated"
    assert 0 < m["mpc_ms_p50"] <= m["mpc_ms_p99"]
    assert m["missed_ticks"] >= 0


def test_rollout_is_whole_and_in_step_with_the_reference():
    robot = load_robot("go1")
    r = Rollout.from_arrays(swayed().npz["rollout.npz"])
    T = len(r.t)
    np.testing.assert_allclose(np.diff(r.t), 0.002, atol=1e-9)
    assert r.t[0] < 0
    assert r.t[-1] == pytest.approx(1.0, abs=0.01)
    shapes = dict(q=(T, 19), v=(T, 18), q_des=(T, 12), tau=(T, 12), body=(T, 7), points=(T, 4, 3), lam=(T, 4, 3))
    assert {k: getattr(r, k).shape for k in shapes} == shapes
    assert np.all(np.abs(r.tau) <= robot.effort + 1e-9)
    assert r.joint_names == robot.joint_names
    assert len(r.reference_digest) == 64
    # The reference's world is the plane of the feet's centres.
    frames = (robot.base, *robot.foot_names)
    data, ids = robot.model.createData(), [robot.model.getFrameId(name) for name in frames]
    for k in range(0, T, 100):
        pin.framesForwardKinematics(robot.model, data, r.q[k])
        seen = np.array([data.oMf[i].translation for i in ids]) - [0, 0, robot.foot_radius]
        np.testing.assert_allclose(seen, np.vstack([r.body[k, :3], r.points[k]]), atol=1e-9)
    assert np.all(np.abs(r.points[:, :, 2]) < 0.005)
    np.testing.assert_allclose(
        np.interp(r.t[r.t >= 0], r.t, r.body_ref[:, 1]), 0.03 * np.sin(2 * np.pi * r.t[r.t >= 0]), atol=1e-3
    )
    carried = r.lam[r.t > 0].sum(axis=1)[:, 2].mean()
    assert carried == pytest.approx(robot.mass * 9.81, rel=0.03)


def test_an_odd_number_of_milliseconds():
    """One row more than half of them."""
    robot, h, n = load_robot("go1"), 0.021, 14
    r = sway(robot, seconds=n * H, shift=0.0)
    artifact = track(dataclasses.replace(r, t=h * np.arange(n + 1), h=np.full(n, h)), robot)
    t = artifact.npz["rollout.npz"]["t"]
    assert len(t) == 599
    assert t[-1] == pytest.approx(n * h - 0.001)


def test_same_inputs_give_the_same_rollout():
    robot = load_robot("go1")
    a, b = (track(sway(robot, seconds=0.3), robot).npz["rollout.npz"] for _ in range(2))
    for name in a:
        if name != "mpc_ms":
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_a_fall_is_reported_and_kept():
    robot = load_robot("go1")
    reference = sway(robot, seconds=1.5)
    over = Rotation.from_euler("x", np.linspace(0, np.pi, len(reference.t))[:, None]).as_quat()
    q = reference.q.copy()
    q[:, 3:7] = over
    artifact = track(dataclasses.replace(reference, q=q), robot)
    m = artifact.json["metrics.json"]
    assert m["fell"]
    assert artifact.failure is not None
    assert "fell" in artifact.failure
    assert " s" in m["fall"]
    assert 1.0 < len(artifact.npz["rollout.npz"]["t"]) * 0.002 < 2.4


def test_who_rears_as_the_reference_does_has_not_fallen():
    robot = load_robot("go1")

    def fallen(tilt: float, wanted: float) -> bool:
        q = np.concatenate([[0, 0, robot.standing_height], Rotation.from_euler("y", -tilt, degrees=True).as_quat()])
        return _fallen(q, robot.standing_height, wanted, Terrain(), robot, False) is not None

    assert fallen(65, 0)
    assert fallen(65, 20)
    assert not fallen(65, 45)
    assert not fallen(75, 60)
    assert fallen(95, 60)


def test_slippery_ground_shows():
    robot = load_robot("go1")
    slippery = track(sway(robot, shift=0.06), robot, friction=0.02).json["metrics.json"]
    assert slippery["fell"] or slippery["foot_rmse"] > 3 * swayed().json["metrics.json"]["foot_rmse"]


@pytest.mark.parametrize(
    ("config", "where"),
    [
        ({"mpc_hz": 333}, "track.mpc_hz"),
        ({"kp": 0.0}, "track.kp"),
        ({"settle": -1.0}, "track.settle"),
        ({"horizon": -1}, "track.horizon"),
    ],
)
def test_parameters_out_of_range(config, where):
    robot = load_robot("go1")
    with pytest.raises(UsageError, match=where):
        track(sway(robot), robot, **config)


def test_reference_of_another_robot():
    with pytest.raises(MissingInput, match="optimize --robot a1"):
        track(sway(load_robot("go1")), load_robot("a1"))


def test_lead_in_stands_and_arrives():
    robot = load_robot("go1")
    model = PointFootModel.from_robot(robot)
    terrain = Terrain((Box(0.05, 1, -1, 1, 0.1),))
    reference = sway(robot)
    q, v = reference.q.copy(), reference.v.copy()
    q[:, [2, 9, 12]] += 0.1
    q[0, 12] += 0.03  # the front right foot begins in the air
    v[0, 9:12] = [0.8, 0.0, 0.2]
    v[0, :6] = [0.3, 0.1, 0.05, 0.2, -0.1, 0.4]
    reference = dataclasses.replace(reference, q=q, v=v)
    whole = with_lead_in(reference, model, standing=robot.nominal_feet, terrain=terrain, settle=0.3, blend=0.6)
    n = int(np.sum(whole.t < 0))
    np.testing.assert_array_equal(whole.q[n:], reference.q)
    assert whole.t[0] == pytest.approx(-0.9, abs=H)
    assert np.all(whole.v[0] == 0)
    np.testing.assert_allclose(whole.points[0, :, 2], [0.1, 0.1, 0, 0], atol=1e-12)
    still = whole.t < -0.65
    assert np.all(np.ptp(whole.q[still], axis=0) == 0)
    # It arrives at the reference's state: one more step of its own velocity lands there.
    step = whole.q[n] - whole.q[n - 1]
    np.testing.assert_allclose(step[:3], H * v[0, :3], atol=2e-3)
    np.testing.assert_allclose(whole.v[n - 1, :6], v[0, :6], atol=0.06)
    # Its velocities are the derivatives of its positions.
    middle = (whole.q[2:n, :3] - whole.q[: n - 2, :3]) / (2 * H)
    np.testing.assert_allclose(middle, whole.v[1 : n - 1, :3], atol=0.01)
    # Standing, the forces carry the body without turning it.
    u = whole.u[0].reshape(4, 3)
    np.testing.assert_allclose(u.sum(axis=0), [0, 0, model.mass * 9.81], atol=1e-9)
    np.testing.assert_allclose(np.cross(whole.points[0] - whole.q[0, :3], u).sum(axis=0), 0, atol=1e-9)


def test_lead_in_of_a_motion_that_begins_in_flight():
    robot = load_robot("go1")
    reference = sway(robot)
    q = reference.q.copy()
    q[:, [2, 9, 12, 15, 18]] += 0.05
    model = PointFootModel.from_robot(robot)
    whole = with_lead_in(
        dataclasses.replace(reference, q=q),
        model,
        standing=robot.nominal_feet,
        terrain=Terrain(),
        settle=0.3,
        blend=0.6,
    )
    np.testing.assert_allclose(whole.points[0, :, 2], 0, atol=1e-12)
    assert np.all(whole.u[whole.t[:-1] == -H] == 0)


def _lengths(whole: Reference, model: PointFootModel) -> np.ndarray:
    roots = whole.q[:, None, :3] + np.einsum(
        "nij,cj->nci", Rotation.from_quat(whole.q[:, 3:7]).as_matrix(), model.leg_roots
    )
    return np.linalg.norm(roots - whole.points, axis=-1)


@pytest.mark.parametrize("ahead", [0.02, 0.2])
def test_legs_reach_their_feet_in_the_lead_in(ahead: float):
    robot = load_robot("go1")
    model = PointFootModel.from_robot(robot)
    reference = sway(robot)
    q, v = reference.q.copy(), reference.v.copy()
    q[:, 2] += 0.1  # on stretched legs
    q[:, 7] += ahead  # the front left foot stands further ahead
    v[0, 0] = 0.6  # and the body comes from behind
    whole = with_lead_in(
        dataclasses.replace(reference, q=q, v=v), model, standing=robot.nominal_feet, terrain=Terrain(), settle=0.3,
        blend=0.6,
    )  # fmt: skip
    early = whole.t < -0.3
    before = _lengths(dataclasses.replace(whole, q=np.where(np.arange(19) == 2, q[0, 2], whole.q)), model)[early]
    assert np.any(before > model.leg_max + 0.005) or ahead > 0.1  # as high as the motion begins, a leg would not reach
    assert np.all(_lengths(whole, model)[early] < model.leg_max + 1e-3)
    stands = whole.points[0, 0, 0] - reference.points[0, 0, 0]
    assert stands == pytest.approx(ahead, abs=1e-9) if ahead < 0.1 else stands < 0.1  # too far: it steps there
    n = int(np.sum(whole.t < 0))
    assert np.abs(np.diff(whole.q[: n + 1, :3], axis=0)).max() < 0.02
    middle = (whole.q[2:n, :3] - whole.q[: n - 2, :3]) / (2 * H)
    np.testing.assert_allclose(middle, whole.v[1 : n - 1, :3], atol=0.02)


def _standing_g1(**lifted: float) -> tuple[PointFootModel, Reference]:
    """A G1 that stands and is about to walk, some of its points (by name) m higher."""
    robot = load_robot("g1")
    model = PointFootModel.from_robot(robot)
    t = np.arange(51) * H
    q, v = np.zeros((51, 7 + 3 * model.C)), np.zeros((51, 6 + 3 * model.C))
    q[:, 6], q[:, 2] = 1.0, robot.standing_height
    q[:, 7:] = (robot.nominal_feet + [0, 0, robot.standing_height]).ravel()
    for name, up in lifted.items():
        q[:, 9 + 3 * model.names.index(name)] += up
    v[0, 0] = 0.6
    zero = np.zeros((50, model.C, 3))
    return model, Reference(t, np.full(50, H), q, v, zero.reshape(50, -1), zero, robot.foot_names, robot.digest)


def test_hands_come_along_with_the_body_in_the_lead_in():
    model, reference = _standing_g1()
    standing = load_robot("g1").nominal_feet
    whole = with_lead_in(reference, model, standing=standing, terrain=Terrain(), settle=0.3, blend=0.6)
    rel = whole.points[:, np.flatnonzero(model.is_hand)] - whole.q[:, None, :3]
    assert np.abs(whole.q[0, :2]).max() > 0.02
    np.testing.assert_allclose(rel[0], rel[-1], atol=0.02)
    np.testing.assert_allclose(rel[0], (reference.points[0] - reference.q[0, :3])[model.is_hand], atol=1e-9)
    assert np.all(_lengths(whole, model)[whole.t < -0.3] < model.leg_max + 1e-3)


def test_nobody_stands_on_toes_alone_before_the_motion():
    model, reference = _standing_g1(left_heel=0.03)
    standing = load_robot("g1").nominal_feet
    whole = with_lead_in(reference, model, standing=standing, terrain=Terrain(), settle=0.3, blend=0.6)
    toe, heel = (model.names.index(n) for n in ("left_toe", "left_heel"))
    np.testing.assert_allclose(whole.points[0, :, 2][~model.is_hand], 0, atol=1e-9)
    apart = np.linalg.norm(whole.points[0, toe] - whole.points[0, heel])
    assert apart == pytest.approx(model.pair_length[0], abs=1e-6)
    assert np.all(whole.lam[0, [toe, heel], 2] > 0.05 * model.total_mass * model.g)
    np.testing.assert_array_equal(whole.points[whole.t < 0, toe], np.broadcast_to(reference.points[0, toe], (45, 3)))
    last = int(np.sum(whole.t < 0)) - 1
    assert whole.points[last, heel, 2] == pytest.approx(0.03, abs=3e-3)


def test_errors_of_a_known_offset():
    r = Rollout.from_arrays(swayed().npz["rollout.npz"])
    body = r.body_ref.copy()
    body[:, :3] += [0.03, 0, 0.04]
    body[:, 3:] = (Rotation.from_quat(body[:, 3:]) * Rotation.from_euler("x", 5, degrees=True)).as_quat()
    body[r.t < 0, :3] += 100  # entering the motion does not count
    moved = dataclasses.replace(r, body=body, points=r.points_ref + [0.0, 0.02, 0.0])
    e = metrics.errors(moved)
    assert e["body_rmse"] == pytest.approx(0.05)
    assert e["foot_rmse"] == pytest.approx(0.02)
    assert e["orientation_rmse"] == pytest.approx(5)
    before = np.full_like(r.t, -1.0)
    assert metrics.errors(dataclasses.replace(r, t=before))["body_rmse"] is None


def stepping(t, *, down, up):
    """(T, 4, 3) N: every foot stands but for [up, down) (s) each."""
    lam = np.zeros((len(t), 4, 3))
    for c in range(4):
        lam[:, c, 2] = np.where((t >= up[c]) & (t < down[c]), 0.0, 30.0)
    return lam


def test_contact_times_that_are_known():
    robot = load_robot("go1")
    reference = sway(robot)
    planned = stepping(reference.t[:-1], up=[0.2, 0.4, 0.6, 2.0], down=[0.3, 0.5, 0.7, 2.1])
    r = Rollout.from_arrays(swayed().npz["rollout.npz"])
    lam = stepping(r.t, up=[0.21, 0.4, 0.6, 2.0], down=[0.3, 0.53, 0.601, 2.1])
    lam[np.abs(r.t - 0.75) < 0.006, 3] = 0.0  # a bounce is no step
    timing = metrics.contact_timing(dataclasses.replace(r, lam=lam), dataclasses.replace(reference, lam=planned))
    assert timing["contact_events"] == 6
    assert timing["contact_events_missed"] == 2  # the third foot hardly left the ground
    assert timing["contact_timing_error"] == pytest.approx((0.01 + 0 + 0 + 0.03) / 4, abs=0.002)
    assert timing["contact_agreement"] == pytest.approx(1 - (0.01 + 0.03 + 0.099 + 0.012) / 4, abs=0.003)


def test_the_estimates_errors_that_are_known():
    r = Rollout.from_arrays(swayed().npz["rollout.npz"])
    body = r.body.copy()
    body[:, 2] -= 0.02
    body[r.t >= 0, 0] += 0.04 * r.t[r.t >= 0]
    body[:, 3:] = (Rotation.from_euler("ZX", [3, 0], degrees=True) * Rotation.from_quat(body[:, 3:])).as_quat()
    e = metrics.estimate(dataclasses.replace(r, body_est=body))
    assert e["estimate_end"] == pytest.approx(np.hypot(0.02, 0.04), abs=1e-3)
    assert e["estimate_height_rmse"] == pytest.approx(0.02)
    assert e["estimate_heading_rmse"] == pytest.approx(3.0)
    assert e["estimate_tilt_rmse"] == pytest.approx(0.0, abs=1e-6)


def test_a_stand_that_every_foot_can_bear():
    """A motion that begins beside its feet, one of them up and far ahead: the stand before it is none of that."""
    robot = load_robot("go1")
    model = PointFootModel.from_robot(robot)
    reference = sway(robot)
    q = reference.q.copy()
    q[:, 1] += 0.12
    q[0, 7:10] += [0.3, 0.1, 0.1]
    whole = with_lead_in(
        dataclasses.replace(reference, q=q),
        model,
        standing=robot.nominal_feet,
        terrain=Terrain(),
        settle=0.3,
        blend=0.6,
    )
    standing = whole.points[0] - whole.q[0, :3]
    np.testing.assert_allclose(standing[0, :2], robot.nominal_feet[0, :2], atol=0.13)
    assert np.linalg.norm(standing[0] - model.leg_roots[0]) < model.leg_max[0]
    lam = whole.lam[0, :, 2]
    assert lam.sum() == pytest.approx(robot.mass * 9.81, rel=1e-6)
    assert np.all(lam > 0.05 * robot.mass * 9.81)
    # It comes from rest and arrives where the motion begins, without a jump.
    n = int(np.sum(whole.t < 0))
    assert np.abs(np.diff(whole.q[: n + 1, :3], axis=0)).max() < 0.02
    np.testing.assert_allclose(whole.v[whole.t < -0.61, :3], 0, atol=1e-12)
