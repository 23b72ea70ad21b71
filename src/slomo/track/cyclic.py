"""A motion that repeats, for as long as wanted."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import UsageError
from slomo.motion import Reference


def repeated(reference: Reference, seconds: float) -> Reference:
    """The cycle of a cyclic reference again and again, the last one whole, until at least `seconds` have gone.

    Raises:
        UsageError: the reference is no cycle.
    """
    if len(reference.cycle) == 0:
        raise UsageError(
            "the motion does not repeat",
            where="track.seconds",
            todo="run `slomo optimize --cyclic` first, or leave it at 0",
        )
    length = float(reference.t[-1] - reference.t[0])
    n, steps = max(1, int(np.ceil(seconds / length - 1e-9))), len(reference.h)
    *shift, angle = reference.cycle
    q, v, u, lam = [reference.q[:1]], [reference.v[:1]], [], []
    offset = np.zeros(3)
    for k in range(n):
        turn = Rotation.from_euler("z", k * angle)
        q.append(_moved(reference.q[1:], turn, offset, quaternion=3))
        v.append(_moved(reference.v[1:], turn, np.zeros(3), body=3))
        u.append(_moved(reference.u, turn, np.zeros(3)))
        lam.append(turn.apply(reference.lam.reshape(-1, 3)).reshape(reference.lam.shape))
        offset = Rotation.from_euler("z", angle).apply(offset) + shift
    t = reference.t[0] + np.concatenate([[0.0], np.add.outer(length * np.arange(n), np.cumsum(reference.h)).ravel()])
    return replace(
        reference, t=t, h=np.tile(reference.h, n)[: n * steps], q=np.vstack(q), v=np.vstack(v), u=np.vstack(u),
        lam=np.concatenate(lam), cycle=np.zeros(0),
    )  # fmt: skip


def _moved(x: np.ndarray, turn: Rotation, offset: np.ndarray, *, quaternion: int = -1, body: int = -1) -> np.ndarray:
    """Rows of 3-vectors turned and moved; at column `quaternion` a quat_xyzw, at column `body` a vector that is in the
    body's frame already."""
    out, i = x.copy(), 0
    while i < x.shape[1]:
        if i == quaternion:
            out[:, i : i + 4] = (turn * Rotation.from_quat(x[:, i : i + 4])).as_quat()
            i += 4
            continue
        if i != body:
            out[:, i : i + 3] = turn.apply(x[:, i : i + 3]) + offset
        i += 3
    return out
