"""Robots: what the files name and what the kinematics give."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.robot import list_robots, load_robot

ROBOTS = Path(__file__).parents[1] / "robots"


def edited(tmp_path, old, new, robot="go1"):
    text = (ROBOTS / robot / "robot.toml").read_text()
    assert old in text
    path = tmp_path / "robot.toml"
    path.write_text(text.replace(old, new))
    return str(path)


# From the makers' URDFs: total mass (kg), thigh + calf lengths (m).
@pytest.mark.parametrize(
    ("name", "mass", "segments"), [("go1", 13.10, 0.426), ("a1", 13.74, 0.4), ("go2", 16.085, 0.426)]
)
def test_robots(name, mass, segments):
    robot = load_robot(name)
    assert name in list_robots()
    assert robot.mass == pytest.approx(mass, abs=0.005)
    assert robot.composite.mass == pytest.approx(mass, abs=0.005)
    assert robot.limb_names == ("front_left", "front_right", "hind_left", "hind_right")
    np.testing.assert_array_equal(np.sign(robot.nominal_hips[:, :2]), [[1, 1], [1, -1], [-1, 1], [-1, -1]])
    # The knee never stretches fully: law of cosines at its limit.
    knee = robot.upper[robot.joint_names.index("FL_calf_joint")]
    np.testing.assert_allclose(robot.leg_reach[:, 1], segments * np.cos(knee / 2), rtol=1e-6)
    assert np.all(robot.leg_reach[:, 0] < np.linalg.norm(robot.nominal_feet - robot.nominal_hips, axis=1))
    assert 0.2 < robot.standing_height < 0.35
    assert np.all(np.linalg.eigvalsh(robot.composite.inertia) > 0.05)


def test_nominal_pose_stands_on_the_ground():
    robot = load_robot("go1")
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.q_nominal)
    feet = np.array([data.oMf[robot.model.getFrameId(n)].translation for n in robot.foot_names])
    np.testing.assert_allclose(feet[:, 2], robot.foot_radius, atol=1e-9)


def test_vendor_limits_are_intersected_with_the_urdf():
    robot = load_robot("go1")
    i = [robot.joint_names.index(f"FL_{j}_joint") for j in ("hip", "thigh", "calf")]
    np.testing.assert_allclose(robot.lower[i], [-0.863, -0.663, -2.721])
    np.testing.assert_allclose(robot.upper[i], [0.863, 2.966, -0.888])


def test_path_and_digest(tmp_path):
    robot = load_robot(edited(tmp_path, 'name = "go1"', 'name = "mine"'))
    assert robot.name == "mine"
    assert robot.digest != load_robot("go1").digest
    assert load_robot("go1").digest == load_robot("go1").digest


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('foot = "FL_foot"', 'foot = "FL_paw"', ["limbs.front_left.foot", "'FL_paw'", "FL_foot"]),
        ('base = "trunk"', 'base = "torso"', ["frames.base", "'torso'", "trunk"]),
        ('base = "trunk"', 'base = "FL_calf"', ["frames.base", "rigidly"]),
        ('"*_hip_joint" = 0.0', "", ["nominal", "no angle", "FL_hip_joint"]),
        ('"*_hip_joint" = 0.0', '"*_shoulder_joint" = 0.0', ["'*_shoulder_joint'", "matches no joint", "FL_hip_joint"]),
        ('"*_thigh_joint" = 0.8', '"*_thigh_joint" = 3.0', ["nominal", "FL_thigh_joint", "outside"]),
        ('kind = "quadruped"', 'kind = "bird"', ["kind", "'quadruped' or 'humanoid'"]),
        ('name = "front_right"', 'name = "front_left"', ["repeat"]),
        ("[point_foot]", "[pointfoot]", ["pointfoot"]),
        ('package = "example-robot-data"', 'package = "no-such-package"', ["no-such-package", "not installed"]),
        ("urdf/go1.urdf", "urdf/go9.urdf", ["go9.urdf", "example-robot-data"]),
        ("[nominal]", "[nominal", ["not TOML"]),
        ("-1.047, 1.047", "2, 3", ["FL_hip_joint", "range"]),
    ],
)
def test_wrong_file(tmp_path, old, new, says):
    with pytest.raises(InvalidData) as e:
        load_robot(edited(tmp_path, old, new))
    for word in says:
        assert word in str(e.value)
    assert "\n" not in str(e.value)


def test_mesh_feet_need_a_radius(tmp_path):
    with pytest.raises(InvalidData, match="foot_radius"):
        load_robot(edited(tmp_path, "foot_radius = 0.022", "", robot="go2"))


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(UsageError) as e:
        load_robot("go3")
    assert all(name in str(e.value) for name in ("'go3'", "go1", "a1", "go2"))
    with pytest.raises(UsageError, match="no such file"):
        load_robot("nowhere/robot.toml")


def test_missing_base_inertia_is_repaired_and_said(tmp_path):
    tree = ET.parse(load_robot("go1").urdf)
    for link in tree.iter("link"):
        inertial = link.find("inertial")
        if inertial is not None and not link.attrib["name"].endswith(("_hip", "_thigh", "_calf", "_foot")):
            link.remove(inertial)
    tree.write(tmp_path / "bare.urdf")
    path = edited(
        tmp_path, 'package = "example-robot-data"\npath = "robots/go1_description/urdf/go1.urdf"', 'path = "bare.urdf"'
    )
    robot = load_robot(path)
    assert "inertia" in robot.notes[0]
    assert np.all(np.linalg.eigvalsh(robot.model.inertias[1].inertia) > 0)
    assert load_robot("go1").notes == ()
