"""Our Atlas against another description of it, where that is at hand."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from slomo.robot import load_robot

OTHER = Path(__file__).parents[2] / "shared" / "robots" / "atlas_v4.urdf"
needs_other = pytest.mark.skipif(not OTHER.is_file(), reason="needs ../shared/robots/atlas_v4.urdf")
OURS = load_robot("atlas")


@pytest.fixture(scope="module")
def other():
    return pin.buildModelFromUrdf(str(OTHER), pin.JointModelFreeFlyer())


def masses(urdf):
    return {link.get("name"): float(link.find("inertial/mass").get("value")) for link in ET.parse(urdf).iter("link")}


@needs_other
def test_links_weigh_the_same():
    theirs = masses(OTHER)
    ours = masses(OURS.urdf)
    assert ours.keys() == theirs.keys()
    for name, mass in ours.items():
        assert mass == pytest.approx(theirs[name], rel=1e-2), name


@needs_other
def test_joints_turn_as_far_and_as_strongly(other):
    assert set(OURS.joint_names) == set(other.names[2:])
    for i, name in enumerate(OURS.joint_names):
        j = other.joints[other.getJointId(name)]
        if not name.endswith("wry2"):  # locked there
            assert OURS.lower[i] == pytest.approx(other.lowerPositionLimit[j.idx_q], abs=1e-4), name
            assert OURS.upper[i] == pytest.approx(other.upperPositionLimit[j.idx_q], abs=1e-4), name
        # The other file weakens the ankles eightfold, for learning.
        weakened = 8.0 if "_ak" in name else 1.0
        assert OURS.effort[i] == pytest.approx(weakened * other.effortLimit[j.idx_v], rel=0.01), name


@needs_other
def test_it_moves_and_balances_the_same(other):
    """Legs and trunk to 1 mm, hands to 2 cm: the other's wrists are not mirror images of each other."""
    data, theirs = OURS.model.createData(), other.createData()
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, p = pin.neutral(OURS.model), pin.neutral(other)
        for i, name in enumerate(OURS.joint_names):
            if not name.endswith("wry2"):
                q[7 + i] = p[other.joints[other.getJointId(name)].idx_q] = rng.uniform(OURS.lower[i], OURS.upper[i])
        pin.framesForwardKinematics(OURS.model, data, q)
        pin.framesForwardKinematics(other, theirs, p)
        for link in masses(OURS.urdf):
            ours = data.oMf[OURS.model.getFrameId(link)].translation
            tolerance = 0.02 if link[2:] in ("lfarm", "hand") else 1e-3
            np.testing.assert_allclose(ours, theirs.oMf[other.getFrameId(link)].translation, atol=tolerance)
        com, com_theirs = pin.centerOfMass(OURS.model, data, q), pin.centerOfMass(other, theirs, p)
        np.testing.assert_allclose(com, com_theirs, atol=0.005)
        pin.ccrba(OURS.model, data, q, np.zeros(OURS.model.nv))
        pin.ccrba(other, theirs, p, np.zeros(other.nv))
        np.testing.assert_allclose(data.Ig.inertia, theirs.Ig.inertia, atol=0.02 * np.trace(theirs.Ig.inertia))


def test_left_and_right_are_mirror_images():
    mirror = np.diag([1.0, -1.0, 1.0])
    feet, hips = OURS.nominal_feet, OURS.nominal_hips
    middle = np.array([0, 2 * OURS.composite.lever[1], 0])
    for left, right in ((0, 2), (1, 3), (4, 5)):
        for points in (feet, hips):
            np.testing.assert_allclose(points[left] @ mirror + middle, points[right], atol=3e-3)
    tree = {link.get("name"): link for link in ET.parse(OURS.urdf).iter("link")}
    for name, link in tree.items():
        if name.startswith("l_"):
            twin = tree["r_" + name[2:]].find("inertial/inertia").attrib
            for key, value in link.find("inertial/inertia").attrib.items():
                sign = -1 if key in ("ixy", "iyz") else 1
                assert float(value) == sign * float(twin[key]), (name, key)


@pytest.mark.parametrize("limb", [limb for limb in OURS.limbs if not limb.is_hand], ids=lambda limb: limb.name)
def test_toe_and_heel_are_on_the_sole(limb):
    shape = ET.parse(OURS.urdf).find(f".//link[@name='{limb.link}']/collision")
    xyz = np.array(shape.find("origin").get("xyz").split(), float)
    half = np.array(shape.find("geometry/box").get("size").split(), float) / 2
    away = np.array(limb.offset) - xyz
    assert np.all(np.abs(away) <= half + 1e-9)
    assert away[2] == pytest.approx(-half[2], abs=1e-9)
