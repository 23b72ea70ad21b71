"""Legs of a pair that overtake each other look much like legs that meet, change names and part again: each takes two
short steps where one foot stands and the other one takes a long step."""

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from slomo.reconstruct.hypotheses import as_guess, exchanged, leg_pairs
from slomo.reconstruct.problem import Problem, Variables, rank
from slomo.reconstruct.sides import doubting, feet, unsettled
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

OPEN = 0.15  # share by which the loss may be higher with nothing fitted to it, to be tried
NEARER = 0.35  # of how far apart feet are in the median, by which they come nearer where they meet
_MOMENT = 0.02  # s, of which that is the mean


def overtaking(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with the legs of one pair exchanged from every other moment in which they meet to the next, by the
    pair's name, where the picture is hardly worse for it."""
    if len(problem.obs.at) < 3:
        return []
    judge, (x, plain) = doubting(unsettled(problem), 0.0), as_guess(problem, x, guess)
    t, own, out = problem.obs.t.numpy(), feet(problem, x, plain)[0].numpy(), []
    at = t[problem.obs.at.numpy()]
    limit = (1 + OPEN) * float(rank(judge, x, plain)[0])
    for name, links, pair in leg_pairs(problem.kin):
        _, other = exchanged(problem, x, plain, links)
        away = np.linalg.norm(own[:, pair] - feet(problem, x, other)[0].numpy()[:, pair], axis=-1).mean(-1)
        turns = every_other(away, float(np.diff(at).mean()))
        if turns is None:
            continue
        swapped = torch.as_tensor(np.interp(t, at, turns.astype(float)) > 0.5)
        rivals = []
        for where in (swapped, ~swapped):
            q = plain.q.clone()
            q[:, :, links] = torch.where(where[:, None, None], other.q[:, :, links], q[:, :, links])
            rivals.append(replace(plain, q=q))
        loss, best = min((float(rank(judge, x, rival)[0]), n) for n, rival in enumerate(rivals))
        if loss < limit:
            out.append((name, x, rivals[best]))
    return out


def every_other(away: Array, step: float) -> Array | None:
    """(F,) bool, the frames from every other moment in which two feet meet to the next; None where they do not twice.

    Args:
        away: (F,) by how much the feet move when their legs are exchanged.
        step: s from frame to frame.
    """
    away = gaussian_filter1d(away, _MOMENT / step)
    meetings, _ = find_peaks(-away, prominence=NEARER * np.median(away))
    return np.searchsorted(meetings, np.arange(len(away)), "right") % 2 > 0 if len(meetings) > 1 else None
