"""Robots: what the files name and what the kinematics give."""

import xml.etree.ElementTree as ET
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.robot import list_robots, load_robot

every_robot = pytest.mark.parametrize("robot", [load_robot(name) for name in list_robots()], ids=lambda r: r.name)
ROBOTS = Path(__file__).parents[1] / "robots"


def edited(tmp_path, old, new, robot="go1"):
    text = (ROBOTS / robot / "robot.toml").read_text()
    assert old in text
    path = tmp_path / "robot.toml"
    path.write_text(text.replace(old, new))
    return str(path)


@pytest.mark.parametrize(("name", "segments"), [("go1", 0.426), ("a1", 0.4), ("go2", 0.426), ("b1", 0.7)])
def test_reach_is_what_the_knee_allows(name, segments):
    """Thigh and calf of equal length (m, together, from the makers' URDFs) and a knee that never stretches fully."""
    robot = load_robot(name)
    knee = robot.upper[robot.joint_names.index("FL_calf_joint")]
    np.testing.assert_allclose(robot.leg_reach[:, 1], segments * np.cos(knee / 2), rtol=1e-6)


@every_robot
def test_robots(robot):
    assert robot.name in list_robots()
    masses = [float(m.attrib["value"]) for m in ET.parse(robot.urdf).iterfind("link/inertial/mass")]
    assert robot.mass == pytest.approx(sum(masses), rel=1e-6)
    assert robot.composite.mass == pytest.approx(robot.mass)
    x = robot.nominal_hips[:, :2]
    if robot.kind == "quadruped":
        assert robot.limb_names == ("front_left", "front_right", "hind_left", "hind_right")
        np.testing.assert_array_equal(np.sign(x), [[1, 1], [1, -1], [-1, 1], [-1, -1]])
        assert robot.key_points == tuple(f"{n}_foot" for n in robot.limb_names)
        assert len(robot.pairs) == 0
    else:
        assert robot.key_points == robot.limb_names
        np.testing.assert_array_equal(robot.pairs, [[0, 1], [2, 3]])
        np.testing.assert_array_equal(np.sign(x[:, 1]), [1, 1, -1, -1, 1, -1])
        toe, heel = robot.nominal_feet[robot.pairs].swapaxes(0, 1)
        # A foot points forward and is flat on the ground under the body.
        np.testing.assert_allclose((toe - heel) / robot.pair_length[:, None], [[1, 0, 0]] * 2, atol=2e-3)
        assert np.all((toe[:, 0] > 0) & (heel[:, 0] < 0))
    assert 0.5 < robot.standing_height / robot.leg_reach[robot.feet, 1].max() < 1.6
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.q_nominal)
    feet = np.array([data.oMf[robot.model.getFrameId(robot.limbs[c].foot)].translation for c in robot.feet])
    np.testing.assert_allclose(feet[:, 2], robot.foot_radius, atol=2e-3)
    base = data.oMf[robot.model.getFrameId(robot.base)]
    np.testing.assert_allclose(base.rotation, np.eye(3), atol=1e-9)
    assert base.translation[2] == pytest.approx(robot.standing_height + robot.foot_radius, abs=1e-9)
    # It stands: its centre of mass is over its feet.
    com = base.act(robot.composite.lever)
    assert np.all((feet[:, :2].min(axis=0) < com[:2]) & (com[:2] < feet[:, :2].max(axis=0)))


