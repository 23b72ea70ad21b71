"""What is learned of the physics: controls and parameters with which the simulated body follows the kinematic one."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from slomo.gravity import GRAVITY
from slomo.reconstruct.physics.model import Body
from slomo.reconstruct.physics.rollout import Controls, RollOut, Watched
from slomo.reconstruct.physics.windows import Guides, Kinematic, Windows, cover, guides

Array = np.ndarray
Tensor = torch.Tensor
Variables = dict[str, Tensor]

FOOT_WEIGHT = 3.0  # of a foot's place against another node's
STANDS = 4.0  # how much more a height counts where a foot stands
CLIP = 3.0  # largest gradient of a window, in units of the variables' spread


@dataclass(frozen=True)
class PhysicsConfig:
    """How the physics is simulated and learned.

    Attributes:
        window, overlap: of windows, and knot: between the knots of the controllers' corrections, in the time in which
            the body falls over, sqrt(root height / g): 0.21 s for a dog of 0.5 m, 0.3 s for a person.
        dt: s of a step at most.
        iterations: of Adam in the first round and in each later one. rate: of Adam likewise, in units of the variables'
            spread.
        assistance: share of the pull on the root at the first iteration, and the one at the end. It falls
            geometrically over the first half of the first round.
    """

    window: float = 2.4
    overlap: float = 0.8
    knot: float = 0.45
    dt: float = 0.004
    iterations: tuple[int, int] = (150, 40)
    rate: tuple[float, float] = (0.1, 0.02)
    assistance: tuple[float, float] = (0.3, 0.003)


# What one unit of a variable changes: rad, and in body lengths and sqrt(length / g) what has a dimension.
SPREAD = {
    "knots": 0.15, "position": 0.02, "turn": 0.05, "velocity": 0.1, "spin": 0.3, "log_ke": 0.5, "log_kd": 0.5,
    "log_mass": 0.2, "log_size": 0.15,
}  # fmt: skip
SHARED = ("log_ke", "log_kd", "log_mass", "log_size")


@dataclass(frozen=True)
class Simulated:
    """A simulated trajectory at the kinematic's T moments. Metres, newtons.

    Attributes:
        nodes: (T, M, 3) m. force: (T, F, 3) N of the ground on each foot, mean over the time from moment to moment.
        trust: (T,) in [0, 1], 0 where the simulation did not follow (it fell, is not finite, or is just far off).
        report: figures for the eye.
    """

    nodes: Array
    force: Array
    trust: Array
    report: dict[str, Any] = field(default_factory=dict)


class Learner:
    """Follows one kinematic trajectory with one body.

    What is learned are corrections to a trajectory `base`, the kinematic one of the first round: when the trajectory
    that is followed changes between rounds, the simulated one, which is unstable, does not.

    Args:
        mirror: (B,) link on the other side. base: default `kinematic`.
    """

    def __init__(
        self, body: Body, kinematic: Kinematic, mirror: Array, config: PhysicsConfig, *,
        base: Kinematic | None = None, device: str = "cpu",
    ):  # fmt: skip
        self.body, self.kinematic, self.config = body, kinematic, config
        # Of the first round's: what is learned is for its windows, and the body's height changes between rounds.
        height = np.median((base or kinematic).position[:, 2]).clip(0.1 * body.length)
        c, pace = config, float(np.sqrt(height / GRAVITY))
        self.windows: Windows = cover(
            kinematic.t, length=c.window * pace, overlap=c.overlap * pace, dt=c.dt, knot=c.knot * pace
        )
        self.guides: Guides = guides(kinematic, self.windows)
        self.base: Guides = guides(base, self.windows) if base else self.guides
        self.roll = RollOut(body, self.windows.step, steps=self.windows.steps, dt=self.windows.dt, device=device)
        self.mirror = torch.as_tensor(mirror)
        here = torch.as_tensor(self.windows.frame >= 0, dtype=torch.float32)
        heavy = torch.ones(len(body.link))
        heavy[body.contact_node[body.contact_node >= 0]] = FOOT_WEIGHT
        self.share = (here / here.sum(1, keepdim=True))[..., None] * heavy / heavy.sum()

    def start(self) -> Variables:
        """Zeros: the kinematic trajectory itself, and the body as built."""
        N, K, B = self.windows.count, self.windows.basis.shape[1], len(self.body.parent)
        sizes = dict(
            knots=(N, K, B, 3), position=(N, 3), turn=(N, 3), velocity=(N, 3), spin=(N, 3), log_ke=(), log_kd=(),
            log_mass=(B,), log_size=(),
        )  # fmt: skip
        return {k: torch.zeros(s) for k, s in sizes.items()}

    def controls(self, x: Mapping[str, Tensor], assistance: float) -> Controls:
        """What the variables say, in SI units."""
        body, g, m, N = self.body, self.base, self.body.mechanics, self.windows.count
        L, pace = body.length, float(np.sqrt(body.length / GRAVITY))
        s = {k: SPREAD[k] * v for k, v in x.items()}
        bend = torch.einsum("sk,nkbi->nsbi", self.windows.basis, s["knots"])
        turn = _quaternion(s["turn"])
        mass = (s["log_mass"] + s["log_mass"][self.mirror]).mul(0.5).exp()
        wide = lambda v: v.expand(N)  # noqa: E731
        return Controls(
            target=g.q + bend,
            position=g.position[:, 0] + L * s["position"],
            quaternion=_product(turn, g.quaternion[:, 0]),
            velocity=g.velocity + L / pace * s["velocity"],
            spin=g.spin + s["spin"] / pace,
            mass_scale=mass.expand(N, -1),
            ke=wide(m.ke * body.weight / L * s["log_ke"].exp()),
            kd=wide(m.kd / (L / pace) * s["log_kd"].exp()),
            # A larger body is the same body at a slower time: less gravity at the given size.
            gravity=wide(GRAVITY * (-s["log_size"]).exp()),
            assistance=torch.full((N,), assistance),
            guide_position=self.guides.position,
            guide_quaternion=self.guides.quaternion,
        )  # fmt: skip

    def distance(self, nodes: Tensor) -> Tensor:
        """(N,) of each window: mean distance to the kinematic nodes, robust, in 5 % of the body length. The height of a
        foot that stands counts more: else a body whose feet slide is followed by shuffling."""
        e = (nodes - self.guides.nodes).square()
        e = e.sum(-1) + (STANDS**2 - 1) * self.guides.contact * e[..., 2]
        e = e / (0.05 * self.body.length) ** 2
        return ((2 * (1 + e / 2).sqrt() - 2) * self.share).sum((1, 2))

    def effort(self, x: Mapping[str, Tensor]) -> Tensor:
        """(N,) of each window: corrections that are large, or change fast, and parameters away from the known."""
        k = x["knots"]
        own = 0.02 * k.square().sum(-1).mean((1, 2))
        if k.shape[1] > 2:
            own = own + 0.02 * (k[:, 2:] - 2 * k[:, 1:-1] + k[:, :-2]).square().sum(-1).mean((1, 2))
        own = own + 0.01 * sum(x[n].square().sum(-1) for n in ("position", "turn", "velocity", "spin"))
        return own + 0.01 * sum(x[n].square().mean() for n in SHARED)

    def learn(self, x: Variables, assistance: Array, *, rate: float) -> tuple[Variables, list[float]]:
        """One iteration of Adam from x for each entry of `assistance`.

        Returns:
            The best variables met with the last assistance, and the mean loss of the windows before each iteration and
            at the end.
        """
        x = {k: v.detach().clone().requires_grad_() for k, v in x.items()}
        optimiser = torch.optim.Adam(x.values(), lr=rate, betas=(0.9, 0.95))
        losses, best, kept = [], np.inf, x
        n = len(assistance)
        for i in range(n + 1):
            with torch.set_grad_enabled(i < n):
                share = float(assistance[min(i, n - 1)])
                loss = self.distance(self.roll(self.controls(x, share))) + self.effort(x)
            losses.append(float(loss.detach().nan_to_num(100.0).mean()))
            if share == assistance[-1] and losses[-1] < best:
                best, kept = losses[-1], {k: v.detach().clone() for k, v in x.items()}
            if i == n:
                break
            for group in optimiser.param_groups:
                group["lr"] = rate * (0.15 + 0.425 * (1 + np.cos(np.pi * i / n)))
            optimiser.zero_grad()
            # A window whose simulation broke must not spoil what all share.
            torch.where(torch.isfinite(loss), loss, 0.0).sum().backward()
            _tame(x)
            optimiser.step()
        return kept, losses

    def simulate(self, x: Variables, assistance: float) -> Simulated:
        """The roll-out as it is, its windows blended."""
        with torch.no_grad():
            nodes = self.roll(self.controls(x, assistance))
            e = (nodes - self.guides.nodes).norm(dim=-1) / self.body.length
        return self._blended(nodes.numpy().astype(float), e.numpy(), self.roll.watched(), assistance)

    def _blended(self, nodes: Array, error: Array, seen: Watched, assistance: float) -> Simulated:
        w, body, T = self.windows, self.body, len(self.kinematic.t)
        here = w.frame >= 0
        mean = np.array([np.nanmean(np.where(np.isfinite(e[h]), e[h], 9.0)) for e, h in zip(error, here, strict=True)])
        trust = np.clip((LOST - mean) / (LOST - FOLLOWED), 0, 1)
        good = trust > 0
        feet = np.flatnonzero(body.contact_node >= 0)
        feet = feet[np.argsort(body.contact_node[feet])]
        force = np.nan_to_num(seen.force[:, :, feet])
        total = np.concatenate([np.zeros_like(force[:, :1]), force.cumsum(1)], 1)
        half = 0.5 * np.median(np.diff(self.kinematic.t)) / w.dt
        low, high = (np.clip(np.rint(w.step + s * half), 0, w.steps).astype(int) for s in (-1, 1))
        rows = np.arange(w.count)[:, None]
        force = (total[rows, high] - total[rows, low]) / np.maximum(high - low, 1)[..., None, None]
        safe = np.where(good[:, None, None, None], np.nan_to_num(nodes), self.guides.nodes.numpy())
        wrench = np.linalg.norm(seen.wrench[:, :, 0], axis=-1)
        report = {
            "windows": w.count,
            "lost_windows": int((~good).sum()),
            "error_pct": [round(100 * float(m), 2) for m in mean],
            "assistance": assistance,
            "assisting_force_of_weight": round(float(np.nanmean(wrench[good])) / body.weight, 4)
            if good.any()
            else None,
        }
        shared = w.merge(np.broadcast_to(trust[:, None], w.frame.shape), T)
        return Simulated(w.merge(safe, T), w.merge(force, T), shared, report)


# Mean distance of a window's nodes from the kinematic ones, body lengths: up to the first it followed, from the second
# on it is not trusted at all.
FOLLOWED, LOST = 0.01, 0.03


def _tame(x: Variables) -> None:
    """Clip the gradient of each window to `CLIP`, and of what all share."""
    own = [v for k, v in x.items() if k not in SHARED]
    norm = sum(_gradient(v).square().flatten(1).sum(1) for v in own).sqrt()  # pyright: ignore[reportAttributeAccessIssue]
    for v in own:
        g = _gradient(v)
        bad = ~torch.isfinite(norm)
        g.mul_((CLIP / norm.clamp(min=CLIP)).reshape(-1, *[1] * (g.dim() - 1)))
        g[bad] = 0
    for k in SHARED:
        g = _gradient(x[k])
        g.nan_to_num_(0.0, 0.0, 0.0).clamp_(-CLIP, CLIP)


def _gradient(v: Tensor) -> Tensor:
    assert v.grad is not None
    return v.grad


def _quaternion(rotation: Tensor) -> Tensor:
    """(..., 4) xyzw of small rotation vectors (..., 3)."""
    return torch.nn.functional.normalize(torch.cat([rotation / 2, torch.ones_like(rotation[..., :1])], -1), dim=-1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """(..., 4) a b of quaternions xyzw."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    v = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([v, aw * bw - (av * bv).sum(-1, keepdim=True)], -1)
