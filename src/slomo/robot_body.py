"""What the point-foot model's body and points weigh, so that together they move as the robot does.

At the nominal pose, body and points have the robot's mass, centre of mass and composite inertia.
"""

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.errors import InvalidData
from slomo.robot_model import Limb

Array = np.ndarray


def rigid_groups(model: pin.Model, limbs: tuple[Limb, ...]) -> list[list[int]]:
    """Limbs by the link that carries their point: one each, or toe and heel."""
    by_joint: dict[int, list[int]] = {}
    for c, limb in enumerate(limbs):
        by_joint.setdefault(model.frames[model.getFrameId(limb.foot)].parentJoint, []).append(c)
    return list(by_joint.values())


def swing_masses(model: pin.Model, q: Array, limbs: tuple[Limb, ...]) -> Array:
    """(C,) kg, the point masses that resist a swing of the limbs about their hips as the locked limbs do.

    With I the inertia of a limb's links about the hip and e the direction from hip to point at distance l, the two
    swings across e have (tr I - e.I e) / 2 on average, hence m = (tr I - e.I e) / (2 l^2): a third of a uniform rod's
    mass. This is within 10 % of the mean operational-space mass (Khatib 1987) of a three-joint leg, but does not vanish
    for a hand on a light wrist. Points on one foot share it.
    """
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    out = np.empty(len(limbs))
    for group in rigid_groups(model, limbs):
        hip = model.frames[model.getFrameId(limbs[group[0]].hip)]
        foot = model.frames[model.getFrameId(limbs[group[0]].foot)]
        # A hip frame on the root would count the whole robot: there the limb starts with its first joint.
        first = hip.parentJoint if hip.parentJoint > 1 else model.supports[foot.parentJoint][2]
        origin = data.oMf[model.getFrameId(limbs[group[0]].hip)].translation
        arm = np.mean([data.oMf[model.getFrameId(limbs[c].foot)].translation for c in group], axis=0) - origin
        inertia = np.zeros((3, 3))
        for j in model.subtrees[first]:
            Y = data.oMi[j].act(model.inertias[j])
            inertia += Y.inertia + Y.mass * _unit_point_inertia(Y.lever - origin)
        length2 = arm @ arm
        out[group] = (np.trace(inertia) - arm @ inertia @ arm / length2) / (2 * length2) / len(group)
    return out


def point_foot_body(model: pin.Model, q: Array, limbs: tuple[Limb, ...], foot_mass: Array, swing: Array) -> pin.Inertia:
    """What is left of the robot at q when its points' masses are taken out, in the frame of the root joint.

    Mass and centre of mass lack all of `foot_mass` (C,) kg. The inertia lacks no more of it than the limbs' links weigh
    (`swing`): what a foot's mass is given beyond, for rotors, resists the leg's motion but does not swing with the
    body. And of that only the share that leaves a real body, one that holds at least the links fixed to the root.

    Raises:
        InvalidData: the points are heavier than the robot.
    """
    data = model.createData()
    pin.ccrba(model, data, q, np.zeros(model.nv))
    pin.updateFramePlacements(model, data)
    total = sum(Y.mass for Y in model.inertias)
    if foot_mass.sum() >= total:
        raise InvalidData(f"feet of {foot_mass.sum():.3g} kg on a robot of {total:.3g} kg", where="foot_mass")
    com, feet = data.com[0], np.array([data.oMf[model.getFrameId(limb.foot)].translation for limb in limbs])
    trunk = _second_moment(data.oMi[1].act(model.inertias[1]).inertia)
    whole = _second_moment(data.Ig.inertia)

    def rest(masses: Array) -> tuple[float, Array, Array]:
        """Mass, centre of mass and second moment about it without point masses at the feet."""
        mass = total - masses.sum()
        lever = com + masses @ (com - feet) / mass
        arms = feet - com
        return mass, lever, whole - mass * np.outer(lever - com, lever - com) - (masses[:, None] * arms).T @ arms

    def leaves_trunk(share: float) -> bool:
        return np.linalg.eigvalsh(rest(share * carried)[2] - trunk)[0] >= 0

    carried = np.minimum(foot_mass, swing)
    share, too_much = (1.0, 1.0) if leaves_trunk(1.0) else (0.0, 1.0)
    while too_much - share > 1e-6:
        middle = (share + too_much) / 2
        share, too_much = (middle, too_much) if leaves_trunk(middle) else (share, middle)
    second = rest(share * carried)[2]
    mass, lever, _ = rest(foot_mass)
    return data.oMi[1].inverse().act(pin.Inertia(mass, lever, np.trace(second) * np.eye(3) - second))


def _second_moment(inertia: Array) -> Array:
    """(3, 3) kg m^2, integral of x x^T dm of a body with this inertia."""
    return np.trace(inertia) / 2 * np.eye(3) - inertia


def _unit_point_inertia(x: Array) -> Array:
    """(3, 3) m^2, inertia about the origin of 1 kg at x."""
    return x @ x * np.eye(3) - np.outer(x, x)
