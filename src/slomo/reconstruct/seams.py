"""Where the chunks of a long clip meet: legs that one calls left and the next right are put right, and so is a person
in place whom one sees from the front and the next from the back.

As a chunk begins with a body that stands, nothing tells its legs apart, and what the chunk shows later may come too
late for that: the legs would change places in the middle of a stand. Both chunks are right for some of the time. So
the legs of the one are exchanged from the seam to a moment at which they pass each other or are side by side, or all
through; which one, and up to when, is what the terms of the fit like best.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from slomo.reconstruct.hypotheses import as_guess, leg_pairs, turned_around
from slomo.reconstruct.problem import Problem, Variables, pick, rank
from slomo.reconstruct.run import Run, join
from slomo.reconstruct.trajectory import Guess, Trajectory

Array = np.ndarray
Tensor = torch.Tensor

OPPOSED = 0.6  # how far feet are from the mirrored ones of the other chunk's other side, over that of the same side
APART = 0.1  # body lengths between a foot in the one chunk and in the other, from which on it matters
MOMENTS = 6  # at which legs are most alike, tried
DRAWS = 12


@dataclass(frozen=True)
class Piece:
    """A chunk: its problem, its winner as a guess without corrections of joint angles, its first frame in the clip."""

    problem: Problem
    x: Variables
    guess: Guess
    first: int

    @property
    def frames(self) -> int:
        return self.guess.q.shape[1]

    def feet(self) -> Array:
        """(n, L, 3) body lengths in the root's frame, of every frame of the chunk."""
        shape = {k.removeprefix("shape."): v for k, v in self.x.items() if k.startswith("shape.")}
        length, kin = shape["log_length"].exp(), self.problem.kin
        with torch.no_grad():
            position, R, q = self.problem.path(self.x, self.guess, length, torch.arange(self.frames))
            away = kin.pose(shape, position, R, q).nodes[0, :, kin.contacts] - position[0, :, None]
        return (away @ R[0] / length).numpy()

    def exchanged(self, links: Tensor, first: int, last: int) -> Guess:
        """The guess with the angles of left and right `links` exchanged in the frames from `first` to before `last`."""
        q = self.guess.q.clone()
        q[:, first:last, links] = self.problem.kin.mirrored(self.guess.q)[:, first:last, links]
        return replace(self.guess, q=q)

    def moments(self, links: Tensor) -> list[int]:
        """Frames at which left and right `links` are most alike."""
        alike = (self.exchanged(links, 0, self.frames).q - self.guess.q)[0, :, links].abs().sum((1, 2)).numpy()
        inner = alike[1:-1]
        dips = 1 + np.flatnonzero((inner <= alike[:-2]) & (inner < alike[2:]))
        return sorted(dips[np.argsort(alike[dips], kind="stable")][:MOMENTS].tolist())


def one_way(
    problem_of: Callable[[int], Problem],
    paths: Sequence[Trajectory],
    runs: Sequence[Run],
    where: Sequence[tuple[int, int]],
) -> tuple[list[Run], list[dict[str, Any]]]:
    """The runs of a person with those turned around that face away from the others, or those others, whichever the fit
    minds less; and what was turned, for the report. From the front and from the back a person looks alike, and each
    chunk decides for itself.

    Args:
        paths: the motion of each chunk over its frames.
        problem_of, where: as `settle` takes them.
    """
    ahead = [_ahead(*own) for own in zip(paths, runs, strict=True)]
    away = [False]
    for n, (before, here) in enumerate(pairwise(ahead), 1):
        shared = where[n - 1][1] - where[n][0]
        opposed = np.median((before[-shared:] * here[:shared]).sum(1)) < 0
        away.append(away[-1] != bool(opposed))
    if not any(away):
        return list(runs), []
    turned, worse = [], []
    for n, run in enumerate(runs):
        piece = _piece(problem_of(n), run, where[n][0])
        x, guess = turned_around(piece.problem, piece.x, piece.guess)
        both = {k: torch.cat([piece.x[k], x[k]]) for k in x}
        loss = rank(piece.problem, both, join([piece.guess, guess]), draws=DRAWS)
        worse.append(piece.frames * float(loss[1] - loss[0]))
        turned.append(replace(run, x=x, guess=guess))
    cost = [sum(w for w, a in zip(worse, away, strict=True) if a == side) for side in (False, True)]
    side = cost[1] < cost[0]
    log = [{"turned_around": True, "chunk": n + 1} for n, a in enumerate(away) if a == side]
    return [t if a == side else r for r, t, a in zip(runs, turned, away, strict=True)], log


