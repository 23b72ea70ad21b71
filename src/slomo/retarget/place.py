"""The robot's body, hips, points and hands, from the paths of its soles: everything within reach."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from slomo.retarget.footprint import Footprint
from slomo.retarget.ground import Walk
from slomo.retarget.soles import RobotBody
from slomo.retarget.subject import Hands, Subject
from slomo.retarget.trunk import Trunk
from slomo.robot import Robot

Array = np.ndarray
_LONGEST, _SHORTEST = 0.97, 1.1  # of the joints' reach: what planning leaves of it (see `pointfoot`)
_LOWEST = {"paw": 0.4, "foot": 0.65}  # of the leg: no lower does a body crouch over paws and over level feet
_ANKLE = 0.6  # rad, how far ankles bend forward at ease
_BRIDGED, _PLACED = 0.2, 0.1  # confidence of key points in a gap, and of a humanoid's that were never seen
_EASE = 0.1  # s, over which the body gives way to what legs can reach


@dataclass(frozen=True)
class Placed:
    """The robot over T frames.

    Attributes:
        base: (T, 3) m.  hips, points: (T, C, 3) m.  confidence: (T, C).  standing: (T, C) bool.
        moved: m, the most by which the body gave way to what legs reach.  drawn: (T, S) bool, swings that did.
        beyond: (T, C') bool, points of seen feet that are still out of reach.
    """

    base: Array
    hips: Array
    points: Array
    confidence: Array
    standing: Array
    moved: float
    drawn: Array
    beyond: Array


def placed(
    walk: Walk,
    paths: Footprint,
    trunk: Trunk,
    subject: Subject,
    under: Array,
    robot: Robot,
    body: RobotBody,
    *,
    dt: float,
) -> Placed:
    """Everything of the robot from the paths of soles and body; `under`: (T, S) m, ground under the soles."""
    R, C = trunk.rotation, len(robot.limbs)
    soles = np.concatenate([paths.soles, (under + walk.lift)[..., None]], axis=2)
    pointing = walk.pointing - walk.trunk.heading[0]
    confidence, standing = np.ones((len(soles), C)), np.zeros((len(soles), C), bool)
    for s, columns in enumerate(body.points):
        confidence[:, list(columns)] = subject.confidence[:, s, None]
        standing[:, list(columns)] = walk.standing[:, s, None]
    wanted = body.leg + walk.rise + under.mean(axis=1)
    level = points_of(soles, pointing, np.zeros_like(pointing), robot, body)
    z = body_height(wanted, paths.body, R, level, standing, robot, body, dt=dt)
    base = np.column_stack([paths.body, z]) - R.apply(body.root)
    hips = base[:, None] + np.einsum("tij,cj->tci", R.as_matrix(), robot.nominal_hips)
    homes = np.column_stack([body.home, body.roots[:, 2]])
    roots, homes = (base[:, None] + np.einsum("tij,sj->tsi", R.as_matrix(), x) for x in (body.roots, homes))
    # A leg that was never seen stays under its hip, on the ground while another one is.
    unseen = ~walk.known
    height = under + walk.lift[:, walk.known].min(axis=1)[:, None]
    soles[:, unseen] = np.concatenate([homes[:, unseen, :2], height[:, unseen, None]], axis=2)
    free = ~(walk.standing & walk.known)
    down = droop(soles, roots, trunk.heading, free, under, body, dt=dt)
    points = points_of(soles, pointing, down, robot, body)
    soles, drawn = within_reach(soles, points, hips, free, under, robot, body)
    points = points_of(soles, pointing, down, robot, body)
    if body.hands:
        columns = list(body.hands)
        points[:, columns], confidence[:, columns] = hands_of(subject.hands, base, R, robot, body)
    # A bridge over a gap is worth something. So is where an unseen foot or hand was put: without it, nothing would keep
    # a toe before its heel. An unseen paw is free.
    seen = np.any(confidence > 0, axis=0)
    length = np.linalg.norm(points - hips, axis=2)
    beyond = (length > robot.leg_reach[:, 1]) | (length < robot.leg_reach[:, 0])
    return Placed(
        base=base, hips=hips, points=points, standing=standing,
        confidence=np.where(seen, np.maximum(confidence, _BRIDGED), _PLACED if body.length else 0.0),
        moved=float(np.abs(z - wanted).max()), drawn=drawn, beyond=beyond[:, seen],
    )  # fmt: skip


def body_height(
    z: Array, xy: Array, R: Rotation, points: Array, standing: Array, robot: Robot, body: RobotBody, *, dt: float
) -> Array:
    """Height (T,) m of the middle between the hips, changed where a standing point would be out of reach.

    Args:
        z: (T,) m wanted.  xy: (T, 2) m, the same point.  points: (T, C, 3) m.  standing: (T, C) bool.  dt: s.
    """
    legs = [c for group in body.points for c in group]
    points, standing = points[:, legs], standing[:, legs]
    least, most = _limits(robot.leg_reach[legs])
    hips = np.einsum("tij,cj->tci", R.as_matrix(), robot.nominal_hips[legs] - body.root)
    over = points[..., 2] - hips[..., 2]  # height of the middle at which the hip is level with the point
    across = np.linalg.norm(xy[:, None] + hips[..., :2] - points[..., :2], axis=2)
    tall = np.sqrt(np.maximum(most**2 - across**2, (0.5 * most) ** 2)) + over
    low = (
        np.maximum(np.sqrt(np.maximum(least**2 - across**2, 0.0)), _LOWEST["foot" if body.length else "paw"] * body.leg)
        + over
    )
    ceiling, floor = np.where(standing, tall, np.inf).min(axis=1), np.where(standing, low, -np.inf).max(axis=1)
    n = 2 * round(_EASE / dt) | 1
    for limit, extreme, widest in ((floor, np.maximum, maximum_filter1d), (ceiling, np.minimum, minimum_filter1d)):
        change = widest(extreme(z, limit) - z, n, mode="nearest")
        z = z + gaussian_filter1d(change, _EASE / dt / 2, mode="nearest")
    return z


def _limits(reach: Array) -> tuple[Array, Array]:
    return _SHORTEST * reach[:, 0], _LONGEST * reach[:, 1]


def within_reach(
    soles: Array, points: Array, hips: Array, free: Array, ground: Array, robot: Robot, body: RobotBody
) -> tuple[Array, Array]:
    """Soles that swing, drawn to where their points are within reach.

    Args:
        soles: (T, S, 3) m.  points, hips: (T, C, 3) m.  free: (T, S) bool, soles that may move.  ground: (T, S) m.

    Returns:
        (T, S, 3) m, and which ones were drawn (T, S) bool.
    """
    least, most = _limits(robot.leg_reach)
    out, drawn = soles.copy(), np.zeros(free.shape, bool)
    for s, columns in enumerate(body.points):
        for c in columns * 2:  # what suits the toe may not suit the heel
            leg = points[:, c] - soles[:, s] + out[:, s] - hips[:, c]
            length = np.linalg.norm(leg, axis=1)
            excess = np.clip(length, least[c], most[c]) / np.maximum(length, 1e-9) - 1
            moved = free[:, s] & (np.abs(excess) > 1e-9)
            drawn[:, s] |= moved
            out[moved, s] += excess[moved, None] * leg[moved]
            out[moved, s, 2] = np.maximum(out[moved, s, 2], ground[moved, s])
    return out, drawn


def droop(
    soles: Array, roots: Array, heading: Array, free: Array, ground: Array, body: RobotBody, *, dt: float
) -> Array:
    """(T, S) rad by which the toes of swinging feet hang down, where a level foot would ask too much of the ankle.

    With thigh and shank of one length, a foot at distance d from its hip leans the shank forward by acos(d / straight
    leg) more than the line from hip to foot, and that is the ankle's angle if the foot is level.

    Args:
        soles, roots: (T, S, 3) m.  heading: (T,) rad.  free: (T, S) bool, feet that swing.  ground: (T, S) m.  dt: s.
    """
    if not body.length:
        return np.zeros(free.shape)
    leg = soles - roots
    ahead = leg[..., 0] * np.cos(heading)[:, None] + leg[..., 1] * np.sin(heading)[:, None]
    straight = np.arccos(np.clip(np.linalg.norm(leg, axis=2) / body.reach[:, 1], -1, 1))
    lean = straight - np.arctan2(ahead, -leg[..., 2])
    down = gaussian_filter1d(np.where(free, np.maximum(lean - _ANKLE, 0.0), 0.0), _EASE / dt / 2, axis=0)
    room = np.arcsin(np.clip(2 * (soles[..., 2] - ground) / body.length, 0, 1))  # the toes stay over the ground
    return np.minimum(down, room) * free


def points_of(soles: Array, pointing: Array, down: Array, robot: Robot, body: RobotBody) -> Array:
    """(T, C, 3) m: each sole's points, toe and heel as far apart as on the robot; hands are left at 0.

    Args:
        soles: (T, S, 3) m.  pointing: (T, S) rad, heading of the toes.  down: (T, S) rad, how far they hang.
    """
    out = np.zeros((len(soles), len(robot.limbs), 3))
    level = np.cos(down)
    ahead = np.stack([level * np.cos(pointing), level * np.sin(pointing), -np.sin(down)], axis=2)
    for s, points in enumerate(body.points):
        for c, sign in zip(points, (0.5, -0.5) if body.length else (0.0,), strict=True):
            out[:, c] = soles[:, s] + sign * body.length * ahead[:, s]
    return out


def hands_of(hands: Hands | None, base: Array, R: Rotation, robot: Robot, body: RobotBody) -> tuple[Array, Array]:
    """(T, H, 3) m and confidence (T, H) of the robot's hands; one that was never seen hangs as in the nominal pose."""
    columns = list(body.hands)
    at = np.broadcast_to(robot.nominal_feet[columns], (len(base), len(columns), 3)).copy()
    confidence = np.zeros((len(base), len(columns)))
    if hands is not None:
        known = np.any(hands.confidence > 0, axis=0)
        least, most = _limits(robot.leg_reach[columns])
        offset = hands.offset * most[:, None]
        length = np.linalg.norm(offset, axis=2)
        offset *= (np.clip(length, least, most) / np.maximum(length, 1e-9))[..., None]
        at[:, known] = (robot.nominal_hips[columns] + offset)[:, known]
        confidence[:, known] = hands.confidence[:, known]
    return base[:, None] + np.einsum("tij,tcj->tci", R.as_matrix(), at), confidence
