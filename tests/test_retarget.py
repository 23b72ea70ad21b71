"""Retargeting on walks made here, where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import clean, feet
from slomo.retarget.stage import Config, run
from slomo.robot import load_robot
from slomo.runs import runs
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
    leg = float((GO1.nominal_hips - GO1.nominal_feet)[:, 2].mean())
    assert scale == pytest.approx(leg / 0.5, rel=0.03)
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
        for start, end in runs(on):
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


def test_step_goes_down_too_and_parts_left_from_right():
    standing = walk(speed=0.0)
    motion, out = retarget(standing, Config(step_height=-0.08))
    assert motion["hind_left_foot"][:, 2].min() == pytest.approx(0.08)
    assert motion["front_left_foot"][:, 2].min() == pytest.approx(0.0)
    motion, out = retarget(standing, Config(step_height=0.05, step_limbs=("front_right", "hind_right")))
    (box,) = out.json["terrain.json"]["boxes"]
    assert motion["front_right_foot"][:, 1].max() < box["y_max"] < motion["front_left_foot"][:, 1].min()


def tilts(motion: KeypointMotion) -> Rotation:
    """World from body, from base and hips."""
    arms = motion.positions[:, 1:5] - motion.positions[:, :1]
    return Rotation.concatenate([Rotation.align_vectors(a, GO1.nominal_hips)[0] for a in arms])


@pytest.mark.parametrize("seconds_up", [1.5, 6.0])
def test_rearing_by_sixty_degrees_is_kept(seconds_up):
    seconds, angle = 6.0, np.radians(60)
    motion = walk(speed=0.0, seconds=seconds)
    up = angle * np.clip((seconds_up / 2 + 0.3 - np.abs(motion.t - seconds / 2)) / 0.5, 0, 1)
    got, out = retarget(raised(motion, up))
    said = np.degrees(np.arcsin(tilts(got).as_matrix()[:, 2, 0]))
    assert said.max() == pytest.approx(60, abs=6)
    report = out.json["report.json"]
    assert report["held_up"] == ([] if seconds_up < 6 else ["front_left", "front_right"])
    middle = np.abs(got.t - seconds / 2) < 0.3
    assert got.contact is not None
    assert np.all(got.contact[middle, :2] == 0)
    assert got.contact[middle, 2:].mean() > 0.5  # it treads on the spot
    assert got["front_left_foot"][middle, 2].min() > 0.1
    assert report["beyond_reach_fraction"] == 0


def raised(motion: KeypointMotion, angle: np.ndarray) -> KeypointMotion:
    """Turned up about the hind hips by angle (T,) rad, front legs and all."""
    out = motion.positions.copy()
    pivot = (motion["hind_left_hip"] + motion["hind_right_hip"]) / 2
    for i, name in enumerate(motion.names):
        if name.startswith("front"):
            d = out[:, i] - pivot
            out[:, i, 0] = pivot[:, 0] + np.cos(angle) * d[:, 0] - np.sin(angle) * d[:, 2]
            out[:, i, 2] = pivot[:, 2] + np.sin(angle) * d[:, 0] + np.cos(angle) * d[:, 2]
    return replace(motion, positions=out)


def test_turning_on_a_circle_is_kept():
    source = walk(seconds=6.0)
    angle = 0.5 * source.positions[..., 0] / 0.6  # 0.5 rad/s at 0.6 m/s
    radius = 1.2 - source.positions[..., 1]
    circle = np.stack([radius * np.sin(angle), 1.2 - radius * np.cos(angle), source.positions[..., 2]], axis=2)
    _, out = retarget(replace(source, positions=circle))
    assert out.json["report.json"]["heading_change_rad"] == pytest.approx(0.5 * source.t[-1], abs=0.1)


def test_long_legs_take_shorter_steps_and_it_is_said():
    long_strides = walk(leg=0.5, speed=2.2, period=0.9)
    motion, out = retarget(long_strides)
    report = out.json["report.json"]
    assert report["stride_scale"] < 0.7
    assert report["distance_m"] == pytest.approx(report["stride_scale"] * report["scale"] * 2.2 * motion.t[-1], rel=0.1)
    assert any("strides shortened" in line for line in notes(long_strides))


def notes(motion: KeypointMotion, config: Config | None = None) -> list[str]:
    said: list[str] = []
    progress = Silent()
    progress.note = said.append  # type: ignore[method-assign]
    source = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    run(Inputs(artifacts={"import": source}, robot=GO1), config or Config(), progress)
    return said


@pytest.mark.parametrize("rate", [10.0, 240.0])
def test_frame_rate_changes_little(rate):
    source = walk()
    t = np.arange(0, source.t[-1], 1 / rate)
    positions = np.stack(
        [np.stack([np.interp(t, source.t, x) for x in p.T], axis=1) for p in source.positions.swapaxes(0, 1)], axis=1
    )
    got, _ = retarget(replace(source, t=t, positions=positions, confidence=np.ones(positions.shape[:2])))
    expected, _ = retarget(source)
    n = min(len(got.t), len(expected.t))
    assert np.linalg.norm(got.positions[:n] - expected.positions[:n], axis=2).mean() < 0.015


def test_repeated_frames_and_a_late_start_change_little():
    source = walk()
    frames = np.arange(len(source.t))
    frames[5::7] -= 1
    got, _ = retarget(replace(source, t=source.t + 40.0, positions=source.positions[frames]))
    expected, _ = retarget(source)
    assert np.linalg.norm(got.positions - expected.positions, axis=2).mean() < 0.01


def test_what_stands_in_a_gap_does_not_matter():
    source = walk()
    confidence = source.confidence.copy()
    confidence[20:45, 3] = confidence[70:, 5] = 0
    out = []
    for value in (0.0, 1e6):
        positions = source.positions.copy()
        positions[confidence == 0] = value
        out.append(retarget(replace(source, positions=positions, confidence=confidence))[0].positions)
    np.testing.assert_array_equal(*out)
    assert any("longest of 0.83 s in front_left_paw" in line for line in notes(replace(source, confidence=confidence)))


def test_tilted_and_sinking_ground_is_leveled():
    source = walk(seconds=6.0)
    tilt = 0.08
    R = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    got, out = retarget(replace(source, positions=source.positions @ R.T))
    expected, _ = retarget(source)
    assert np.linalg.norm(got.positions - expected.positions, axis=2).max() < 0.05
    assert out.json["report.json"]["leveled_rad"][1] == pytest.approx(tilt, abs=0.01)


def test_one_unseen_shoulder_is_placed_beside_the_other():
    source = walk()
    confidence = source.confidence.copy()
    confidence[:, source.index("front_left_shoulder")] = 0
    broken = replace(source, confidence=confidence)
    got, expected = retarget(broken)[0], retarget(source)[0]
    np.testing.assert_allclose(got.positions, expected.positions, atol=0.01)
    assert any("front_left_shoulder was never seen" in line for line in notes(broken))


def test_wrong_input_is_named():
    motion = walk()
    names = tuple(n.replace("hind_left_paw", "x") for n in motion.names)
    needed = "front_left_paw, front_right_paw, hind_left_paw, hind_right_paw"
    with pytest.raises(InvalidData, match=rf"no key point 'hind_left_paw', .* \(it has: .* x.*; needed: {needed}\)"):
        retarget(replace(motion, names=names))
    with pytest.raises(InvalidData, match=r"no key point 'nose' \(it has: hind_left_hip, "):
        motion["nose"]
    with pytest.raises(UsageError, match="leave nothing"):
        retarget(motion, Config(start=9.0))
    exchanged = tuple(n.replace("left", "x").replace("right", "left").replace("x", "right") for n in motion.names)
    with pytest.raises(InvalidData, match="on its back most of the time; check that left and right"):
        retarget(replace(motion, names=exchanged))


@pytest.mark.parametrize(
    "given",
    [
        {"rate": 0.0}, {"body_cutoff": -1.0}, {"foot_cutoff": 0.0}, {"max_turn_rate": 0.0}, {"scale": -1.0},
        {"start": -0.1}, {"end": -1.0},
    ],
)  # fmt: skip
def test_a_parameter_out_of_range_is_refused(given):
    with pytest.raises(UsageError, match=rf"retarget\.{next(iter(given))}: needs a number "):
        Config(**given)


def test_an_unknown_limb_is_told_once():
    for limbs, what in ((("front_left", "tail"), "no limb 'tail'"), ((), "no limb is named")):
        with pytest.raises(UsageError) as error:
            retarget(walk(), Config(step_height=0.05, step_limbs=limbs))
        valid = "(valid: front_left, front_right, hind_left, hind_right)"
        assert str(error.value) == f"retarget.step_limbs: {what} {valid}"


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
    assert runs(trimmed) == [(9, T)] or runs(trimmed) == [(8, T)]
    x[:, 0] = 0.3 / (1 + np.exp(-(np.arange(T) - 50) / 3))
    (_, end), (start, _) = runs(feet.split(x, standing, dt=dt, tolerance=0.05, step=0.24))
    assert end < 50 < start
