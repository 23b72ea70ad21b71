"""Gaits laid over a body as it is, and which of them are worth a fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.reconstruct.hypotheses import GaitHypothesis
from slomo.reconstruct.problem import Problem, Variables, pick, rank
from slomo.reconstruct.run import join
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

AT_ONCE = 24  # gaits
SHORTLIST = 48  # of them that are ranked once more
NEXT = 1.5 / 12  # turns between a phase and those next to it, at most


@dataclass(frozen=True)
class Laid:
    """A gait over a body: the loss so far, the number of the heading that it is laid over, the gait, and both."""

    loss: float
    heading: int
    gait: GaitHypothesis
    guess: Guess


def lay(
    problem: Problem,
    x: Variables,
    heading: int,
    base: Guess,
    grid: Sequence[GaitHypothesis],
    pose: Callable[[GaitHypothesis], tuple[Array, Array]],
    each: Callable[[int], None],
) -> list[Laid]:
    """All gaits of a grid over one hypothesis.

    Args:
        x, base: of the hypothesis.
        pose: joint angles (T, B, 3) rad and contacts (T, L) of a gait.
        each: called with the number that are done.
    """
    f = lambda a: torch.as_tensor(np.stack(a), dtype=torch.float32)  # noqa: E731
    out = []
    for i in range(0, len(grid), AT_ONCE):
        part = grid[i : i + AT_ONCE]
        q, contact = zip(*(pose(g) for g in part), strict=True)
        same = torch.zeros(len(part), dtype=torch.long)
        guess = replace(base.pick(same), q=base.q + f(q), stance=f(contact))
        value = rank(problem, pick(x, same), guess, draws=1, frames=16, pixels=128)
        out += [
            Laid(float(v), heading, g, guess.pick(torch.tensor([n])))
            for n, (v, g) in enumerate(zip(value, part, strict=True))
        ]
        each(i)
    return out


def ranked(problem: Problem, x: Variables, entries: list[Laid]) -> list[Laid]:
    """The entries in order of their losses, the best of them once more with more draws: what is between one phase of a
    gait and the next is less than the noise of the few pixels that all are compared by, and from the wrong one of them
    the fit does not come back.

    Args:
        x: of all headings.
    """
    entries = sorted(entries, key=lambda e: e.loss)
    first = []
    for i in range(0, min(SHORTLIST, len(entries)), AT_ONCE):
        part = entries[i : min(i + AT_ONCE, SHORTLIST)]
        wide = pick(x, torch.tensor([e.heading for e in part]))
        value = rank(problem, wide, join([e.guess for e in part]), draws=2, frames=40)
        first += [replace(e, loss=float(v)) for v, e in zip(value, part, strict=True)]
    return sorted(first, key=lambda e: e.loss) + entries[SHORTLIST:]


def diverse(entries: list[Laid], count: int) -> list[Laid]:
    """The best entry of every gait, for what is laid over the body as it is may rank a wrong gait first in all its
    phases; then the best that differ in phase by a sixth, in frequency by a fifth, or in heading; and the best one's
    left-right opposite, so that a swap of the legs is always weighed against it, and the one whose phase is next to
    the best one's: laid over the clip the two are alike, and what is fitted from them is not."""

    def far(a: GaitHypothesis, b: GaitHypothesis) -> bool:
        return a.name != b.name or turn(a.phase, b.phase) > 1 / 6.5 or abs(math.log(a.frequency / b.frequency)) > 0.15

    firsts = {e.gait.name: e for e in reversed(entries)}
    out = sorted(firsts.values(), key=lambda e: e.loss)[:count]
    for e in entries:
        if len(out) == count:
            break
        if all(e.heading != o.heading or far(e.gait, o.gait) for o in out):
            out.append(e)
    if not out:
        return out
    best = out[0]
    others = [
        (turn(e.gait.phase, best.gait.phase), e) for e in entries
        if e.heading == best.heading and e.gait.name == best.gait.name and e.gait.frequency == best.gait.frequency
    ]  # fmt: skip
    near = [e for away, e in others if 1e-6 < away < NEXT]
    opposite = [e for away, e in others if abs(away - 0.5) < 1e-6]
    more = [found[0] for found in (near, opposite) if found]
    more = more[max(0, len(more) - count + 1) :]
    rest = [e for e in out if all(e is not m for m in more)]
    return rest[: count - len(more)] + more


def beside(labels: list[dict], strides: list[int]) -> list[int]:
    """Of the hypotheses `strides`, best first, which have a gait: the one that is the first but for a phase next to
    its own, if there is one."""

    def next_to(k: int) -> bool:
        own, best = labels[k], labels[strides[0]]
        same = all(own[key] == best[key] for key in ("heading", "gait", "stride_hz"))
        return same and turn(own["phase"], best["phase"]) < NEXT

    return [k for k in strides[1:] if next_to(k)][:1]


def turn(a: float, b: float) -> float:
    """By how much two phases of a stride differ, in turns: 0 to 0.5."""
    return abs((a - b + 0.5) % 1.0 - 0.5)
