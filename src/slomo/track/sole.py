"""Where a robot meets the ground: a point under each foot, or the four corners of a humanoid's sole.

The point-foot model has a toe and a heel on the sole's middle line, which cannot keep a foot from rolling sideways. The
whole robot stands on a rectangle: toe and heel, each as far to either side as the collision shapes of the foot reach.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import trimesh

from slomo.robot import Robot
from slomo.robot_file import find_mesh

Array = np.ndarray

NEAR = 0.02  # m over the sole, up to which a shape counts as sole
NO_SHAPE = 0.2  # half width over length of a sole that has no collision shape


@dataclass(frozen=True)
class ContactPoint:
    """A place at which the robot may touch the ground.

    Attributes:
        limb: column of the limb whose point (toe, heel or foot) it belongs to.
        frame: index of that limb's foot frame in the robot's model.
        offset: (3,) m, in the foot frame.
    """

    limb: int
    frame: int
    offset: Array


def contact_points(robot: Robot) -> tuple[ContactPoint, ...]:
    """One a foot, two at each toe and heel, none at hands; ordered by limb."""
    half = half_widths(robot)
    points = []
    for c in robot.feet:
        frame = robot.model.getFrameId(robot.limbs[c].foot)
        across = half.get(int(c))
        offsets = [np.zeros(3)] if across is None else [across, -across]
        points += [ContactPoint(int(c), frame, offset) for offset in offsets]
    return tuple(points)


def half_widths(robot: Robot) -> dict[int, Array]:
    """Limb column of each toe and heel -> (3,) m in its frame, from the middle line to the sole's left edge.

    The edge is where the foot's collision shapes end, as far as they are near the sole: the nearer one of left and
    right, of the half of the sole that is the limb's.
    """
    out: dict[int, Array] = {}
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.q_nominal)
    for pair in robot.pairs:
        frames = [robot.model.getFrameId(robot.limbs[c].foot) for c in pair]
        T_world_joint = data.oMi[robot.model.frames[frames[0]].parentJoint]
        toe, heel = (data.oMf[f].translation for f in frames)
        along = (toe - heel) / np.linalg.norm(toe - heel)
        up = np.array([0.0, 0.0, 1.0]) - along[2] * along
        up /= np.linalg.norm(up)
        across = np.cross(up, along)
        shapes = (_shape_points(robot, frames[0]) @ T_world_joint.rotation.T) + T_world_joint.translation
        x, y, z = ((shapes - heel) @ axis for axis in (along, across, up))
        length = float(np.linalg.norm(toe - heel))
        for c, f, mine in zip(pair, frames, (x > length / 2, x <= length / 2), strict=True):
            sides = y[mine & (z < NEAR)]
            width = min(sides.max(), -sides.min()) if len(sides) else 0.0
            if width < 1e-3:
                width = NO_SHAPE * length
            out[int(c)] = data.oMf[f].rotation.T @ (width * across)
    return out


def _shape_points(robot: Robot, frame: int) -> Array:
    """(N, 3) m, corners of the collision shapes that move with a frame, in its joint's frame."""
    model = robot.model
    joint = model.frames[frame].parentJoint
    placements = {f.name: f.placement for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint}
    out = [np.zeros((0, 3))]
    for link in ET.parse(robot.urdf).iterfind("link"):
        if link.get("name") not in placements:
            continue
        for collision in link.iterfind("collision"):
            shape, origin = collision.find("geometry/*"), collision.find("origin")
            assert shape is not None
            xyz, rpy = (_numbers(origin.get(k, "0 0 0") if origin is not None else "0 0 0") for k in ("xyz", "rpy"))
            T = placements[str(link.get("name"))] * pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
            out.append(_corners(shape, robot) @ T.rotation.T + T.translation)
    return np.concatenate(out)


def _corners(shape: ET.Element, robot: Robot) -> Array:
    """(N, 3) m, points whose hull is (about) a URDF's shape."""
    if shape.tag == "box":
        return np.array(list(np.ndindex(2, 2, 2))) * _numbers(shape.attrib["size"]) - _numbers(shape.attrib["size"]) / 2
    if shape.tag == "sphere":
        return np.zeros((1, 3))  # it touches the ground under its centre
    if shape.tag in ("cylinder", "capsule"):
        radius, half = float(shape.attrib["radius"]), float(shape.attrib["length"]) / 2
        if shape.tag == "capsule":
            half += radius
        angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        ring = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(16, half)], axis=1)
        return np.concatenate([ring, ring * [1, 1, -1]])
    mesh = trimesh.load(find_mesh(shape.attrib["filename"], robot.urdf, robot.package_dirs), force="mesh")
    scale = _numbers(shape.get("scale", "1 1 1"))
    return np.asarray(mesh.vertices) * scale  # pyright: ignore[reportAttributeAccessIssue]


def _numbers(text: str) -> Array:
    return np.array(text.split(), float)
