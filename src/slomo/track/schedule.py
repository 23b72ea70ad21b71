"""When the reference has its points on the ground: the contact schedule that a scheduled controller needs."""

import numpy as np

from slomo.motion import Reference
from slomo.terrain import Terrain

Array = np.ndarray

_LOADED = 0.02  # of the sum of all forces' time mean: the normal force from which a point counts as standing
_NEAR = 0.01  # m, height under which it does after the end


class Schedule:
    """Stance and forces of a reference at any time; after its end the points near the ground stand.

    Args:
        reference: with contact forces.  terrain: ground under it.
    """

    def __init__(self, reference: Reference, terrain: Terrain):
        self._t, self._lam = reference.t, reference.lam
        total = reference.lam[..., 2].sum(axis=1).mean()
        near = reference.points[-1, :, 2] - terrain.height(reference.points[-1]) < _NEAR
        self._stance = np.vstack([reference.lam[..., 2] > _LOADED * total, near])
        share = np.where(near, total / max(near.sum(), 1), 0.0)
        self._forces = np.concatenate([reference.lam, (share[:, None] * [0.0, 0.0, 1.0])[None]])

    def stance(self, t: Array) -> Array:
        """(K, C) bool, which points stand at times t (K,)."""
        return self._stance[self._row(t)]

    def forces(self, t: Array) -> Array:
        """(K, C, 3) N of the ground on the points at times t (K,)."""
        return self._forces[self._row(t)]

    def progress(self, now: float, t: Array) -> Array:
        """(K, C) in [0, 1]: how far a point's swing has come at times t (K,) >= now, smoothly from lift-off to landing.

        A point that stands from now until then has not begun (0); one that has swung and stands again is done (1).
        """
        rows = self._row(t)
        first = self._row(np.array([now]))[0]
        out = np.zeros((len(t), self._stance.shape[1]))
        ends = np.append(self._t, np.inf)
        for c in range(out.shape[1]):
            swung = False
            row = first
            for k, target in enumerate(rows):
                swung |= not np.all(self._stance[row : target + 1, c])
                row = target
                if self._stance[target, c]:
                    out[k, c] = float(swung)
                    continue
                standing = self._stance[:, c]
                before = np.flatnonzero(standing[:target])
                after = np.flatnonzero(standing[target:])
                start = ends[before[-1] + 1] if len(before) else self._t[0]
                end = ends[target + after[0]] if len(after) else self._t[-1]
                s = np.clip((t[k] - start) / max(end - start, 1e-3), 0, 1)
                out[k, c] = s * s * (3 - 2 * s)
        return out

    def _row(self, t: Array) -> Array:
        return np.clip(np.searchsorted(self._t, t + 1e-9, side="right") - 1, 0, len(self._t) - 1)
