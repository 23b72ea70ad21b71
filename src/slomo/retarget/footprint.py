"""Where the robot's soles go: under its hips, within reach of strides, from the origin, on a step."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.retarget.soles import RobotBody
from slomo.retarget.trunk import Trunk
from slomo.rotation import rot_z
from slomo.terrain import Box, Terrain

Array = np.ndarray
_NARROWEST = 0.7  # of the distance of hips: nearer, feet get in each other's way
_LEVEL = 0.5  # rad, a body tilted less stands as usual


@dataclass(frozen=True)
class Footprint:
    """Paths on the ground: soles (T, S, 2) m and body (T, 2) m, and the stride scale."""

    soles: Array
    body: Array
    stride: float


def footprint(xy: Array, base: Array, trunk: Trunk, standing: Array, body: RobotBody) -> Footprint:
    """Stance width and length of the robot, strides of the creature, shortened where legs would not reach.

    Each sole is shifted by a constant in the heading frame: a paw so that its median stance place lies under the
    robot's hip, or as far inside as the creature's; a foot sideways only as far as keeps it from the other one (a
    person's stance opens and closes). A sole that never stands while the body is level keeps its place along the body.
    One factor on the path of body and soles alike keeps standing soles standing.

    Args:
        xy: (T, S, 2), base: (T, 2) m, in the robot's size.  standing: (T, S) bool.
    """
    R = rot_z(trunk.heading)[:, :2, :2]
    relative = np.einsum("tji,tfj->tfi", R, xy - base[:, None])
    home = body.home - body.root[:2]
    level = (np.linalg.norm(trunk.tilt, axis=1) < _LEVEL)[:, None] & standing
    centre = np.empty_like(home)
    for f, x in enumerate(relative.swapaxes(0, 1)):
        on = level[:, f] if level[:, f].any() else standing[:, f]
        stances = x[on] if on.any() else x
        centre[f] = np.median(stances, axis=0)
        side, width = np.sign(home[f, 1]), abs(home[f, 1])
        if body.length:
            centre[f, 1] = side * np.percentile(side * stances[:, 1], 10)
        # As narrow as the creature stands, as far as the robot can: the wider the stance, the more a body must sway.
        home[f, 1] = side * np.clip(side * centre[f, 1], _NARROWEST * width, np.inf if body.length else width)
    free = ~level.any(axis=0)
    used = ~free if not free.all() else standing.any(axis=0) | free
    away = np.linalg.norm(relative - centre, axis=2)[:, used]
    excursion = float(np.percentile(away, 95))
    length = 0.95 * float(body.reach[:, 1].min())
    # A long-legged posture is lowered rather than kept from striding.
    room = 0.8 * np.sqrt(length**2 - min(body.leg, 0.9 * length) ** 2)
    stride = min(1.0, room / excursion) if excursion > 0 else 1.0
    shift = home - stride * centre
    shift[free, 0] = 0.0
    return Footprint(stride * xy + np.einsum("tij,fj->tfi", R, shift), stride * base, stride)


def start_at_origin(paths: Footprint, trunk: Trunk, body: RobotBody) -> tuple[Footprint, Trunk]:
    """The robot's base starts at the origin and looks along x."""
    turn = -trunk.heading[0]
    moved = Trunk(origin=trunk.origin, rotation=Rotation.from_euler("z", turn) * trunk.rotation)
    R = rot_z(turn)[:2, :2]
    soles, middle = paths.soles @ R.T, paths.body @ R.T
    start = middle[0] - moved.rotation[0].apply(body.root)[:2]
    return Footprint(soles - start, middle - start, paths.stride), moved


def on_step(body: RobotBody, limbs: tuple[str, ...], names: tuple[str, ...]) -> Array:
    """(S,) bool: soles that stand on the step; `names` are the robot's limbs. Raises `UsageError`."""
    known = dict.fromkeys((*names, *body.soles))  # a quadruped's soles have the names of its limbs
    if not limbs or any(n not in known for n in limbs):
        what = ", ".join(f"no limb {n!r}" for n in limbs if n not in known)
        raise UsageError(what or "no limb is named", where="retarget.step_limbs", valid=known)
    return np.array(
        [s in limbs or any(names[c] in limbs for c in p) for s, p in zip(body.soles, body.points, strict=True)]
    )


def make_terrain(xy: Array, on: Array, *, height: float) -> Terrain:
    """A step of `height` (m) under the soles `on` (S,), its edge midway between them and the others.

    Below 0 the step goes down: the others stand on a box. Raises `InvalidData` where no straight edge parts the two.
    """
    if height == 0:
        return Terrain()
    if height < 0:
        on, height = ~on, -height
    if on.all() or not on.any():
        raise InvalidData("a step needs feet on it and feet off it", where="retarget.step_limbs")
    gaps = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        behind, ahead = float((sign * xy[:, ~on, axis]).max()), float((sign * xy[:, on, axis]).min())
        gaps.append((ahead - behind, axis, sign, (behind + ahead) / 2))
    gap, axis, sign, edge = max(gaps)
    if gap < 0.06:
        raise InvalidData(
            f"a step does not fit: feet on it and feet off it overlap, by {-gap:.2f} m or more in every direction"
            if gap < 0
            else f"a step does not fit: feet on it and feet off it come as near as {gap:.2f} m",
            where="retarget.step_height", todo="choose a part with --set retarget.start=... and retarget.end=...",
        )  # fmt: skip
    low, high = xy.min(axis=(0, 1)) - 0.5, xy.max(axis=(0, 1)) + 0.5
    if sign > 0:
        low[axis] = edge
    else:
        high[axis] = -edge
    return Terrain((Box(float(low[0]), float(high[0]), float(low[1]), float(high[1]), height),))
