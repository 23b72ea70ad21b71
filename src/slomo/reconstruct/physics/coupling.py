"""Coordinate descent between the picture and the physics (PPR, Yang et al. 2023, sec. 3.3): the fit's side of it.

A round takes the fitted motion, learns controls with which the simulated body follows it, and hands the simulated
motion back as one more term of the fit: the body is drawn towards a motion that gravity, friction and the ground allow.
"""

from collections.abc import Mapping

import numpy as np
import torch

from slomo.reconstruct.outcome import own_length, stood
from slomo.reconstruct.physics.learn import FOOT_WEIGHT, Learner, PhysicsConfig, Simulated, Variables
from slomo.reconstruct.physics.model import Body, Mechanics, build
from slomo.reconstruct.physics.windows import Kinematic
from slomo.reconstruct.problem import Problem
from slomo.reconstruct.problem import Variables as FitVariables
from slomo.reconstruct.state import State, Term
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

NEAR = 0.02  # body lengths: the term pulls towards the simulated motion in proportion up to there, and then evenly


class Physics:
    """What stays between the rounds of one clip: the learned variables, as plain arrays in `arrays`.

    `metres`: the body length that the result will be given (withers to tail base, or standing height).
    """

    def __init__(self, problem: Problem, metres: float, config: PhysicsConfig, mechanics: Mechanics | None = None):
        self.problem, self.metres, self.config = problem, metres, config
        self.mechanics = mechanics or Mechanics()
        self._variables: Variables | None = None
        self._base: Kinematic | None = None

    def arrays(self) -> dict[str, Array]:
        """The state, for a checkpoint."""
        if self._variables is None or self._base is None:
            return {}
        learned = {f"learned.{k}": v.numpy().copy() for k, v in self._variables.items()}
        return learned | {f"base.{k}": v for k, v in vars(self._base).items()}

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Go on from `arrays()`."""
        part = lambda name: {k.removeprefix(name): np.array(v) for k, v in arrays.items() if k.startswith(name)}  # noqa: E731
        self._variables = {k: torch.from_numpy(v) for k, v in part("learned.").items()} or None
        self._base = Kinematic(**part("base.")) if arrays else None

    def round(self, x: FitVariables, guess: Guess) -> tuple[Simulated, float]:
        """Learn to follow the motion of one hypothesis, and simulate it.

        Returns:
            The simulated motion in metres, and metres per world unit of the fit.
        """
        body, kinematic, unit = self.body(x, guess)
        mirror = self.problem.kin.skeleton.mirror[: len(body.parent)]
        c, later = self.config, int(self._variables is not None)
        if not later:
            self._base = kinematic
        learner = Learner(body, kinematic, mirror, c, base=self._base)
        high, low = c.assistance
        n = c.iterations[later]
        falling = high * (low / high) ** np.clip(2 * np.arange(n) / n, 0, 1)
        start = learner.start() if self._variables is None else self._variables
        self._variables, losses = learner.learn(start, np.full(n, low) if later else falling, rate=c.rate[later])
        simulated = learner.simulate(self._variables, low)
        simulated.report["loss"] = [round(losses[0], 3), round(min(losses), 3)]
        return simulated, unit

    def body(self, x: FitVariables, guess: Guess) -> tuple[Body, Kinematic, float]:
        """The mechanical body of the fitted shape, the fitted motion at every frame, and metres per world unit."""
        problem, skeleton = self.problem, self.problem.kin.skeleton
        shape = {k.removeprefix("shape."): v.detach() for k, v in x.items() if k.startswith("shape.")}
        # With the feet held where they stand: feet that slide cannot be followed.
        posed, stands, q = stood(problem, x, guess)
        unit = self.metres / own_length(problem, shape)
        f = lambda v: v[0].numpy().astype(float)  # noqa: E731
        body = build(skeleton, posed, unit=unit, mechanics=self.mechanics)
        t = problem.obs.t.numpy().astype(float)
        nodes = f(posed.nodes)
        contact = np.zeros(nodes.shape[:2])
        contact[:, list(skeleton.contacts)] = stands
        kinematic = Kinematic(t, nodes[:, 0] * unit, f(posed.R)[:, 0], f(q), nodes * unit, contact)
        return body, kinematic, unit


def term(simulated: Simulated, unit: float, problem: Problem) -> Term:
    """Distance of the posed body's nodes to the simulated ones at the fit frames, feet weighed more, in `NEAR`; robust,
    and nothing where the simulation did not follow. `unit`: metres per world unit."""
    at = problem.obs.at.numpy()
    nodes = torch.as_tensor(simulated.nodes[at] / unit, dtype=torch.float32)
    trust = torch.as_tensor(simulated.trust[at], dtype=torch.float32)[:, None]
    heavy = torch.ones(nodes.shape[1])
    heavy[list(problem.kin.skeleton.contacts)] = FOOT_WEIGHT
    share = trust * heavy / heavy.sum() / len(at)

    def physics(s: State) -> torch.Tensor:
        e = (s.body.nodes - nodes).square().sum(-1) / (NEAR * s.body.length[:, None, None]).square()
        return ((2 * (1 + e).sqrt() - 2) * share).sum((1, 2))

    return physics
