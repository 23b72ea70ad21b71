"""Legs of a pair that overtake each other look much like legs that meet, change names and part again: each takes two
short steps where one foot stands and the other one takes a long step. Feet that do so speed up and slow down more."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from slomo.reconstruct.hypotheses import as_guess, exchanged, leg_pairs
from slomo.reconstruct.problem import Problem, Variables, rank
from slomo.reconstruct.sides import OPEN, doubting, feet, unsettled
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

STEADIER = 0.9  # times the accelerations, from which on feet that change names are worth a fit
_MEET, _STEADY = 0.05, 0.067  # s: of what moments of meeting and accelerations are the mean
_ROUNDS = 6  # in which names are looked for; three have been enough


def overtaking(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with the legs of one pair exchanged from some moments in which they meet to others, by the pair's
    name, where feet are steadier for it and the picture hardly worse."""
    if len(problem.obs.at) < 3:
        return []
    judge, (x, plain) = doubting(unsettled(problem)), as_guess(problem, x, guess)
    t, own, out = problem.obs.t.numpy(), feet(problem, x, plain)[0].numpy(), []
    at = t[problem.obs.at.numpy()]
    limit = (1 + OPEN) * float(rank(judge, x, plain)[0])
    for name, links, pair in leg_pairs(problem.kin):
        _, other = exchanged(problem, x, plain, links)
        names = changes(
            np.stack([own[:, pair], feet(problem, x, other)[0].numpy()[:, pair]]), float(np.diff(at).mean())
        )
        if names is None:
            continue
        swapped = torch.as_tensor(np.interp(t, at, names.astype(float)) > 0.5)
        rivals = []
        for where in (swapped, ~swapped):
            q = plain.q.clone()
            q[:, :, links] = torch.where(where[:, None, None], other.q[:, :, links], q[:, :, links])
            rivals.append(replace(plain, q=q))
        loss, best = min((float(rank(judge, x, rival)[0]), n) for n, rival in enumerate(rivals))
        if loss < limit:
            out.append((name, x, rivals[best]))
    return out


def changes(paths: Array, step: float) -> Array | None:
    """(F,) bool, the frames in which two feet exchange their names so that they are steadiest; None where that gains
    too little. Names change only where the feet meet.

    Args:
        paths: (2, F, 2, 3) of both feet, as they are and with their legs exchanged.
        step: s from frame to frame.
    """
    between = gaussian_filter1d(np.linalg.norm(paths[0] - paths[1], axis=-1).mean(-1), _MEET / step)
    least = (between[1:-1] <= between[:-2]) & (between[1:-1] < between[2:])
    near = between[1:-1] < (np.median(between) + between.min()) / 2
    span = np.zeros(len(between), int)
    span[1:-1] = np.cumsum(least & near)
    span[-1] = span[-2]

    def accelerations(swapped: Array) -> float:
        path = np.where(swapped[span][:, None, None], paths[1], paths[0])
        smooth = gaussian_filter1d(path, _STEADY / step, axis=0)
        return float((np.diff(smooth, n=2, axis=0) ** 2).sum(-1).mean())

    best = np.zeros(span[-1] + 1, bool)
    own = least_so_far = accelerations(best)
    for _ in range(_ROUNDS):
        before = least_so_far
        for first, end in combinations(range(len(best) + 1), 2):
            other = best.copy()
            other[first:end] ^= True
            if (value := accelerations(other)) < least_so_far:
                best, least_so_far = other, value
        if least_so_far == before:
            break
    return best[span] if least_so_far < STEADIER * own else None
