"""Which leg of a pair is the left one, once everything else has been found.

A pair of legs exchanged is the next minimum: all four legs lie on legs, and which of two that overlap is the nearer one
is seen only in the flow and the outline where they pass. Networks see it, too, but what misleads them in one frame
misleads them in the next, so that a hundred of their frames weigh little more than one, while the errors of the picture
are other ones in every frame.
"""

import math
from dataclasses import replace

import torch

from slomo.reconstruct.hypotheses import as_guess, exchanged, leg_pairs
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.problem import Problem, Variables, rank
from slomo.reconstruct.state import State
from slomo.reconstruct.trajectory import Guess

BELIEVED = 1 / 3  # share of their weight that networks keep where fitted motions are compared
OPEN = 0.1  # share by which the loss may be higher with a pair exchanged and nothing fitted to it, to be tried
APART = 0.02  # body lengths between the feet, on average: legs that stand side by side are the same exchanged
MOMENT = 0.3  # s before and after the moment in which a pair of limbs changes places
CHANGED = math.radians(60)  # by which a pair's joints must move less in sum, mirrored, to have changed places
_SIDED = ("keypoints", "parts", "surface")


def doubting(problem: Problem, share: float = BELIEVED) -> Problem:
    """The problem by which fitted motions are compared: what networks say of joints, parts and surface has a `share` of
    its weight. Key points of the user's own keep theirs."""
    said, mirror = problem.said, torch.tensor(problem.kin.skeleton.mirror)
    own = said is not None and bool((mirror[said.node] != said.node)[said.alone].any())  # theirs have a side for sure
    sided = [k for k in _SIDED if not (own and k == "keypoints")]
    return replace(problem, weights={k: w * (share if k in sided else 1) for k, w in problem.weights.items()})


def unsettled(problem: Problem) -> Problem:
    """The problem before its last phase: legs may cross while nobody knows whose is whose, which shows where they are
    seen; and a body that leans may find a way to a motion that an upright one does not."""
    return replace(problem, weights={**problem.weights, "crossed": 0.0, "upright": 0.0})


def exchanged_pairs(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with one pair of legs exchanged, by the pair's name, wherever that is another motion and hardly
    worse; and where a pair is crossed, with the two where they are seen, uncrossed."""
    judge, kin = doubting(unsettled(problem)), problem.kin
    pairs, state, limit = leg_pairs(kin), _posed(problem, x, guess), (1 + OPEN) * float(rank(judge, x, guess)[0])
    out = []
    for (name, links, _), by in zip(pairs, kin.crossing(state.body, state.R_root).mean((0, 1)).tolist(), strict=True):
        other = exchanged(problem, x, guess, links)
        apart = (feet(problem, *other) - feet(problem, x, guess)).norm(dim=-1).mean()
        if apart > APART and float(rank(judge, *other)[0]) < limit:
            out.append((name, *other))
        if by > APART:
            out.append((f"{name}, uncrossed", *exchanged(problem, x, guess, links, in_place=True)))
    return out


def kept_apart(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with a pair of limbs that change places in it kept apart: exchanged before the moment in which the
    left one takes the right one's place and the other way round, and, another motion, after it."""
    x, guess = as_guess(problem, x, guess)
    t, kin, out = problem.obs.t, problem.kin, []
    if len(t) < 2:
        return out
    reach = max(1, round(MOMENT / float((t[1:] - t[:-1]).median())))
    for name, links in _paired_links(kin):
        q, other = guess.q[0][:, links], kin.mirrored(guess.q)[0][:, links]
        now, later = q[: -2 * reach], slice(2 * reach, None)
        changed = (now - q[later]).abs().sum((1, 2)) - (now - other[later]).abs().sum((1, 2))
        if not len(changed) or changed.max() < CHANGED:
            continue
        at = int(changed.argmax()) + reach
        for when, swapped in (("before", torch.arange(len(t)) < at), ("after", torch.arange(len(t)) >= at)):
            new = torch.where(swapped[:, None, None], other, q)
            share = torch.linspace(0, 1, 2 * reach + 1)[:, None, None]
            new[at - reach : at + reach + 1] = torch.lerp(new[at - reach], new[at + reach], share)
            whole = guess.q.clone()
            whole[0, :, links] = new
            out.append((f"{name} {when} {float(t[at]):.2f} s", x, replace(guess, q=whole)))
    return out


def _paired_links(kin: Kinematics) -> list[tuple[str, torch.Tensor]]:
    """Every pair of limbs, arms as well as legs, by the joint where it begins: the links of both sides."""
    out = []
    for first in range(1, kin.B):
        pair = {first, int(kin.mirror[first])}
        trunk = int(kin.link[first])
        if min(pair) < first or len(pair) == 1 or int(kin.mirror[trunk]) != trunk:
            continue
        links: set[int] = set()
        for link in range(1, kin.B):  # what they hang from comes before them
            if link in pair or int(kin.link[link]) in links:
                links.add(link)
        name = kin.skeleton.names[first].replace("left", "").replace("right", "").strip("_")
        out.append((name, torch.tensor(sorted(links))))
    return out


def feet(problem: Problem, x: Variables, guess: Guess) -> torch.Tensor:
    """(H, F, L, 3) of every fit frame, body lengths of each hypothesis."""
    body = _posed(problem, x, guess).body
    return body.nodes[:, :, problem.kin.contacts] / body.length[:, None, None, None]


def _posed(problem: Problem, x: Variables, guess: Guess) -> State:
    with torch.no_grad():
        return problem.state(x, guess, problem.draw(1, 2, torch.Generator().manual_seed(0)), stance_weight=0.0)
