"""Retargeting of people made here to a humanoid, where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.retarget import human
from slomo.retarget.stage import Config, run
from slomo.robot import load_robot
from slomo.runs import runs
from slomo.stage import Artifact, Inputs, Silent
from walking import person, walk

G1 = load_robot("g1")
LEG = float((G1.nominal_hips - G1.nominal_feet)[:4, 2].mean())
FIVE = ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle")


def retarget(motion: KeypointMotion, config: Config | None = None) -> tuple[KeypointMotion, dict, list[str]]:
    """The robot's key points, the report and what was said."""
    said: list[str] = []
    progress = Silent()
    progress.note = said.append  # type: ignore[method-assign]
    source = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    out = run(Inputs(artifacts={"import": source}, robot=G1), config or Config(), progress)
    return KeypointMotion.from_arrays(out.npz["keypoints.npz"]), out.json["report.json"], said


def only(motion: KeypointMotion, names: tuple[str, ...]) -> KeypointMotion:
    columns = [motion.index(n) for n in names]
    return replace(
        motion, names=names, positions=motion.positions[:, columns], confidence=motion.confidence[:, columns]
    )


def without(motion: KeypointMotion, *names: str) -> KeypointMotion:
    confidence = motion.confidence.copy()
    confidence[:, [motion.index(n) for n in names]] = 0
    return replace(motion, confidence=confidence)


def body(motion: KeypointMotion) -> Rotation:
    """World from body, from base and hips."""
    arms = motion.positions[:, 1:7] - motion.positions[:, :1]
    return Rotation.concatenate([Rotation.align_vectors(a, G1.nominal_hips)[0] for a in arms])


def test_names_scale_height_and_distance_are_the_robots():
    motion, report, _ = retarget(person(height=1.8, speed=0.6))
    assert motion.names == ("base", *(f"{n}_hip" for n in G1.limb_names), *G1.key_points)
    assert report["scale"] == pytest.approx(LEG / (0.515 * 1.8), rel=0.02)
    assert report["arm_scale"] == pytest.approx(G1.leg_reach[4, 1] / (0.315 * 1.8), rel=0.02)
    assert np.median(motion["left_toe_hip"][:, 2]) == pytest.approx(LEG, rel=0.04)
    expected = report["scale"] * report["stride_scale"] * 0.6 * motion.t[-1]
    assert motion["base"][-1, 0] == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(motion["base"][0, :2], 0, atol=1e-9)


