"""From a robot.toml and its URDF to Pinocchio's model: frames, locked joints, limits, nominal pose, a regular root."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.errors import InvalidData
from slomo.robot_file import LimbSection, RobotFile

Array = np.ndarray


@dataclass(frozen=True)
class Limb:
    """One leg or arm, or one end of a foot.

    Attributes:
        hip: frame whose origin at the nominal pose is the limb's attachment to the body.
        foot: frame at the contact point: the centre of a sphere of radius `foot_radius` (m), which may be 0.
        link, offset: the URDF's link that carries the point, and where in it (m, link frame). Without an offset `foot`
            is the link's own frame, else a frame of the limb's name that the loader has added.
    """

    name: str
    hip: str
    foot: str
    foot_radius: float
    link: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_hand(self) -> bool:
        """Whether the point belongs to a hand, which does not stand on the ground."""
        return self.name.endswith("_hand")


def build_model(file: RobotFile, urdf: Path, path: Path) -> pin.Model:
    """The URDF on a free-flyer, without the locked joints, its frames checked against the file.

    Raises:
        InvalidData: the URDF cannot be read, lacks a frame, or has joints that are not simple revolute or sliding ones.
    """
    try:
        model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
    except ValueError as e:
        raise InvalidData(f"Pinocchio cannot read it: {e}", where=urdf) from None
    locked = match_joints(dict.fromkeys(file.locked), list(model.names[2:]), "locked", path)
    if locked:
        model = pin.buildReducedModel(model, [2 + i for i in locked], pin.neutral(model))
    bodies = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    for key, frame in [
        ("frames.base", file.frames.base),
        *((f"limbs.{limb.name}.{k}", getattr(limb, k)) for limb in file.limbs for k in ("hip", "foot")),
    ]:
        if frame not in bodies:
            raise InvalidData(f"{key}: no frame {frame!r} in {urdf.name}", where=path, valid=bodies)
        if sum(f.name == frame for f in model.frames) > 1:
            raise InvalidData(f"{key}: {frame!r} names more than one frame of {urdf.name}", where=path, valid=bodies)
    if model.frames[model.getFrameId(file.frames.base)].parentJoint != 1:
        raise InvalidData(f"frames.base: {file.frames.base!r} does not move rigidly with the root", where=path)
    if model.nq != model.njoints - 2 + 7:
        raise InvalidData("has joints of more than one degree of freedom or without limits", where=urdf)
    return model


def make_limb(section: LimbSection, model: pin.Model, urdf: Path, path: Path) -> Limb:
    """The limb; a point with an offset becomes an operational frame of `model`, in place."""
    radius = section.foot_radius
    if radius is None:
        radius = _foot_radius(section, urdf, path)
    if not any(section.offset):
        return Limb(section.name, section.hip, section.foot, radius, section.foot)
    add_frame(model, section.name, section.foot, pin.SE3(np.eye(3), np.array(section.offset)), path)
    return Limb(section.name, section.hip, section.name, radius, section.foot, section.offset)


def add_frame(model: pin.Model, name: str, link: str, placement: pin.SE3, path: Path) -> None:
    """An operational frame at a placement in a link's frame, in place."""
    if model.existFrame(name):
        raise InvalidData(f"the URDF has a frame {name!r} already, which slomo adds", where=path)
    parent = model.getFrameId(link)
    frame = model.frames[parent]
    model.addFrame(pin.Frame(name, frame.parentJoint, parent, frame.placement * placement, pin.FrameType.OP_FRAME))


def match_joints(patterns: Mapping[str, Any], names: list[str], where: str, path: Path) -> dict[int, Any]:
    """Index into `names` -> value of the one pattern that matches."""
    out: dict[int, Any] = {}
    for pattern, value in patterns.items():
        hits = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not hits or any(i in out for i in hits):
            problem = "matches no joint" if not hits else "matches a joint that another entry names"
            raise InvalidData(f"{where}: {pattern!r} {problem}", where=path, valid=names)
        out |= dict.fromkeys(hits, value)
    return out


