"""Where a limb's point can be at all, as half-spaces in the base frame: the hull of what its joints can reach.

The length of a leg alone lets it cross under the body or swing out further than its hip turns. The hull of the places
within the joint limits, of those below the body where the point must stay there, leaves that out; it is convex, so each
of its half-spaces is linear in the point's place in the base frame.
"""

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.stats import qmc

Array = np.ndarray

_SAMPLES, _SWEEPS, _GRID = 2048, 2, 9
_ANGLES = np.radians([0, 15, 30, 45, 60, 75])


def directions() -> Array:
    """(K, 3) outward normals of the half-spaces: sideways and along, level to steeply up; and straight up."""
    c, s = np.cos(_ANGLES), np.sin(_ANGLES)
    o = np.zeros_like(c)
    planes = [np.stack(axes, axis=1) for axes in ((c, o, s), (-c, o, s), (o, c, s), (o, -c, s))]
    return np.concatenate([*planes, [[0.0, 0.0, 1.0]]])


def workspace(
    model: pin.Model, q: Array, base: str, points: tuple[str, ...], *, lower: Array, upper: Array, below: Array
) -> Array:
    """(C, K) m, offsets d of the half-spaces n . x <= d with n of `directions`, x a point's place in the base frame.

    The support function of the places that evenly spread joint angles reach (Halton 1960), the best angles of each
    direction improved joint by joint; other limbs stay as in q (nq,).

    Args:
        base: its frame.  points: the limbs' C frames.  lower, upper: (nj,) limits of the joints.
        below: (C,) m, least distance of a point below the base's origin; -inf for points that may be anywhere.
    """
    data, n = model.createData(), directions()
    out = np.empty((len(points), len(n)))
    for c, name in enumerate(points):
        frame = model.getFrameId(name)
        joints = [model.idx_qs[j] for j in model.supports[model.frames[frame].parentJoint] if j > 1]
        low, high = lower[[a - 7 for a in joints]], upper[[a - 7 for a in joints]]
        posed = q.copy()

        def place(angles: Array, joints: list[int] = joints, posed: Array = posed, frame: int = frame) -> Array:
            posed[joints] = angles
            pin.framesForwardKinematics(model, data, posed)
            return data.oMf[model.getFrameId(base)].actInv(data.oMf[frame].translation)

        spread = qmc.Halton(max(len(joints), 1), scramble=False).random(_SAMPLES)[:, : len(joints)]
        # A third of the angles are limits: the hull's corners are there.
        angles = low + np.clip(1.5 * spread - 0.25, 0.0, 1.0) * (high - low)
        places = np.array([place(a) for a in angles])
        kept = places[:, 2] <= -below[c]
        if not kept.any():
            kept[:] = True
        for k, normal in enumerate(n):
            height = np.where(kept, places @ normal, -np.inf)
            best, most = angles[np.argmax(height)].copy(), float(height.max())
            for j in list(range(len(joints))) * _SWEEPS:
                for value in np.linspace(low[j], high[j], _GRID):
                    tried = best.copy()
                    tried[j] = value
                    x = place(tried)
                    if x @ normal > most and x[2] <= -below[c]:
                        best, most = tried, float(x @ normal)
            out[c, k] = most
    return out
