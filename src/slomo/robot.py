"""A robot: its URDF through Pinocchio, and what robots/<name>/robot.toml says of it.

A new robot is a new folder robots/<name>/ with a robot.toml, never a code change. Everything that the kinematics
can tell (hips, feet, reach, masses) is computed, so that the file only names frames.
"""

import hashlib
import itertools
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.errors import InvalidData
from slomo.robot_file import HUMANOID_LIMBS, RobotFile, find_robot_file, find_urdf, read_robot_file, robot_folders

Array = np.ndarray


@dataclass(frozen=True)
class Limb:
    """One leg or arm.

    Attributes:
        hip: frame whose origin at the nominal pose is the limb's attachment to the body.
        foot: frame at the centre of the contact sphere, of radius `foot_radius` (m).
    """

    name: str
    hip: str
    foot: str
    foot_radius: float


@dataclass(frozen=True, eq=False)
class Robot:
    """Everything about the robot that any stage needs.

    Attributes:
        name, kind: "quadruped" or "humanoid".
        urdf, package_dirs: the model's file and where its package:// addresses are looked up.
        model: Pinocchio model with a free-flyer root (nq = 7 + nj, nv = 6 + nj).
        base: name of the base frame.
        limbs: C limbs.
        q_nominal: (nq,) standing pose, feet on the ground z = 0, joints in the model's order.
        lower, upper: (nj,) rad.  effort: (nj,) N m.  velocity: (nj,) rad/s.
        point_foot: what the file adds for the point-foot model.
        digest: SHA-256 of the file and the URDF.
        notes: what was repaired, for the user's eyes.
    """

    name: str
    kind: str
    urdf: Path
    package_dirs: tuple[Path, ...]
    model: pin.Model
    base: str
    limbs: tuple[Limb, ...]
    q_nominal: Array
    lower: Array
    upper: Array
    effort: Array
    velocity: Array
    point_foot: Mapping[str, Any]
    digest: str
    notes: tuple[str, ...] = ()

    @property
    def limb_names(self) -> tuple[str, ...]:
        return tuple(limb.name for limb in self.limbs)

    @property
    def foot_names(self) -> tuple[str, ...]:
        """Foot frames in limb order: the `point_names` of references and roll-outs."""
        return tuple(limb.foot for limb in self.limbs)

    @property
    def key_points(self) -> tuple[str, ...]:
        """Names of the limbs' ends in key-point motions (see `key_point_names`)."""
        return key_point_names(self.limb_names)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.model.names[2:])

    @property
    def foot_radius(self) -> float:
        """m, height of the foot frames over the ground in stance (mean of the limbs')."""
        return float(np.mean([limb.foot_radius for limb in self.limbs]))

    @property
    def mass(self) -> float:
        """kg, of everything."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    @cached_property
    def nominal_hips(self) -> Array:
        """(C, 3) m, the limbs' attachments at the nominal pose, base frame."""
        return self.frames_in_base(self.q_nominal, tuple(limb.hip for limb in self.limbs))

    @cached_property
    def nominal_feet(self) -> Array:
        """(C, 3) m, foot frames at the nominal pose, base frame."""
        return self.frames_in_base(self.q_nominal, self.foot_names)

    @cached_property
    def standing_height(self) -> float:
        """m, base origin over the foot frames' origins at the nominal pose (add `foot_radius` for the ground)."""
        return float(-self.nominal_feet[:, 2].mean())

    @cached_property
    def leg_reach(self) -> Array:
        """(C, 2) m, least and greatest distance of hip and foot frames within the joint limits.

        The hip frame moves with the joints above it, so this is the length of the leg proper.
        """
        data = self.model.createData()
        out = np.empty((len(self.limbs), 2))
        for c, limb in enumerate(self.limbs):
            foot, hip = self.model.getFrameId(limb.foot), self.model.getFrameId(limb.hip)
            above_hip = self.model.supports[self.model.frames[hip].parentJoint]
            above_foot = self.model.supports[self.model.frames[foot].parentJoint]
            joints = [j for j in above_foot if j > 1 and j not in above_hip]
            grids = [np.linspace(self.lower[j - 2], self.upper[j - 2], 33 if len(joints) <= 2 else 9) for j in joints]
            lengths = []
            q = self.q_nominal.copy()
            for angles in itertools.product(*grids):
                for j, angle in zip(joints, angles, strict=True):
                    q[self.model.idx_qs[j]] = angle
                pin.framesForwardKinematics(self.model, data, q)
                lengths.append(np.linalg.norm(data.oMf[foot].translation - data.oMf[hip].translation))
            out[c] = min(lengths), max(lengths)
        return out

    @cached_property
    def composite(self) -> pin.Inertia:
        """The whole robot locked at the nominal pose, base frame: mass (kg), lever to the centre of mass (m) and
        inertia about it (kg m2)."""
        data = self.model.createData()
        pin.ccrba(self.model, data, self.q_nominal, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, data)
        T_world_base = data.oMf[self.model.getFrameId(self.base)]
        R = T_world_base.rotation
        com = T_world_base.actInv(data.com[0])
        return pin.Inertia(self.mass, com, R.T @ data.Ig.inertia @ R)

    def frames_in_base(self, q: Array, names: tuple[str, ...]) -> Array:
        """(len(names), 3) m, origins of frames at configuration q (nq,), base frame."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, q)
        T_world_base = data.oMf[self.model.getFrameId(self.base)]
        return np.array([T_world_base.actInv(data.oMf[self.model.getFrameId(n)].translation) for n in names])


def key_point_names(limbs: tuple[str, ...]) -> tuple[str, ...]:
    """`<limb>_foot` of a quadruped's limbs; a humanoid's (left_toe, ...) are named after the point itself."""
    return limbs if limbs == HUMANOID_LIMBS else tuple(f"{limb}_foot" for limb in limbs)


def list_robots() -> list[str]:
    """Names that `load_robot` knows."""
    return sorted(robot_folders())


def load_robot(name_or_path: str) -> Robot:
    """The robot of that name, or of that robot.toml.

    Raises:
        UsageError: unknown name (lists the known ones) or no such file.
        InvalidData: the file, the URDF or a frame that it names cannot be used.
    """
    path = find_robot_file(name_or_path)
    file = read_robot_file(path)
    urdf, package_dirs = find_urdf(file.urdf, path)
    try:
        model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
    except ValueError as e:
        raise InvalidData(f"Pinocchio cannot read it: {e}", where=urdf) from None
    bodies = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    for key, frame in [
        ("frames.base", file.frames.base),
        *((f"limbs.{limb.name}.{k}", getattr(limb, k)) for limb in file.limbs for k in ("hip", "foot")),
    ]:
        if frame not in bodies:
            raise InvalidData(f"{key}: no frame {frame!r} in {urdf.name}", where=path, valid=bodies)
    if model.frames[model.getFrameId(file.frames.base)].parentJoint != 1:
        raise InvalidData(f"frames.base: {file.frames.base!r} does not move rigidly with the root", where=path)
    if model.nq != model.njoints - 2 + 7:
        raise InvalidData("has joints of more than one degree of freedom or without limits", where=urdf)

    lower, upper = _limits(file, model, path)
    effort, velocity = np.array(model.effortLimit[6:]), np.array(model.velocityLimit[6:])
    for what, limit in (("effort", effort), ("velocity", velocity)):
        if not np.all((limit > 0) & np.isfinite(limit)):
            raise InvalidData(f"joint {model.names[2 + int(np.argmin(limit))]} has no {what} limit", where=urdf)
    note = _repair_base_inertia(model)
    limbs = tuple(Limb(s.name, s.hip, s.foot, s.foot_radius or _foot_radius(urdf, s.foot, path)) for s in file.limbs)
    robot = Robot(
        name=file.name,
        kind=file.kind,
        urdf=urdf,
        package_dirs=package_dirs,
        model=model,
        base=file.frames.base,
        limbs=limbs,
        q_nominal=_nominal(file, model, limbs, path),
        lower=lower,
        upper=upper,
        effort=effort,
        velocity=velocity,
        point_foot=file.point_foot,
        digest=hashlib.sha256(path.read_bytes() + urdf.read_bytes()).hexdigest(),
        notes=(note,) if note else (),
    )
    outside = [
        n
        for n, a, lo, hi in zip(robot.joint_names, robot.q_nominal[7:], lower, upper, strict=True)
        if not lo <= a <= hi
    ]
    if outside:
        raise InvalidData(f"nominal: {outside[0]} is outside its limits", where=path)
    return robot


def _matching(patterns: Mapping[str, Any], model: pin.Model, where: str, path: Path) -> dict[int, Any]:
    """Joint index -> value of the one pattern that matches its name."""
    out: dict[int, Any] = {}
    names = list(model.names[2:])
    for pattern, value in patterns.items():
        hits = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not hits or any(i in out for i in hits):
            problem = "matches no joint" if not hits else "matches a joint that another entry names"
            raise InvalidData(f"{where}: {pattern!r} {problem}", where=path, valid=names)
        out |= dict.fromkeys(hits, value)
    return out


def _limits(file: RobotFile, model: pin.Model, path: Path) -> tuple[Array, Array]:
    lower, upper = np.array(model.lowerPositionLimit[7:]), np.array(model.upperPositionLimit[7:])
    for i, (lo, hi) in _matching(file.limits, model, "limits", path).items():
        lower[i], upper[i] = max(lower[i], lo), min(upper[i], hi)
    for i in np.flatnonzero(~((lower < upper) & np.isfinite(lower) & np.isfinite(upper))):
        raise InvalidData(
            f"limits: joint {model.names[2 + int(i)]} has the range {lower[i]:g}..{upper[i]:g}", where=path
        )
    return lower, upper


def _nominal(file: RobotFile, model: pin.Model, limbs: tuple[Limb, ...], path: Path) -> Array:
    """(nq,) the nominal joints, the base frame level and as high as puts the lowest foot on the ground."""
    q = pin.neutral(model)
    angles = _matching(file.nominal, model, "nominal", path)
    missing = [model.names[2 + i] for i in range(model.njoints - 2) if i not in angles]
    if missing:
        raise InvalidData(f"nominal: no angle for joint {missing[0]}", where=path)
    for i, angle in angles.items():
        q[7 + i] = angle
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    T_root_base = data.oMf[model.getFrameId(file.frames.base)]
    q[:7] = pin.SE3ToXYZQUAT(T_root_base.inverse())
    pin.framesForwardKinematics(model, data, q)
    q[2] -= min(data.oMf[model.getFrameId(limb.foot)].translation[2] - limb.foot_radius for limb in limbs)
    return q


def _repair_base_inertia(model: pin.Model) -> str | None:
    """Make the root body's inertia that of a real body, in place; says what it did.

    A root link without mass makes the free flyer's dynamics singular. It gets at least 1 % of the robot's mass, and
    principal moments of at least a water sphere's of that mass that satisfy the triangle inequality.
    """
    Y = model.inertias[1]
    mass = max(Y.mass, 0.01 * sum(y.mass for y in model.inertias))
    moments = np.linalg.eigvalsh(Y.inertia)
    sphere = 0.4 * mass * (3 * mass / (4 * np.pi * 1000)) ** (2 / 3)
    if Y.mass >= mass and moments[0] > 0 and moments[0] + moments[1] >= moments[2]:
        return None
    add = max(sphere - moments[0], moments[2] - moments[0] - moments[1], 0.0)
    model.inertias[1] = pin.Inertia(mass, Y.lever, Y.inertia + add * np.eye(3))
    return f"the base's inertia was singular or missing: now {mass:.3g} kg with {add:.2g} kg m2 added to its moments"


def _foot_radius(urdf: Path, link: str, path: Path) -> float:
    """Radius (m) of the collision sphere of the URDF's foot link."""
    sphere = ET.parse(urdf).find(f".//link[@name='{link}']/collision/geometry/sphere")
    if sphere is None:
        raise InvalidData(
            f"link {link!r} of {urdf.name} has no collision sphere", where=path, todo="give its limb a foot_radius"
        )
    return float(sphere.attrib["radius"])
