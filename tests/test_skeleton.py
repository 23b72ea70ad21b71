"""Skeletons: what their files must give, and what is said of a file that is wrong."""

import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.skeleton import Skeleton, list_skeletons, load_skeleton, parse_skeleton

QUADRUPED = {"pelvis", "tail_base", "tail_tip", "spine_mid", "withers", "chest", "neck", "head", "nose"} | {
    f"{end}_{side}_{joint}"
    for side in ("left", "right")
    for end, joints in (("front", ("shoulder", "elbow", "wrist", "paw")), ("hind", ("hip", "knee", "hock", "paw")))
    for joint in joints
}
HUMAN = {"pelvis", "spine_mid", "chest", "neck", "head", "head_top", "nose"} | {
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe")
}


@pytest.fixture(params=list_skeletons())
def skeleton(request: pytest.FixtureRequest) -> Skeleton:
    return load_skeleton(request.param)


def test_every_promised_key_point_comes_out():
    assert set(load_skeleton("quadruped").names) >= QUADRUPED
    assert set(load_skeleton("human").names) >= HUMAN


def test_the_rest_pose_has_the_length_in_which_it_is_measured():
    s = load_skeleton("quadruped")
    rest = s.rest()
    assert np.linalg.norm(rest[s.index("withers")] - rest[s.index("tail_base")]) == pytest.approx(1.0, abs=0.01)
    s = load_skeleton("human")
    assert s.rest()[s.index("head_top"), 2] + s.root_height == pytest.approx(1.0, abs=0.02)


def test_left_and_right_are_mirror_images(skeleton: Skeleton):
    rest, flip = skeleton.rest(), np.array([1, -1, 1])
    np.testing.assert_allclose(rest[skeleton.mirror], rest * flip, atol=1e-12)
    B = skeleton.link_count
    mirrored = skeleton.mirror[:B]
    lower, upper = skeleton.lower[1:], skeleton.upper[1:]
    np.testing.assert_allclose(skeleton.lower[mirrored][1:, 1], lower[:, 1])
    np.testing.assert_allclose(skeleton.lower[mirrored][1:, ::2], -upper[:, ::2])
    radii = skeleton.capsule_radii
    np.testing.assert_allclose(radii[skeleton.capsule_mirror], radii)


def test_parents_come_first_and_feet_are_lowest(skeleton: Skeleton):
    assert np.all(skeleton.link[1:] < np.arange(1, len(skeleton.names)))
    z = skeleton.rest()[:, 2] + skeleton.root_height
    assert np.argmin(z) in skeleton.contacts
    assert z[list(skeleton.contacts)] == pytest.approx(skeleton.sole, abs=0.02)


def test_a_walk_is_lateral_sequence():
    s = load_skeleton("quadruped")
    walk = next(g for g in s.gaits if g.name == "walk")
    order = [name for _, name in sorted(zip(walk.land, (limb.name for limb in s.limbs), strict=True))]
    assert order == ["hind_left", "front_left", "hind_right", "front_right"]


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UsageError, match=r"unknown skeleton 'octopus' \(valid: human, quadruped\)"):
        load_skeleton("octopus")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UsageError, match="cannot read the skeleton"):
        load_skeleton(tmp_path / "no.toml")


SMALL = """
name = "biped"
kind = "human"
typical_length = 1.0
length_between = []
sole = 0.0
root = "pelvis"
[groups]
leg = 0.1
[joints.left_hip]
parent = "pelvis"
offset = [0, 0.1, 0]
group = "leg"
lower = [-10, -10, -10]
upper = [10, 10, 20]
sigma = [5, 5, 5]
[points.left_toe]
parent = "left_hip"
offset = [0, 0, -1]
group = "leg"
[capsules]
left_leg = { link = "left_hip", from = "left_hip", to = "left_toe", radii = [0.1, 0.1] }
[limbs.left]
contact = "left_toe"
swing = "left_hip"
lift = []
[gaits]
"""


def test_a_small_file_of_ones_own():
    s = parse_skeleton(SMALL, where="biped.toml")
    assert s.names == ("pelvis", "left_hip", "right_hip", "left_toe", "right_toe")
    assert np.degrees(s.lower[2]) == pytest.approx([-10, -10, -20])
    assert [limb.name for limb in s.limbs] == ["left", "right"]
    assert s.lengths == (1.0, 1.0)  # where the file does not say, all are as long as the middling one


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('parent = "pelvis"', 'parent = "tail"', "parent of joint 'left_hip' must come before it"),
        ('group = "leg"', 'group = "arm"', "names 'arm', which there is not \\(valid: leg\\)"),
        ("sole = 0.0", "", "lacks the entry 'sole'"),
        ("lower = [-10, -10, -10]", "lower = [5, -10, -10]", "limits must enclose the rest pose"),
        ('contact = "left_toe"', 'contact = "left_hand"', "names 'left_hand'"),
        ("radii = [0.1, 0.1]", "radii = [0.1", "is not TOML"),
        ("offset = [0, 0.1, 0]", 'offset = "far"', "has a wrong value"),
        ("sole = 0.0", "sole = 0.0\nlengths = [2.0, 1.0]", "expected the smallest and the largest"),
        ("sole = 0.0", "sole = 0.0\nlengths = [2.0]", "has a wrong value"),
    ],
)
def test_a_wrong_file_says_where(old: str, new: str, message: str):
    assert old in SMALL
    with pytest.raises(InvalidData, match=message) as caught:
        parse_skeleton(SMALL.replace(old, new), where="biped.toml")
    assert str(caught.value).startswith("biped.toml: ")
