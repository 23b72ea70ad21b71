"""The fitting problem: variables of H hypotheses, the draw of pixels, the weighted sum of the evidence, and Adam."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from slomo.reconstruct import losses, silhouette
from slomo.reconstruct.evidence import Evidence
from slomo.reconstruct.kinematics import Kinematics, Posed, rot
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.state import State, Term
from slomo.reconstruct.trajectory import Guess, Trajectory

Tensor = torch.Tensor
Variables = dict[str, Tensor]


@dataclass(frozen=True)
class Draw:
    """Pixels of one evaluation: fit frames `seen` (S,), flat indices (S, P), the first `inside` of them in the mask."""

    seen: Tensor
    pixel: Tensor
    inside: int


@dataclass(frozen=True)
class Pose:
    """The body and the camera in all fit frames, of which a draw sees some; attributes as of `State`."""

    body: Posed
    q: Tensor
    R_root: Tensor
    shape: dict[str, Tensor]
    R_cam: Tensor
    centre: Tensor
    ends: tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Problem:
    """Everything that stays while variables change.

    Attributes:
        weights: of the terms by name; a term whose weight is 0 is not evaluated.
        tilt_spread: s.d. of the camera's pitch and roll against gravity, rad.
        terms: the evidence.
        said: what networks and the user say about the clip, where anything is.
    """

    obs: Observations
    kin: Kinematics
    path: Trajectory
    weights: Mapping[str, float]
    tilt_spread: float
    terms: Mapping[str, Term] = field(default_factory=lambda: losses.TERMS)
    said: Evidence | None = None

    def variables(self, H: int, generator: torch.Generator) -> Variables:
        shape = {f"shape.{k}": v for k, v in self.kin.shape_variables(H).items()}
        return shape | {"tilt": torch.zeros(H, 2)} | self.path.variables(H, generator)

    def cameras(self, tilt: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        """World-to-camera rotations (H, T, 3, 3) and centres (H, T, 3), tilted about the mean centre."""
        T = torch.as_tensor(self.obs.T_world_cam[at], dtype=torch.float32)
        mean = torch.as_tensor(self.obs.T_world_cam[:, :3, 3].mean(0), dtype=torch.float32)
        # About the mean camera's own right and forward axes, laid level: pitch and roll.
        ahead = torch.as_tensor(self.obs.T_world_cam[:, :3, 2].mean(0), dtype=torch.float32)
        level = rot(2, torch.atan2(ahead[1], ahead[0]))
        angle = tilt * self.tilt_spread
        R = level @ rot(1, angle[:, 0]) @ rot(0, angle[:, 1]) @ level.T
        R_world_cam = R[:, None] @ T[:, :3, :3]
        centre = mean + (R[:, None] @ (T[:, :3, 3] - mean)[..., None])[..., 0]
        return R_world_cam.transpose(-1, -2), centre

    def draw(self, frames: int, pixels: int, generator: torch.Generator) -> Draw:
        """Random frames and pixels, half of them in the mask."""
        F = len(self.obs.at)
        seen = torch.randperm(F, generator=generator)[: min(frames, F)].sort().values
        half = pixels // 2
        r = torch.rand(2, len(seen), half, generator=generator, dtype=torch.float64)
        n = self.obs.mask.shape[1] - 1
        inside = _found(self.obs.draw_in, seen, r[0]).clamp(max=n)
        outside = _found(self.obs.draw_out, seen, r[1]).clamp(max=n)
        return Draw(seen, torch.cat([inside, outside], 1), half)

    def pose(self, x: Variables, guess: Guess) -> Pose:
        obs, kin = self.obs, self.kin
        shape = {k.removeprefix("shape."): v for k, v in x.items() if k.startswith("shape.")}
        length = shape["log_length"].exp()
        position, R_root, q = self.path(x, guess, length, obs.at)
        body = kin.pose(shape, position, R_root, q)
        R_cam, centre = self.cameras(x["tilt"], obs.at)
        a = silhouette.to_camera(R_cam, centre, body.a)
        b = silhouette.to_camera(R_cam, centre, body.b)
        return Pose(body, q, R_root, shape, R_cam, centre, (a, b))

    def state(self, x: Variables, guess: Guess, draw: Draw, *, stance_weight: float, pose: Pose | None = None) -> State:
        """What a draw sees; pose: of these variables, where it is known already."""
        obs, kin, p = self.obs, self.kin, pose or self.pose(x, guess)
        out = silhouette.outline(obs.K, p.ends[0][:, draw.seen], p.ends[1][:, draw.seen], p.body.radii)
        u = (draw.pixel % obs.K.width).float()
        v = torch.div(draw.pixel, obs.K.width, rounding_mode="floor").float()
        sd, h = silhouette.distances(out, u, v)
        near, least, nearest = silhouette.nearest(sd, losses.SOFT_PX)
        hypothetical = guess.stance[:, obs.at][:, :-1]
        stance = torch.where(hypothetical < 0, hypothetical, stance_weight * hypothetical)
        return State(
            obs=obs, kin=kin, body=p.body, q=p.q, R_root=p.R_root, shape=p.shape, tilt=x["tilt"], R_cam=p.R_cam,
            centre=p.centre, seen=draw.seen, u=u, v=v, pixel=draw.pixel, inside=draw.inside, out=out, sd=sd, h=h,
            near=near, least=least, nearest=nearest, ends=p.ends, stance=stance, x=x,
        )  # fmt: skip

    def loss(self, x: Variables, guess: Guess, draw: Draw, *, stance_weight: float = 0.0) -> tuple[Tensor, Variables]:
        """(H,) weighted sum, and each term before weighting."""
        state = self.state(x, guess, draw, stance_weight=stance_weight)
        parts = {name: term(state) for name, term in self.terms.items() if self.weights.get(name, 0) > 0}
        return sum((self.weights[k] * v for k, v in parts.items()), torch.zeros(len(guess.yaw))), parts


def _found(cumulative: Tensor, rows: Tensor, r: Tensor) -> Tensor:
    """(S, n) where r (S, n) in [0, 1] falls in some rows of cumulative probabilities (F, N), one row at a time: the
    table is large, and indexing would copy it."""
    return torch.stack([torch.searchsorted(cumulative[k], x) for k, x in zip(rows.tolist(), r, strict=True)])


def rank(
    problem: Problem, x: Variables, guess: Guess, *, draws: int = 4, frames: int = 32, pixels: int = 256
) -> Tensor:
    """(H,) loss on draws that are the same for every call."""
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        parts = [problem.loss(x, guess, problem.draw(frames, pixels, generator))[0] for _ in range(draws)]
    return torch.stack(parts).mean(0)


def pick(x: Variables, which: Tensor) -> Variables:
    """The variables of some hypotheses."""
    return {k: v[which].clone() for k, v in x.items()}


LATE = 0.3  # the part of a phase in which the late variables change
RATES = {"shape.log_length": 4e-3, "shape": 3e-2, "tilt": 2e-2, "Q": 4e-3, "G": 2e-3, "F": 4e-3, "F.background": 1e-2}


@dataclass(frozen=True)
class Schedule:
    """One phase of optimisation: Adam, cosine decay of the rates to a tenth; once more from the start for what is late.

    Attributes:
        iterations; frames and pixels of each draw; learn: prefixes of the variables that change.
        stance: weight of the hypothetical contacts at the start; it falls to 0 at two thirds.
        late: prefixes of the variables that change too, but in the last part only (`LATE` of the phase).
        rate: factor of every variable's rate.
    """

    iterations: int
    frames: int
    pixels: int
    learn: tuple[str, ...]
    stance: float = 0.0
    late: tuple[str, ...] = ()
    rate: float = 1.0


def rate(name: str) -> float:
    """Learning rate of a variable by its longest known prefix."""
    return RATES[max((k for k in RATES if name.startswith(k)), key=len)]


def learnt(x: Variables, learn: tuple[str, ...]) -> list[str]:
    """The variables that change, by name: Adam numbers its moments in this order, and a checkpoint keeps no other."""
    return [k for k in sorted(x) if k.startswith(learn)]


def adam(x: Variables, learn: tuple[str, ...]) -> torch.optim.Adam:
    groups = [{"params": [x[k].requires_grad_(True)], "lr": rate(k), "rate": rate(k)} for k in learnt(x, learn)]
    return torch.optim.Adam(groups, betas=(0.9, 0.98))


def optimise(
    problem: Problem, x: Variables, guess: Guess, schedule: Schedule, generator: torch.Generator, *,
    start: int = 0, adam_state: dict | None = None,
    each: Callable[[int, torch.optim.Adam, Tensor], None] = lambda i, optimiser, loss: None,
) -> Variables:  # fmt: skip
    """Run one phase from iteration `start`; `each(iterations done, optimiser, loss (H,))` is called after every step.

    Hypotheses share nothing, so the sum of their losses is minimised.
    """
    optimiser = adam(x, schedule.learn + schedule.late)
    late = [k.startswith(schedule.late) for k in learnt(x, schedule.learn + schedule.late)]
    early = schedule.iterations - round(LATE * schedule.iterations) if schedule.late else schedule.iterations
    if adam_state is not None:
        optimiser.load_state_dict(optimiser.state_dict() | {"state": adam_state})
    n = schedule.iterations
    for i in range(start, n):
        done = i / early if i < early else (i - early) / (n - early)
        decay = schedule.rate * (0.1 + 0.45 * (1 + np.cos(np.pi * done)))
        warm = min(1.0, (i + 1) / 10)
        for group, waits in zip(optimiser.param_groups, late, strict=True):
            group["lr"] = 0.0 if waits and i < early else group["rate"] * decay * warm
        draw = problem.draw(schedule.frames, schedule.pixels, generator)
        fade = schedule.stance * max(0.0, 1 - 1.5 * i / n)
        loss, _ = problem.loss(x, guess, draw, stance_weight=fade)
        optimiser.zero_grad(set_to_none=True)
        loss.sum().backward()
        optimiser.step()
        each(i + 1, optimiser, loss.detach())
    return {k: v.detach() for k, v in x.items()}
