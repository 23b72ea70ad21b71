"""Joint angles Q(t) and root pose G(t) as MLPs over Fourier features of time, H hypotheses at once.

Both are corrections on top of a coarse guess: the root path from the masks, and the swing of a hypothetical gait (or
the rest pose). The last layers start at zero, so the first pose is the guess.
"""

import itertools
import math
from dataclasses import dataclass, fields

import torch

from slomo.reconstruct.kinematics import rot

Tensor = torch.Tensor

MAX_FEATURES = 512  # frequencies at most: beyond a minute they are farther apart, and motion a minute apart is alike


@dataclass(frozen=True)
class Guess:
    """What the MLPs correct, at every time of the clip.

    Attributes:
        position: (H, T, 3) world units. yaw: (H, T) rad, heading of the body; lean: (H, T, 2) rad, its pitch and roll.
        q: (H, T, B, 3) rad.
        stance: (H, T, F) hypothetical contact in [0, 1] of each limb; a half where there is no hypothesis.
    """

    position: Tensor
    yaw: Tensor
    lean: Tensor
    q: Tensor
    stance: Tensor

    def pick(self, which: Tensor) -> "Guess":
        """The guesses of some hypotheses."""
        return Guess(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


def features(t: Tensor, duration: float, highest: float) -> Tensor:
    """(T, 2 K + 1): t scaled to [-1, 1] and sin, cos up to `highest` Hz; high frequencies are damped as 1 / (1 + f)."""
    K = max(2, min(MAX_FEATURES, math.ceil(2 * highest * duration)))
    f = torch.linspace(highest / K, highest, K)
    phase = 2 * math.pi * t[:, None] * f
    damp = 1 / (1 + f)
    return torch.cat([2 * t[:, None] / duration - 1, torch.sin(phase) * damp, torch.cos(phase) * damp], 1)


def mlp_variables(name: str, sizes: tuple[int, ...], H: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Weights of an MLP for each hypothesis (the same start for all): He initialisation, last layer zero."""
    out = {}
    for n, (i, o) in enumerate(itertools.pairwise(sizes)):
        last = n == len(sizes) - 2
        w = torch.zeros(i, o) if last else torch.randn(i, o, generator=generator) * math.sqrt(2 / i)
        out[f"{name}.w{n}"] = w.expand(H, i, o).clone()
        out[f"{name}.b{n}"] = torch.zeros(H, 1, o)
    return out


def mlp(variables: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    """(H, T, out) of features x (T, in)."""
    n = 0
    y = x.expand(variables[f"{name}.w0"].shape[0], *x.shape)
    while f"{name}.w{n}" in variables:
        y = torch.baddbmm(variables[f"{name}.b{n}"], y, variables[f"{name}.w{n}"])
        n += 1
        if f"{name}.w{n}" in variables:
            y = torch.nn.functional.silu(y)
    return y


class Trajectory:
    """Evaluates the guess plus its corrections at any of the clip's times."""

    def __init__(self, t: Tensor, B: int, *, joint_hz: float, root_hz: float, width: int):
        self.B, self.width = B, width
        duration = float(t[-1] - t[0])
        self.fq = features(t - t[0], duration, joint_hz)
        self.fg = features(t - t[0], duration, root_hz)

    def variables(self, H: int, generator: torch.Generator) -> dict[str, Tensor]:
        q = mlp_variables("Q", (self.fq.shape[1], self.width, self.width, 3 * (self.B - 1)), H, generator)
        return q | mlp_variables("G", (self.fg.shape[1], self.width, self.width, 6), H, generator)

    def __call__(
        self, variables: dict[str, Tensor], guess: Guess, length: Tensor, at: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Root position (H, T, 3), root rotation (H, T, 3, 3) and joint angles (H, T, B, 3) at frames `at`."""
        dq = mlp(variables, "Q", self.fq[at])
        dg = mlp(variables, "G", self.fg[at])
        position = guess.position[:, at] + dg[..., :3] * length[:, None, None]
        yaw = guess.yaw[:, at] + dg[..., 3]
        pitch, roll = (guess.lean[:, at] + dg[..., 4:]).unbind(-1)
        R = rot(2, yaw) @ rot(1, pitch) @ rot(0, roll)
        q = guess.q[:, at]
        q = torch.cat([q[:, :, :1], q[:, :, 1:] + dq.reshape(*dq.shape[:2], self.B - 1, 3)], 2)
        return position, R, q