@pytest.mark.parametrize(("scale", "yaw"), [(1e-3, 0.0), (1e3, 2.0), (1.0, -3.0)])
def test_result_does_not_depend_on_units_heading_or_place(scale, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    source = person()
    moved = scale * (source.positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [3.0, -2.0, 0.7])
    np.testing.assert_allclose(
        retarget(replace(source, positions=moved))[0].positions, retarget(source)[0].positions, atol=2e-3
    )


def test_feet_are_flat_keep_their_length_and_stand_still():
    motion, _, _ = retarget(person())
    length = float(np.linalg.norm(G1.nominal_feet[0] - G1.nominal_feet[1]))
    assert motion.contact is not None
    for side in ("left", "right"):
        toe, heel = motion[f"{side}_toe"], motion[f"{side}_heel"]
        np.testing.assert_allclose(np.linalg.norm(toe - heel, axis=1), length, atol=1e-9)
        on = motion.contact[:, motion.contact_names.index(f"{side}_toe")] > 0
        assert 0.5 < on.mean() < 0.8
        np.testing.assert_allclose(toe[on, 2], heel[on, 2], atol=1e-9)
        assert np.all(toe[~on, 2] <= heel[~on, 2] + 1e-9)  # toes hang down in a swing
        for start, end in runs(on):
            assert np.ptp(toe[start:end], axis=0).max() < 1e-9
            assert np.ptp(heel[start:end], axis=0).max() < 1e-9
        assert toe[:, 2].max() > 0.05


def test_every_standing_point_is_within_reach():
    motion, report, said = retarget(person(height=2.0, speed=1.8, period=1.0))
    assert report["stride_scale"] < 1
    assert any("strides shortened" in line for line in said)
    for c, name in enumerate(G1.key_points):
        distance = np.linalg.norm(motion[name] - motion[f"{name}_hip"], axis=1)
        assert np.all(distance <= G1.leg_reach[c, 1])


def test_bending_down_by_sixty_degrees_is_kept():
    frames = np.arange(120)
    bow = np.radians(60) * (0.5 - 0.5 * np.cos(2 * np.pi * frames / 120)) ** 2
    motion, _, _ = retarget(person(speed=0.0, seconds=4.0, bend=bow))
    pitch = np.degrees(np.arcsin(-body(motion).as_matrix()[:, 2, 0]))
    assert pitch.max() == pytest.approx(60, abs=6)
    assert motion.contact is not None
    assert motion.contact[:, :4].min() == 1


def test_a_jump_leaves_the_ground_with_both_feet():
    motion, report, said = retarget(person(speed=0.0, jump=0.2, period=1.5))
    assert motion.contact is not None
    air = motion.contact.max(axis=1) == 0
    assert len(runs(air)) == 2
    assert report["airborne_fraction"] == pytest.approx(0.404 / 1.5, abs=0.1)
    rise = np.ptp(motion["base"][:, 2])
    assert rise == pytest.approx(0.2 * report["scale"], rel=0.25)
    assert np.ptp(motion["left_toe"][:, 2]) == pytest.approx(rise, abs=0.03)
    assert any("no foot is on the ground" in line for line in said)


def test_hands_go_where_the_persons_go():
    motion, _, _ = retarget(person(speed=0.0, spread=0.6, period=2.0))
    for side, sign in (("left", 1), ("right", -1)):
        arm = motion[f"{side}_hand"] - motion[f"{side}_hand_hip"]
        up = arm[:, 2] > 0.9 * np.linalg.norm(arm, axis=1).max() * np.sin(0.8 * np.pi - np.pi / 2)
        down = arm[:, 2] < -0.3
        assert up.any()
        assert down.any()
        assert np.all(sign * arm[up, 1] > 0.05)
        assert np.abs(arm[..., 0]).max() < 0.03


def test_five_points_give_what_the_whole_skeleton_gives():
    source = person(speed=0.5)
    whole, expected, _ = retarget(source)
    got, report, said = retarget(only(source, FIVE))
    assert report["scale"] == pytest.approx(expected["scale"], rel=0.05)
    for name in ("base", "left_toe", "right_heel", "left_hand"):
        assert np.linalg.norm(got[name] - whole[name], axis=1).mean() < 0.06
    assert any("upper body" in line for line in said)


@pytest.mark.parametrize("case", ["stride cut short", "turning", "jumping jacks"])
def test_five_points_show_the_heading(case):
    source = person(speed=1.0, period=1.2, seconds=2.5 if case == "stride cut short" else 5.0)
    if case == "jumping jacks":
        source = person(speed=0.0, spread=0.8)
    positions = source.positions.copy()
    rate = 0.5 if case == "turning" else 0.0
    if rate:
        angle, y = rate * positions[..., 0], positions[..., 1]  # at 1 m/s
        positions[..., 0], positions[..., 1] = (1 / rate - y) * np.sin(angle), 1 / rate - (1 / rate - y) * np.cos(angle)
    rng = np.random.default_rng(0)
    positions += 0.01 * rng.standard_normal(positions.shape)
    trunk = human.trunk_of(only(replace(source, positions=positions), FIVE), dt=1 / 30)
    error = trunk.heading - rate * source["pelvis"][:, 0]
    assert np.degrees(np.abs(error).max()) < 8


def test_toes_turned_out_turn_the_robots_feet():
    source = person(speed=0.0)
    positions = source.positions.copy()
    for side, angle in (("left", 0.4), ("right", -0.4)):
        toe, ankle = source.index(f"{side}_toe"), source.index(f"{side}_ankle")
        d = positions[:, toe] - positions[:, ankle]
        d[:, 1] = d[:, 0] * np.sin(angle)
        d[:, 0] *= np.cos(angle)
        positions[:, toe] = positions[:, ankle] + d
    motion, _, _ = retarget(replace(source, positions=positions))
    for side, angle in (("left", 0.4), ("right", -0.4)):
        d = (motion[f"{side}_toe"] - motion[f"{side}_heel"])[50]
        assert np.arctan2(d[1], d[0]) == pytest.approx(angle, abs=0.02)


def test_a_body_that_never_moves_is_carried_by_the_lower_foot():
    source = person(speed=0.0, spread=0.8, period=2.0)
    fixed = source.positions - (source["pelvis"] - source["pelvis"][0])[:, None]
    motion, _, said = retarget(only(replace(source, positions=fixed), FIVE))
    assert any("never moves" in line for line in said)
    assert motion["base"][:, 2].min() < motion["base"][0, 2] - 0.02
    assert np.minimum(motion["left_toe"], motion["right_toe"])[:, 2].max() < 0.07


def test_missing_hand_hangs_and_missing_foot_stays_under_its_hip():
    motion, report, said = retarget(without(person(), "left_wrist", "right_ankle", "right_toe"))
    assert report["unseen_limbs"] == ["right"]
    assert report["unseen_hands"] == ["left"]
    assert {"never seen, so kept under the hip: right", "never seen, so hanging: left hand"} <= set(said)
    assert np.all(motion.confidence[:, motion.index("right_toe")] == 0.1)
    assert np.all(motion.confidence[:, motion.index("left_hand")] == 0.1)
    assert np.all(motion.confidence[:, motion.index("left_toe")] == 1)
    middle = (motion["right_toe"] + motion["right_heel"]) / 2 - motion["right_toe_hip"]
    assert np.abs(middle[:, :2]).max() < 0.05
    assert np.linalg.norm(motion["left_hand"] - motion["left_hand_hip"], axis=1).max() < G1.leg_reach[4, 1]


def test_an_unseen_foot_leaves_the_ground_in_a_jump():
    motion, _, _ = retarget(without(person(speed=0.0, jump=0.2, period=1.5), "right_ankle", "right_toe"))
    np.testing.assert_allclose(motion["right_heel"][:, 2], motion["left_heel"][:, 2], atol=0.02)
    assert motion["right_heel"][:, 2].max() > 0.1


def test_a_step_under_one_foot():
    config = Config(step_height=0.06, step_limbs=("left_toe", "left_heel"))
    motion, report, _ = retarget(person(speed=0.0), config)
    assert report["terrain_boxes"] == 1
    np.testing.assert_allclose(motion["left_toe"][:, 2], 0.06, atol=1e-9)
    np.testing.assert_allclose(motion["right_toe"][:, 2], 0.0, atol=1e-9)
    with pytest.raises(UsageError, match="valid: left_toe, "):
        retarget(person(), Config(step_height=0.06))


def test_people_and_animals_need_their_own_robots():
    with pytest.raises(InvalidData, match="an animal's motion needs a quadruped"):
        retarget(walk())
    go1 = load_robot("go1")
    source = Artifact(npz={"keypoints.npz": person().to_arrays()})
    with pytest.raises(InvalidData, match="a person's motion needs a humanoid robot"):
        run(Inputs(artifacts={"import": source}, robot=go1), Config(), Silent())
    source = person()
    exchanged = tuple(n.replace("left", "x").replace("right", "left").replace("x", "right") for n in source.names)
    with pytest.raises(InvalidData, match="toes point backwards"):
        retarget(replace(source, names=exchanged))
    with pytest.raises(InvalidData, match="no key point marks the hips"):
        retarget(only(person(), FIVE[1:]))
    with pytest.raises(InvalidData, match="no foot has any confidence"):
        retarget(without(person(), "left_ankle", "right_ankle"))