@every_robot
def test_mujoco_reads_the_same_robot(robot):
    """Composite inertia and feet against MuJoCo's own reading of the URDF."""
    spec = mujoco.MjSpec.from_file(str(robot.urdf))
    spec.compiler.fusestatic = False
    for part in [*spec.geoms, *spec.meshes, *spec.equalities]:
        spec.delete(part)
    for joint in list(spec.joints):
        if any(fnmatchcase(joint.name, pattern) for pattern in robot.locked):
            spec.delete(joint)
    for limb in robot.limbs:
        spec.body(limb.link).add_site(name=limb.name, pos=limb.offset)
    spec.worldbody.first_body().add_freejoint(name="root")
    # MuJoCo wants real bodies: links of a few grams and flat ones get a marble's inertia, others' are balanced.
    spec.compiler.balanceinertia = True
    for body in spec.bodies[1:]:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        if body.mass < 0.01 or np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] < 1e-9:
            body.explicitinertial = True
            body.mass = max(body.mass, 1e-9)
            body.inertia, body.fullinertia = [1e-7] * 3, [np.nan, 0, 0, 0, 0, 0]
    model = spec.compile()
    data = mujoco.MjData(model)
    q = robot.q_nominal
    data.qpos[:7] = q[[0, 1, 2, 6, 3, 4, 5]]
    for name, angle in zip(robot.joint_names, q[7:], strict=True):
        data.qpos[model.joint(name).qposadr] = angle
    mujoco.mj_forward(model, data)
    frame = pin.XYZQUATToSE3(q[:7])
    base = frame * robot.model.frames[robot.model.getFrameId(robot.base)].placement
    for limb, foot in zip(robot.limbs, robot.nominal_feet, strict=True):
        np.testing.assert_allclose(data.site(limb.name).xpos, base.act(foot), atol=1e-6)
    com = data.subtree_com[0]
    np.testing.assert_allclose(com, base.act(robot.composite.lever), atol=1e-6)
    composite = np.zeros((3, 3))
    for i in range(1, model.nbody):
        R, x = data.ximat[i].reshape(3, 3), data.xipos[i] - com
        composite += R @ np.diag(model.body_inertia[i]) @ R.T
        composite += model.body_mass[i] * (x @ x * np.eye(3) - np.outer(x, x))
    np.testing.assert_allclose(composite, robot.composite.inertia, atol=3e-4 * np.trace(composite))


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
        ("foot_mass = 0.35", "foot_mass = 4.0", ["foot_mass", "16 kg on a robot of 13.1 kg"]),
        ("foot_mass = 0.35", "foot_mass = -1", ["point_foot.foot_mass", "greater than 0"]),
        ("[limits]", '[effort]\n"*_hip" = 3.0\n[limits]', ["effort", "matches no joint"]),
        ('kind = "quadruped"', 'kind = "quadruped"\nlocked = ["gripper"]', ["locked", "matches no joint"]),
        ('foot = "FL_foot"', 'foot = "FL_foot"\noffset = [0.1]', ["offset"]),
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


def test_a_sphere_away_from_the_foots_origin_is_an_offset(tmp_path):
    path = edited(tmp_path, "offset = [0.0, 0.0, 0.0225]\n", "", robot="anymal_c")
    with pytest.raises(InvalidData, match=r"offset \[0, 0, 0.0225\]"):
        load_robot(path)
    assert load_robot("anymal_c").foot_radius == pytest.approx(0.03)


def test_offset_adds_a_frame_that_moves_with_its_link():
    robot = load_robot("g1")
    data = robot.model.createData()
    rng = np.random.default_rng(1)
    q = np.concatenate([robot.q_nominal[:7], rng.uniform(robot.lower, robot.upper)])
    pin.framesForwardKinematics(robot.model, data, q)
    for limb in robot.limbs:
        assert limb.foot == limb.name
        link = data.oMf[robot.model.getFrameId(limb.link)]
        np.testing.assert_allclose(
            data.oMf[robot.model.getFrameId(limb.foot)].translation, link.act(np.array(limb.offset)), atol=1e-12
        )


def test_humanoid_limbs_are_named(tmp_path):
    with pytest.raises(InvalidData) as e:
        load_robot(edited(tmp_path, 'name = "left_heel"', 'name = "left_ball"', robot="g1"))
    assert all(word in str(e.value) for word in ("left_ball", "left_heel", "right_hand"))


def test_locked_joints_weigh_but_do_not_move(tmp_path):
    talos = load_robot("talos")
    assert not [n for n in talos.joint_names if "gripper" in n]
    text = (ROBOTS / "talos" / "robot.toml").read_text()
    path = tmp_path / "robot.toml"
    path.write_text(text.replace('locked = ["gripper_*"]\n', "").replace('"head_*"', '"gripper_*" = 0.0\n"head_*"'))
    free = load_robot(str(path))
    assert len(free.joint_names) == len(talos.joint_names) + 14
    np.testing.assert_allclose(free.composite.inertia, talos.composite.inertia, atol=1e-9)
    assert free.mass == pytest.approx(talos.mass)


def test_given_efforts_tighten_the_urdfs(tmp_path):
    path = edited(tmp_path, "[limits]", '[effort]\n"FL_hip_joint" = 5.0\n"FR_hip_joint" = 1e4\n[limits]')
    robot, go1 = load_robot(path), load_robot("go1")
    i, k = (robot.joint_names.index(f"{leg}_hip_joint") for leg in ("FL", "FR"))
    assert robot.effort[i] == 5.0
    assert robot.effort[k] == go1.effort[k]
    assert robot.force_limits[0, 1] < go1.force_limits[0, 1]


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
