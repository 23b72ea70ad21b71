"""Retargeting on walks made here, where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import clean, feet
from slomo.retarget.stage import Config, run
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from walking import PHASE, walk

GO1 = load_robot("go1")


def moved(motion: KeypointMotion, scale: float, yaw: float, offset: tuple[float, ...]) -> KeypointMotion:
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return replace(motion, positions=scale * motion.positions @ R.T + np.array(offset))


def retarget(motion: KeypointMotion, config: Config | None = None) -> tuple[KeypointMotion, Artifact]:
    source = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    out = run(Inputs(artifacts={"import": source}, robot=GO1), config or Config(), Silent())
    return KeypointMotion.from_arrays(out.npz["keypoints.npz"]), out


def test_scale_height_and_distance_are_the_robots():
    motion, out = retarget(walk(leg=0.5))
    scale = out.json["report.json"]["scale"]
    assert scale == pytest.approx(GO1.standing_height / 0.5, rel=0.03)
    assert np.median(motion["base"][:, 2]) == pytest.approx(GO1.standing_height, rel=0.02)
    assert motion["base"][-1, 0] == pytest.approx(scale * 0.6 * motion.t[-1], rel=0.05)
    np.testing.assert_allclose(motion["base"][0, :2], 0, atol=1e-9)


@pytest.mark.parametrize(("scale", "yaw"), [(0.1, 0.0), (7.0, 2.0), (1.0, -3.0)])
def test_result_does_not_depend_on_units_heading_or_place(scale, yaw):
    expected, _ = retarget(walk())
    got, _ = retarget(moved(walk(), scale, yaw, (3.0, -2.0, 0.7)))
    np.testing.assert_allclose(got.positions, expected.positions, atol=2e-3)


def test_gait_order_and_duty_survive():
    motion, _ = retarget(walk())
    assert motion.contact is not None
    np.testing.assert_allclose(motion.contact[20:140].mean(axis=0), 0.7, atol=0.15)  # three whole periods
    start = {}
    for limb in PHASE:
        on = motion.contact[:, motion.contact_names.index(f"{limb}_foot")]
        start[limb] = motion.t[np.flatnonzero(np.diff(on) > 0)] % 0.8
    lag = {limb: np.angle(np.exp(2j * np.pi * (start[limb] - start["hind_left"][0]) / 0.8).mean()) for limb in PHASE}
    for limb, phase in PHASE.items():
        assert abs(np.angle(np.exp(1j * (lag[limb] - 2 * np.pi * phase)))) < 2 * np.pi * 0.08


def test_standing_feet_stand_even_when_the_reconstruction_slides():
    slid = walk()
    drift = np.stack([0.15 * slid.t, 0.1 * np.sin(2 * slid.t), 0.05 * np.sin(slid.t)], axis=1)
    motion, out = retarget(replace(slid, positions=slid.positions + drift[:, None]))
    assert motion.contact is not None
    for limb in GO1.limb_names:
        foot, on = motion[f"{limb}_foot"], motion.contact[:, motion.contact_names.index(f"{limb}_foot")] > 0
        for start, end in feet.runs(on):
            assert np.ptp(foot[start:end], axis=0).max() < 1e-9
    assert out.json["report.json"]["slide_removed_m"] > 0.05


def test_spikes_and_gaps_do_not_reach_the_robot():
    clean_motion, _ = retarget(walk())
    bad = walk()
    positions, confidence = bad.positions.copy(), bad.confidence.copy()
    positions[30, 3] += 4.0
    positions[50:52, 5, 2] += 3.0
    confidence[60:64, 1] = 0
    positions[60:64, 1] = 0
    motion, _ = retarget(replace(bad, positions=positions, confidence=confidence))
    assert np.linalg.norm(motion.positions - clean_motion.positions, axis=2).max() < 0.05


def test_missing_limb_stays_under_its_hip_with_confidence_zero():
    motion = walk()
    confidence = motion.confidence.copy()
    confidence[:, motion.index("front_left_paw")] = 0
    got, out = retarget(replace(motion, confidence=confidence))
    assert out.json["report.json"]["unseen_limbs"] == ["front_left"]
    assert np.all(got.confidence[:, got.index("front_left_foot")] == 0)
    np.testing.assert_allclose(got["front_left_foot"][:, :2], got["front_left_hip"][:, :2], atol=1e-9)


def test_impossible_turns_are_cut_out():
    motion = walk(seconds=4.0)
    flipped = motion.positions.copy()
    flipped[90:, :, :2] = 2 * flipped[90, :, :2].mean(axis=0) - flipped[90:, :, :2]
    _, out = retarget(replace(motion, positions=flipped))
    start, end = out.json["report.json"]["used_s"]
    assert start == pytest.approx(0, abs=0.05)
    assert 2.5 < end < 3.0


def test_step_lies_between_front_and_hind_feet():
    standing = walk(speed=0.0)
    motion, out = retarget(standing, Config(step_height=0.1))
    (box,) = out.json["terrain.json"]["boxes"]
    assert motion["hind_left_foot"][:, 0].max() < box["x_min"] < motion["front_left_foot"][:, 0].min()
    assert motion["front_left_foot"][:, 2].min() == pytest.approx(0.1)
    hips = motion["front_left_hip"][:, 2] - motion["hind_left_hip"][:, 2]
    np.testing.assert_allclose(np.median(hips), 0.1, atol=0.01)
    with pytest.raises(InvalidData, match="does not fit"):
        retarget(walk(), Config(step_height=0.1))


def test_wrong_input_is_named():
    motion = walk()
    names = tuple(n.replace("hind_left_paw", "x") for n in motion.names)
    with pytest.raises(InvalidData, match="no key point 'hind_left_paw'"):
        retarget(replace(motion, names=names))
    with pytest.raises(UsageError, match="leave nothing"):
        retarget(motion, Config(start=9.0))


def test_smoother_keeps_slow_sines_and_halves_at_the_cutoff():
    dt = 0.01
    t = np.arange(0, 6, dt)
    for f, gain in ((0.5, 1.0), (4.0, 0.5), (16.0, 0.01)):
        x = np.sin(2 * np.pi * f * t)[:, None]
        y = clean.smooth(x, np.ones(len(t)), dt=dt, cutoff=4.0)
        middle = slice(150, -150)
        assert np.sum(x[middle] * y[middle]) / np.sum(x[middle] ** 2) == pytest.approx(gain, abs=0.12)


def test_creep_at_an_end_of_a_stance_is_swing_and_a_shuffle_is_a_step():
    dt, T = 0.02, 100
    x = np.zeros((T, 2))
    x[:10, 0] = np.linspace(-0.3, 0, 10)  # still landing
    standing = np.ones(T, bool)
    trimmed = feet.split(x, standing, dt=dt, tolerance=0.05, step=0.24)
    assert feet.runs(trimmed) == [(9, T)] or feet.runs(trimmed) == [(8, T)]
    x[:, 0] = 0.3 / (1 + np.exp(-(np.arange(T) - 50) / 3))
    (_, end), (start, _) = feet.runs(feet.split(x, standing, dt=dt, tolerance=0.05, step=0.24))
    assert end < 50 < start
