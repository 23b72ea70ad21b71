"""Legs of a pair that overtake each other look much like legs that meet, change names and part again: each takes two
short steps where one foot stands and the other one takes a long step. It shows: then the foot that is ahead after they
have met is the one that was ahead before, and in gaits it is the other one."""

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

OPEN = 0.25  # share by which the loss may be higher with nothing fitted to it, to be tried
NEARER = 0.35  # of how far apart feet are in the median, by which they come nearer where they meet
_MOMENT = 0.02  # s, of which that is the mean


def overtaking(problem: Problem, x: Variables, guess: Guess) -> list[tuple[str, Variables, Guess]]:
    """The motion with the legs of a pair exchanged in those stretches that make them overtake each other whenever they
    meet, and in all others, by the pair's name; where they do not yet, and where the picture is not much worse for it.
    """
    if len(problem.obs.at) < 3:
        return []
    judge, (x, plain) = doubting(unsettled(problem), 0.0), as_guess(problem, x, guess)
    t, own, out = problem.obs.t.numpy(), feet(problem, x, plain)[0].numpy(), []
    at = t[problem.obs.at.numpy()]
    with torch.no_grad():
        _, R, _ = problem.path(x, plain, x["shape.log_length"].exp(), problem.obs.at)
    forward, step = R[0, :, :, 0].numpy(), float(np.diff(at).mean())
    limit = (1 + OPEN) * float(rank(judge, x, plain)[0])
    for name, links, (left, right) in leg_pairs(problem.kin):
        _, other = exchanged(problem, x, plain, links)
        pair = [left, right]
        away = np.linalg.norm(own[:, pair] - feet(problem, x, other)[0].numpy()[:, pair], axis=-1).mean(-1)
        turns = taking_turns(away, ((own[:, left] - own[:, right]) * forward).sum(-1), step)
        if not turns.any():
            continue
        swapped = torch.as_tensor(np.interp(t, at, turns.astype(float)) > 0.5)
        for which, where in ((name, swapped), (f"{name}, the others", ~swapped)):
            q = plain.q.clone()
            q[:, :, links] = torch.where(where[:, None, None], other.q[:, :, links], q[:, :, links])
            rival = replace(plain, q=q)
            if float(rank(judge, x, rival)[0]) < limit:
                out.append((which, x, rival))
    return out


def taking_turns(away: Array, ahead: Array, step: float) -> Array:
    """(F,) bool, where the legs have to be exchanged for the other foot to be ahead after every moment in which the two
    meet, and for the same one as now at first.

    Args:
        away: (F,) by how much the feet move when their legs are exchanged.
        ahead: (F,) by how much the left one is ahead.
        step: s from frame to frame.
    """
    away = gaussian_filter1d(away, _MOMENT / step)
    meetings, _ = find_peaks(-away, prominence=NEARER * np.median(away))
    between = np.split(ahead, meetings)
    first = np.array([np.median(part) > 0 for part in between]) ^ (np.arange(len(between)) % 2 > 0)
    return np.repeat(first != first[0], [len(part) for part in between])
