"""What limbs can do by their joints: how far they reach, which forces they bear, where the trunk is in their way."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import trimesh
from scipy.optimize import minimize
from scipy.stats import qmc

from slomo.robot_file import find_mesh

Array = np.ndarray

_SWING = 0.5  # rad
_STARTS = 6  # of the search, spread evenly over the joints' ranges; the nominal pose and the limits come first


@dataclass(frozen=True)
class Point:
    """A point of the robot: at `at` (3,) m in the frame of a joint (1 is the root)."""

    joint: int
    at: Array


def frame_point(model: pin.Model, name: str) -> Point:
    """The origin of a frame."""
    frame = model.frames[model.getFrameId(name)]
    return Point(frame.parentJoint, frame.placement.translation)


def leg_root(model: pin.Model, q: Array, hip: str, foot: str, *, lower: Array, upper: Array) -> Point:
    """The point of the root from which the leg's length depends least on the joints that swing its hip.

    A quadruped's hip is carried about an axis of the trunk at a distance of several centimetres, across the leg. From
    the axis's point nearest to it the hip, and with it the foot, is as far whatever that joint's angle. So, of this
    point, if one joint alone moves the hip's origin, and of the hip as it is at q, the one from which the foot's
    distance varies less while the joints down to the hip's turn by up to half a radian.
    """
    data = model.createData()
    frame = model.getFrameId(hip)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    J = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, 6:]
    origin = data.oMf[frame].translation.copy()
    T_world_root = data.oMi[1].copy()
    candidates = [origin]
    movers = np.flatnonzero(np.linalg.norm(J[:3], axis=0) > 1e-3)
    if len(movers) == 1 and model.parents[2 + int(movers[0])] == 1:
        axis, motion = J[3:, movers[0]], J[:3, movers[0]]  # no axis: a sliding joint
        candidates += [origin - np.cross(motion, axis)] if np.any(axis) else []

    joints = [j for j in model.supports[model.frames[frame].parentJoint] if j > 1]
    at = [model.idx_qs[j] for j in joints]
    swing = 2 * qmc.Halton(max(len(joints), 1), scramble=False).random(64)[:, : len(joints)] - 1
    lengths = np.empty((len(swing), len(candidates)))
    posed = q.copy()
    for k, turn in enumerate(swing):
        posed[at] = np.clip(q[at] + _SWING * turn, lower[[a - 7 for a in at]], upper[[a - 7 for a in at]])
        pin.framesForwardKinematics(model, data, posed)
        lengths[k] = np.linalg.norm(data.oMf[model.getFrameId(foot)].translation - candidates, axis=1)
    best = int(np.argmin(np.ptp(lengths, axis=0)))
    return Point(1, T_world_root.actInv(candidates[best]))


def reach(model: pin.Model, q: Array, start: Point, end: Point, *, lower: Array, upper: Array) -> tuple[float, float]:
    """Least and greatest distance (m) of two points, `end` further down the same limb than `start`.

    The squared distance is minimised and maximised over the joints between them within lower and upper (nj,), by a
    truncated Newton method (Nash 1984) with the exact gradient from the same starts every time, the other joints as in
    q (nq,).
    """
    data = model.createData()
    joints = [j for j in model.supports[end.joint] if j > 1 and j not in model.supports[start.joint]]
    q = q.copy()
    at = [model.idx_qs[j] for j in joints]
    columns = [model.idx_vs[j] for j in joints]
    low, high = lower[[a - 7 for a in at]], upper[[a - 7 for a in at]]

    def squared(angles: Array, sign: float) -> tuple[float, Array]:
        q[at] = angles
        pin.computeJointJacobians(model, data, q)
        tip = data.oMi[end.joint].act(end.at)
        line = tip - data.oMi[start.joint].act(start.at)
        J = pin.getJointJacobian(model, data, end.joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
        arm = tip - data.oMi[end.joint].translation
        return sign * line @ line, sign * 2 * (line @ J[:3] + np.cross(arm, line) @ J[3:])

    if not joints:
        distance = float(np.sqrt(squared(np.zeros(0), 1.0)[0]))
        return distance, distance
    spread = qmc.Halton(len(joints), scramble=False).random(_STARTS)
    starts = [np.clip(q[at], low, high), low, high, *(low + spread * (high - low))]
    ends = []
    for sign in (1.0, -1.0):
        found = [
            minimize(squared, x, (sign,), jac=True, method="TNC", bounds=list(zip(low, high, strict=True))).fun
            for x in starts
        ]
        ends.append(float(np.sqrt(max(sign * min(found), 0.0))))
    return ends[0], ends[1]


def reaches(
    model: pin.Model, q: Array, starts: list[Point], feet: list[Point], *, pairs: Array, lower: Array, upper: Array
) -> Array:
    """(C, 2) m, least and greatest distance of C starts from C feet (see `reach`).

    Args:
        pairs: (P, 2) columns of toe and heel. Their greatest distances r are such that the point of the sole under the
            ankle, at most l from the start, stays within reach whenever both hold: r_i^2 = l^2 + s_i^2 for points at
            s_i from it (Stewart's theorem).
    """

    def distances(start: Point, end: Point) -> tuple[float, float]:
        return reach(model, q, start, end, lower=lower, upper=upper)

    out = np.array([distances(start, foot) for start, foot in zip(starts, feet, strict=True)])
    for pair in pairs:
        a, b = (feet[c].at for c in pair)
        share = np.clip(-a @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        sole = a + share * (b - a)  # the joint's origin, which is the ankle, projected on the line from a to b
        _, length = distances(starts[pair[0]], Point(feet[pair[0]].joint, sole))
        out[pair, 1] = [np.hypot(length, np.linalg.norm(p - sole)) for p in (a, b)]
    return out


def force_limits(jacobians: Array, effort: Array) -> Array:
    """(C, 3) N, the largest forces along the world's axes, each axis alone, that the joints' efforts allow.

    Horizontal limits are those of the worst horizontal direction, so that they hold for every heading. Limbs that share
    joints (toe and heel, hands on one waist) bear their limits together as well as alone, when they push the same way.

    Args:
        jacobians: (C, 3, nj) m, of the points, world axes.  effort: (nj,) N m.
    """
    horizontal = _fair_share(jacobians[:, :2], effort)
    return np.stack([horizontal, horizontal, _fair_share(jacobians[:, 2:], effort)], axis=1)


def _fair_share(jacobians: Array, effort: Array) -> Array:
    """(C,) N, forces in any one direction d of k that all subsets of the limbs can exert at once: progressive filling.

    All forces grow alike until a joint is at its effort for some subset S, |sum over S of J_c^T d u_c| for the worst d;
    the limbs that load it stop, the others grow on (max-min fairness, Bertsekas and Gallager 1992, section 6.5.2). Less
    force of one limb never loads a joint more than the worse of its full force and none, since the norm is convex.

    Args:
        jacobians: (C, k, nj).  effort: (nj,).
    """
    C = len(jacobians)
    subsets = np.array(list(itertools.product([0.0, 1.0], repeat=C))[1:])
    u, growing = np.zeros(C), np.ones(C)
    while growing.any():
        load = np.einsum("sc,c,ckj->skj", subsets, u, jacobians)
        rate = np.einsum("sc,c,ckj->skj", subsets, growing, jacobians)
        a = np.sum(rate**2, axis=1)
        b = np.sum(rate * load, axis=1)
        room = np.maximum(effort**2 - np.sum(load**2, axis=1), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(a > 1e-12, (-b + np.sqrt(b**2 + a * room)) / a, np.inf)
        s, j = np.unravel_index(int(np.argmin(step)), step.shape)
        u = u + growing * step[s, j]
        growing[(subsets[s] > 0) & (np.abs(jacobians[:, :, j]).max(axis=1) > 1e-6)] = 0.0
    return u


def underside(urdf: Path, package_dirs: tuple[Path, ...], placements: dict[str, pin.SE3]) -> float:
    """z (m) of the lowest point of the collision shapes of links at these placements; inf when they have none.

    Raises:
        InvalidData: a mesh is missing.
    """
    lowest = np.inf
    for link in ET.parse(urdf).iterfind("link"):
        if link.get("name") not in placements:
            continue
        for collision in link.iterfind("collision"):
            shape, origin = collision.find("geometry/*"), collision.find("origin")
            assert shape is not None
            xyz, rpy = (_numbers(origin.get(k, "0 0 0") if origin is not None else "0 0 0") for k in ("xyz", "rpy"))
            T = placements[str(link.get("name"))] * pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
            down = T.rotation.T @ [0.0, 0.0, -1.0]
            lowest = min(lowest, T.translation[2] - _support(shape, down, urdf, package_dirs))
    return float(lowest)


def _support(shape: ET.Element, d: Array, urdf: Path, package_dirs: tuple[Path, ...]) -> float:
    """max of d . x over the points x of a URDF's shape."""
    if shape.tag == "box":
        return float(np.abs(d) @ _numbers(shape.attrib["size"]) / 2)
    if shape.tag == "sphere":
        return float(shape.attrib["radius"])
    if shape.tag in ("cylinder", "capsule"):
        radius, half = float(shape.attrib["radius"]), float(shape.attrib["length"]) / 2
        return abs(d[2]) * half + radius * (1.0 if shape.tag == "capsule" else float(np.hypot(d[0], d[1])))
    mesh = trimesh.load(find_mesh(shape.attrib["filename"], urdf, package_dirs), force="mesh")
    vertices = np.asarray(mesh.vertices) * _numbers(shape.get("scale", "1 1 1"))  # pyright: ignore[reportAttributeAccessIssue]
    return float(np.max(vertices @ d))


def _numbers(text: str) -> Array:
    return np.array(text.split(), float)