def _ahead(path: Trajectory, run: Run) -> Array:
    """(n, 2) unit vectors along which the body faces, of every frame of a chunk."""
    every = torch.arange(run.guess.yaw.shape[1])
    with torch.no_grad():
        _, R, _ = path(run.x, run.guess, run.x["shape.log_length"].exp(), every)
    return torch.nn.functional.normalize(R[0, :, :2, 0], dim=-1).numpy()


def settle(
    problem_of: Callable[[int], Problem], runs: Sequence[Run], where: Sequence[tuple[int, int]]
) -> tuple[list[Run], list[dict[str, Any]]]:
    """The runs with legs that agree where they meet, and what was exchanged, for the report.

    Args:
        problem_of: the problem of a chunk by its number.
        where: first frame and the one behind the last of each chunk.
    """
    out, log = list(runs), []
    before = None
    for n in range(1, len(runs)):
        before = before or _piece(problem_of(n - 1), out[n - 1], where[n - 1][0])
        here = _piece(problem_of(n), out[n], where[n][0])
        for name, links, feet in leg_pairs(here.problem.kin):
            if not _opposed(before, here, feet):
                continue
            late, guess, span = _best(before, here, links)
            piece = replace(here if late else before, guess=guess)
            before, here = (before, piece) if late else (piece, here)
            at = piece.problem.obs.t[[span[0], span[1] - 1]].tolist()
            log.append({"limbs": name, "exchanged_s": [round(s, 3) for s in at], "chunk": n + late})
        out[n - 1] = replace(out[n - 1], x=before.x, guess=before.guess)
        out[n] = replace(out[n], x=here.x, guess=here.guess)
        before = here
    return out, log


def _piece(problem: Problem, run: Run, first: int) -> Piece:
    x, guess = as_guess(problem, run.x, run.guess)
    return Piece(problem, x, guess, first)


def _opposed(a: Piece, b: Piece, feet: tuple[int, int]) -> bool:
    """Whether the two feet of a pair change places from the one chunk to the next."""
    shared = a.first + a.frames - b.first
    x, y = a.feet()[-shared:, feet], b.feet()[:shared, feet]
    mirrored = y[:, ::-1] * [1, -1, 1]
    same, other = (float(np.linalg.norm(x - z, axis=-1).mean()) for z in (y, mirrored))
    return same > APART and other < OPPOSED * same


def _best(a: Piece, b: Piece, links: Tensor) -> tuple[bool, Guess, tuple[int, int]]:
    """Whether the later chunk is changed, its guess with the legs exchanged, and in which of its frames."""
    shared = a.first + a.frames - b.first
    found = []
    for late, piece in ((False, a), (True, b)):
        n = piece.frames
        if late:
            spans = [(0, m) for m in (*piece.moments(links), n) if m >= shared]
        else:  # where it meets the chunk before it, legs stay as they are
            spans = [(m, n) for m in (0, *piece.moments(links)) if m <= n - shared and (m >= shared or a.first == 0)]
        guesses = [piece.guess, *(piece.exchanged(links, *span) for span in spans)]
        wide = pick(piece.x, torch.zeros(len(guesses), dtype=torch.long))
        loss = n * rank(piece.problem, wide, join(guesses), draws=DRAWS)
        found += [(float(v - loss[0]), late, g, s) for v, g, s in zip(loss[1:], guesses[1:], spans, strict=True)]
    _, late, guess, span = min(found, key=lambda f: f[0])
    return late, guess, span
