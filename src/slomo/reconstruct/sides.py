"""Which leg of a pair is the left one, once everything else has been found.

A pair of legs exchanged is the next minimum: all four legs lie on legs, and which of two that overlap is the nearer one
is seen only in the flow and the outline where they pass. Networks see it, too, but what misleads them in one frame
misleads them in the next, so that a hundred of their frames weigh little more than one, while the errors of the picture
are other ones in every frame.
"""

from dataclasses import replace

import torch

from slomo.reconstruct.hypotheses import exchanged, leg_pairs
from slomo.reconstruct.problem import Problem, Variables, rank
from slomo.reconstruct.trajectory import Guess

BELIEVED = 1 / 3  # share of their weight that networks keep where fitted motions are compared
OPEN = 0.1  # share by which the loss may be higher with a pair exchanged and nothing fitted to it, to be tried
APART = 0.02  # body lengths between the feet, on average: legs that stand side by side are the same exchanged
_SIDED = ("keypoints", "parts", "surface")


def doubting(problem: Problem) -> Problem:
    """The problem by which fitted motions are compared: what networks say of joints, parts and surface has less weight.
    Key points of the user's own keep theirs."""
    said, mirror = problem.said, torch.tensor(problem.kin.skeleton.mirror)
    own = said is not None and bool((mirror[said.node] != said.node)[said.alone].any())  # theirs have a side for sure
    sided = [k for k in _SIDED if not (own and k == "keypoints")]
    return replace(problem, weights={k: w * (BELIEVED if k in sided else 1) for k, w in problem.weights.items()})


def exchanged_pairs(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with one pair of legs exchanged, by the pair's name, wherever that is another motion and hardly
    worse."""
    judge = doubting(problem)
    limit = (1 + OPEN) * float(rank(judge, x, guess)[0])
    found = [(name, *exchanged(problem, x, guess, links)) for name, links, _ in leg_pairs(problem.kin.skeleton)]
    feet = _feet(problem, x, guess)
    found = [f for f in found if (_feet(problem, *f[1:]) - feet).norm(dim=-1).mean() > APART]
    return [(name, y, other) for name, y, other in found if float(rank(judge, y, other)[0]) < limit]


def _feet(problem: Problem, x: Variables, guess: Guess) -> torch.Tensor:
    """(F, L, 3) of every fit frame, body lengths."""
    with torch.no_grad():
        state = problem.state(x, guess, problem.draw(1, 2, torch.Generator().manual_seed(0)), stance_weight=0.0)
    return (state.body.nodes[:, :, problem.kin.contacts] / state.body.length)[0]
