"""Windows that cover a clip, and the kinematic trajectory within them.

Unstable things cannot be simulated for long without feedback: an error of a body that stands on its feet grows by e in
sqrt(length / g), a fifth of a second for a dog. So a clip is simulated in short windows that overlap; where they do,
their results are blended.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import BSpline, CubicSpline
from scipy.spatial.transform import Rotation, Slerp

Array = np.ndarray
Tensor = torch.Tensor


@dataclass(frozen=True)
class Kinematic:
    """A trajectory at T moments. Metres, world z up, ground at 0.

    Attributes:
        t: (T,) s. position: (T, 3) m and R: (T, 3, 3) of the root. q: (T, B, 3) rad. nodes: (T, M, 3) m.
        contact: (T, M) probability that the node stands on the ground.
    """

    t: Array
    position: Array
    R: Array
    q: Array
    nodes: Array
    contact: Array


@dataclass(frozen=True)
class Windows:
    """N windows of S steps of `dt` s; window k begins at `start[k]` s.

    Attributes:
        frame: (N, F) index of the kinematic's moments within each window, -1 where there are fewer. step: (N, F) when,
            in steps. blend: (N, F) share of the window in the blended result; the shares of a moment sum to 1.
        basis: (S + 1, K) of cubic B-splines, for smooth functions of time within a window.
    """

    start: Array
    steps: int
    dt: float
    frame: Array
    step: Array
    blend: Array
    basis: Tensor

    @property
    def count(self) -> int:
        return len(self.start)

    def merge(self, x: Array, T: int) -> Array:
        """(T, ...) blended from the windows' (N, F, ...)."""
        out = np.zeros((T, *x.shape[2:]))
        here = self.frame >= 0
        share = self.blend[here].reshape(-1, *[1] * (x.ndim - 2))
        np.add.at(out, self.frame[here], share * x[here])
        return out


def cover(t: Array, *, length: float, overlap: float, dt: float, knot: float) -> Windows:
    """Windows over the moments t (T,).

    Args:
        length: s of a window; overlap: s that two share. dt: s of a step at most. knot: s between the splines' knots.
    """
    total = float(t[-1] - t[0])
    span = min(length, total)
    count = 1 if total <= span else int(np.ceil((total - overlap) / (span - overlap)))
    start = t[0] + (total - span) * (np.arange(count) / max(count - 1, 1))
    steps = int(np.ceil(span / dt - 1e-9))
    dt = span / steps
    within = [np.flatnonzero((t > s - 1e-6) & (t < s + span + 1e-6)) for s in start]
    F = max(map(len, within))
    frame = np.array([np.concatenate([k, np.full(F - len(k), -1)]) for k in within])
    step = np.clip((t[frame] - start[:, None]) / dt, 0, steps)
    # Where windows overlap each counts the more the farther it is from its ends.
    inner = np.minimum(step, steps - step) * dt + 1e-3
    blend = np.where(frame >= 0, inner, 0.0)
    sums = np.zeros(len(t))
    np.add.at(sums, frame[frame >= 0], blend[frame >= 0])
    blend /= sums[frame]
    return Windows(start, steps, dt, frame, step, blend, _basis(steps, span, knot))


def _basis(steps: int, span: float, knot: float) -> Tensor:
    pieces = max(1, round(span / knot))
    knots = np.arange(-3, pieces + 4) / pieces
    at = np.linspace(0, 1, steps + 1)
    return torch.as_tensor(BSpline.design_matrix(at, knots, 3).toarray(), dtype=torch.float32)


@dataclass(frozen=True)
class Guides:
    """The kinematic trajectory in N windows, in world axes.

    Attributes:
        position: (N, S + 1, 3) m, quaternion: (N, S + 1, 4) xyzw of the root, q: (N, S + 1, B, 3) rad, at every step.
        velocity: (N, 3) m/s, spin: (N, 3) rad/s of the root at the start.
        nodes: (N, F, M, 3) m, contact: (N, F, M) at the moments.
    """

    position: Tensor
    quaternion: Tensor
    velocity: Tensor
    spin: Tensor
    q: Tensor
    nodes: Tensor
    contact: Tensor


def guides(kinematic: Kinematic, windows: Windows) -> Guides:
    """Splines through the trajectory, evaluated at the steps."""
    T, t = len(kinematic.t), kinematic.t
    at = windows.start[:, None] + windows.dt * np.arange(windows.steps + 1)
    at = np.clip(at, t[0], t[-1])
    place = CubicSpline(t, kinematic.position)
    turn = Slerp(t, Rotation.from_matrix(kinematic.R))
    quaternion = turn(at.ravel()).as_quat().reshape(*at.shape, 4)
    # Over a frame: within one the interpolated speed is constant.
    gap = float(np.median(np.diff(t)))
    ahead, behind = (turn(np.clip(windows.start + s * gap, t[0], t[-1])) for s in (1, -1))
    lasted = np.clip(windows.start + gap, t[0], t[-1]) - np.clip(windows.start - gap, t[0], t[-1])
    spin = (ahead * behind.inv()).as_rotvec() / lasted[:, None]
    f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
    return Guides(
        position=f(place(at)), quaternion=f(quaternion), velocity=f(place(windows.start, 1)), spin=f(spin),
        q=f(CubicSpline(t, kinematic.q.reshape(T, -1))(at)).reshape(*at.shape, *kinematic.q.shape[1:]),
        nodes=f(kinematic.nodes[windows.frame]), contact=f(kinematic.contact[windows.frame]),
    )  # fmt: skip