def position_limits(file: RobotFile, model: pin.Model, path: Path) -> tuple[Array, Array]:
    """(nj,) rad, lower and upper: the file's within the URDF's."""
    names = list(model.names[2:])
    lower, upper = np.array(model.lowerPositionLimit[7:]), np.array(model.upperPositionLimit[7:])
    for i, (lo, hi) in match_joints(file.limits, names, "limits", path).items():
        lower[i], upper[i] = max(lower[i], lo), min(upper[i], hi)
    for i in np.flatnonzero(~((lower < upper) & np.isfinite(lower) & np.isfinite(upper))):
        raise InvalidData(f"limits: joint {names[int(i)]} has the range {lower[i]:g}..{upper[i]:g}", where=path)
    return lower, upper


def joint_limit(what: str, patterns: Mapping[str, float], urdf_limit: Array, model: pin.Model, path: Path) -> Array:
    """(nj,) effort (N m) or velocity (rad/s): the file's where it is below the URDF's, or the URDF has none."""
    names, limit = list(model.names[2:]), np.array(urdf_limit)
    limit[~(limit > 0)] = np.inf
    for i, value in match_joints(patterns, names, what, path).items():
        limit[i] = min(limit[i], value)
    for i in np.flatnonzero(~((limit > 0) & np.isfinite(limit))):
        raise InvalidData(f"joint {names[int(i)]} has no {what} limit", where=path, todo=f"name it under [{what}]")
    return limit


def joint_values(what: str, patterns: Mapping[str, float], default: Array, model: pin.Model, path: Path) -> Array:
    """(nj,) the file's value where it has one, else the default (nj,). Raises `InvalidData` for a negative one."""
    names, out = list(model.names[2:]), np.array(default, float)
    for i, value in match_joints(patterns, names, what, path).items():
        if not 0 <= value < np.inf:
            raise InvalidData(f"{what}: joint {names[i]} has {value:g}, which is below 0", where=path)
        out[i] = value
    return out


def nominal_pose(
    file: RobotFile, model: pin.Model, limbs: Iterable[Limb], path: Path, *, lower: Array, upper: Array
) -> Array:
    """(nq,) the nominal joints, which must lie within `lower` and `upper` (nj,) rad, the base link level and as high as
    puts the lowest foot on the ground."""
    q, names = pin.neutral(model), list(model.names[2:])
    angles = match_joints(file.nominal, names, "nominal", path)
    missing = [name for i, name in enumerate(names) if i not in angles]
    if missing:
        raise InvalidData(f"nominal: no angle for joint {missing[0]}", where=path)
    for i, angle in angles.items():
        if not lower[i] <= angle <= upper[i]:
            raise InvalidData(f"nominal: {names[i]} is outside its limits", where=path)
        q[7 + i] = angle
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    T_root_base = data.oMf[model.getFrameId(file.frames.base)]
    q[:7] = pin.SE3ToXYZQUAT(T_root_base.inverse())
    pin.framesForwardKinematics(model, data, q)
    q[2] -= min(data.oMf[model.getFrameId(limb.foot)].translation[2] - limb.foot_radius for limb in limbs)
    return q


def repair_base_inertia(model: pin.Model) -> str | None:
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


def _foot_radius(limb: LimbSection, urdf: Path, path: Path) -> float:
    """Radius (m) of the URDF's collision sphere about the point; 0 without one for a point with an offset."""
    centres = []
    for collision in ET.parse(urdf).iterfind(f".//link[@name='{limb.foot}']/collision"):
        sphere, origin = collision.find("geometry/sphere"), collision.find("origin")
        if sphere is not None:
            centre = np.array((origin.get("xyz", "0 0 0") if origin is not None else "0 0 0").split(), float)
            if np.allclose(centre, limb.offset, atol=1e-3):
                return float(sphere.attrib["radius"])
            centres.append(f"[{', '.join(f'{x:g}' for x in centre)}]")
    if any(limb.offset):
        return 0.0
    todo = f"give its limb the offset {centres[0]}" if centres else "give its limb a foot_radius"
    raise InvalidData(f"link {limb.foot!r} of {urdf.name} has no collision sphere at its origin", where=path, todo=todo)
