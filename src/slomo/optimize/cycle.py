"""A gait that can be repeated for ever: one cycle of a motion, and targets that end where they began.

The solver holds the end state to the first one, turned about the vertical and moved (`closing`); here the cycle is
found and its targets are closed.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.optimize.problem import Targets, velocities
from slomo.terrain import Terrain

Array = np.ndarray

SHORTEST = 0.25  # s, of a cycle
LIFTED = 0.3  # of a foot's greatest lift: a foot that gets there swings
_SPEED = 0.05  # s, by which velocities count against positions


def find_cycle(want: Targets, terrain: Terrain) -> tuple[int, int]:
    """First and last knot of the cycle that closes best.

    Of all parts in which every foot that ever swings does, the one whose end is most like its start: body height, roll,
    pitch and feet in the heading frame, and their velocities.

    Raises:
        InvalidData: the motion is too short, or its feet never swing.
    """
    features, lift = _features(want), want.points[..., 2] - terrain.height(want.points)
    if np.ptp(terrain.height(want.points)) > 1e-6 or np.ptp(terrain.normal(want.points), axis=(0, 1)).max() > 1e-6:
        raise InvalidData("a gait repeats on level ground only", where="optimize.cyclic", todo="leave the terrain flat")
    high = lift.max(axis=0)
    moving = high > 0.25 * high.max()
    swings = (lift > LIFTED * high)[:, moving]
    T, h = len(want.t), want.t[1] - want.t[0]
    least = max(4, int(np.ceil(SHORTEST / h)))
    count = np.concatenate([np.zeros((1, swings.shape[1]), int), np.cumsum(swings, axis=0)])
    best, found = np.inf, (0, 0)
    for length in range(least, T):
        i = np.arange(T - length)
        inside = count[i + length] - count[i]
        complete = np.all((inside > 0) & (inside < length), axis=1)
        if not complete.any():
            continue
        off = np.sqrt(np.mean((features[i + length] - features[i]) ** 2, axis=1))
        off[~complete] = np.inf
        n = int(np.argmin(off))
        if off[n] < best:
            best, found = float(off[n]), (n, n + length)
    if not np.isfinite(best) or high.max() <= 0:
        raise InvalidData(
            f"no part of at least {SHORTEST} s in which every foot swings", where="optimize.cyclic",
            todo="give a longer motion, or leave --cyclic out",
        )  # fmt: skip
    return found


def _features(want: Targets) -> Array:
    """(T, n) m: what must come back after a cycle, in the heading frame."""
    R = Rotation.from_quat(want.q[:, 3:7])
    yaw, pitch, roll = R.as_euler("ZYX").T
    yaw = np.unwrap(yaw)
    level = Rotation.from_euler("z", -yaw[:, None])
    relative = np.stack([level.apply(p - want.q[:, :3]) for p in want.points.swapaxes(0, 1)], axis=1)
    size = float(np.median(np.ptp(relative, axis=1).max(axis=1)))
    x = np.column_stack([want.q[:, 2], 0.5 * size * pitch, 0.5 * size * roll, relative.reshape(len(yaw), -1)])
    return np.column_stack([x, _SPEED * np.gradient(x, want.t, axis=0)])


def end_shift(want: Targets) -> Array:
    """(4,) how closed targets move in a cycle, as `cost.Task.shift`."""
    yaw = np.unwrap(Rotation.from_quat(want.q[:, 3:7]).as_euler("ZYX")[:, 0])
    turn = Rotation.from_euler("z", yaw[-1] - yaw[0])
    return np.append(want.q[-1, :3] - turn.apply(want.q[0, :3]), yaw[-1] - yaw[0])


def close(want: Targets, first: int, last: int) -> Targets:
    """Targets of one cycle, whose last knot is the first one turned about the vertical and moved along the ground.

    What the last knot misses is spread over the cycle, half of it before the middle.
    """
    part = slice(first, last + 1)
    q = want.q[part].copy()
    n = len(q)
    R = Rotation.from_quat(q[:, 3:7])
    yaw = np.unwrap(R.as_euler("ZYX")[:, 0])
    turn = Rotation.from_euler("z", yaw[-1] - yaw[0])
    shift = q[-1, :3] - turn.apply(q[0, :3])
    shift[2] = 0.0
    share = (np.linspace(-0.5, 0.5, n))[:, None]
    for i in (0, *range(7, q.shape[1], 3)):
        off = q[-1, i : i + 3] - turn.apply(q[0, i : i + 3]) - shift
        # Half of it is taken from the end, half given to the start, which the turn carries to the end.
        back = (turn ** (-1)).apply(off)
        q[:, i : i + 3] -= np.where(share > 0, share * off, share * back)
    off = ((turn * R[0]).inv() * R[-1]).as_rotvec()
    q[:, 3:7] = (R * Rotation.from_rotvec(-share * off)).as_quat()
    t = want.t[part] - want.t[first]
    v = velocities(t, q)
    v[0] = v[-1]
    for i in (0, *range(6, v.shape[1], 3)):
        v[0, i : i + 3] = turn.inv().apply(v[-1, i : i + 3])
    return Targets(
        t=t, q=q, v=v, body_confidence=want.body_confidence[part], foot_confidence=want.foot_confidence[part]
    )
