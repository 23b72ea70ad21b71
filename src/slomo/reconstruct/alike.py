"""Strides that are alike: when a leg swings that is hidden for a while the picture does not say, other strides do, or
the other leg of the pair.

A gallop's far front leg passes behind the near one, and a fit that has it swing too early there is as good by the
picture as the right one. Where the leg is seen, in the next stride, it is not: laid over the strides that show the leg
the wrong swing costs much, and the right one laid over those that hide it costs nothing. So every stride of a limb may
be done as another one was: the cheapest choice by what is seen and by how unlike the strides are.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from slomo.reconstruct import limb_track, sides
from slomo.reconstruct.hypotheses import as_guess
from slomo.reconstruct.kinematics import limb_links
from slomo.reconstruct.pose_track import smooth
from slomo.reconstruct.problem import Problem, Variables
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

UNLIKE = 0.01  # cost, in units of the weighted loss of a frame, of strides that are a radian apart
MOST = 0.5  # rad: strides that are further apart than this are not meant to be alike
LEAST = 0.15  # rad: a stride that is nearer to the other than this stays what it is
TEMPLATES = 8  # strides at most that others may be done as
AS_LIKE = 1.15  # times as unlike as after the best period: a shorter one that is no worse is the stride
OFF = 0.25  # share by which the stride period may differ from a given one
ALOFT = 0.12  # body lengths: a paw that is higher for all but `LOW` of the time hardly ever comes down
LOW = 0.25
_PHASES = 8  # places in a stride at which it may be cut
_LAGS = 12  # times of a stride at which a leg may do what the other one does


def borrowed(
    problem: Problem, x: Variables, guess: Guess, *, clock: Array, frequencies: Sequence[float]
) -> tuple[Variables, Guess] | None:
    """One hypothesis with its strides done as others of them where that is as good, as a guess with no corrections to
    it; None when all stay what they are.

    Args:
        clock: (T,) s that strides keep, at the clip's times.
        frequencies: that strides may have, Hz of the clock, roughly.
    """
    x, guess = as_guess(problem, x, guess)
    q = guess.q[0].numpy().astype(float)
    limbs = [limb_links(problem.kin.skeleton, limb) for limb in problem.kin.skeleton.limbs]
    period = _period(q[:, sorted({j for chain in limbs for j in chain}), 1], clock, frequencies)
    if period is None:
        return None
    changes = [_of_limb(problem, x, guess, q, clock, period, chain) for chain in limbs]
    if not any(change.any() for change in changes):
        return None
    step = int(problem.obs.at[1] - problem.obs.at[0])
    for chain, change in zip(limbs, changes, strict=True):
        q[:, chain] += smooth(change, 2 * step + 1).reshape(len(q), -1, 3)
    return x, replace(guess, q=torch.as_tensor(q, dtype=torch.float32)[None])


def as_the_other(
    problem: Problem, x: Variables, guess: Guess, *, clock: Array, frequencies: Sequence[float]
) -> tuple[Variables, Guess] | None:
    """One hypothesis in which a leg that hardly ever comes down does as the one of the other side, at that time of the
    stride at which it is seen best, as a guess with no corrections to it; None where all legs come down, or a pair has
    none that does. A leg that is laid into a large head, say, covers it, and finds no way back.

    Args:
        clock, frequencies: as of `borrowed`.
    """
    kin = problem.kin
    x, guess = as_guess(problem, x, guess)
    height = np.quantile(sides.feet(problem, x, guess)[0, :, :, 2].numpy() - kin.skeleton.sole, LOW, axis=0)
    limbs = [limb_links(kin.skeleton, limb) for limb in kin.skeleton.limbs]
    lost = [a for pair in kin.pairs.tolist() for a, b in (pair, pair[::-1]) if height[b] < ALOFT < height[a]]
    q = guess.q[0].numpy().astype(float)
    stand = sorted({j for n, chain in enumerate(limbs) if height[n] < ALOFT for j in chain})
    period = _period(q[:, stand, 1], clock, frequencies) if lost else None
    if period is None:
        return None
    mirrored, at = kin.mirrored(guess.q)[0].numpy(), problem.obs.at.numpy()
    for leg in lost:
        own = mirrored[:, limbs[leg]]
        then = clock[:, None] - period * np.arange(_LAGS) / _LAGS
        then = np.where(then < clock[0], then + period, then)
        done = _at(own.reshape(len(q), -1), clock, then).reshape(len(q), _LAGS, -1, 3)
        cost = limb_track.costs(problem, x, guess, limbs[leg], done[at]).mean(0)
        q[:, limbs[leg]] = done[:, int(cost.argmin())]
    return x, replace(guess, q=torch.as_tensor(q, dtype=torch.float32)[None])


def _period(flexion: Array, clock: Array, frequencies: Sequence[float]) -> float | None:
    """s of the clock after which the legs' flexion (T, J) is most like before: the shortest of those after which it is
    about as much so. None where there are not two such strides."""
    about = np.concatenate([np.zeros(0), *(np.linspace((1 - OFF) / f, (1 + OFF) / f, 81) for f in frequencies)])
    about = np.sort(about[about <= (clock[-1] - clock[0]) / 2])
    if not len(about):
        return None
    unlike = []
    for period in about:
        then = clock[clock <= clock[-1] - period] + period
        unlike.append(float(np.abs(_at(flexion, clock, then) - flexion[: len(then)]).mean()))
    low = np.array(unlike)
    first = np.flatnonzero(low <= AS_LIKE * low.min())[0]
    near = low[: np.searchsorted(about, 1.1 * about[first], "right")]
    return float(about[int(near.argmin())])


def _at(motion: Array, clock: Array, then: Array) -> Array:
    """(..., D) of a motion (T, D) at other times of the clock (...,)."""
    return np.stack([np.interp(then, clock, column) for column in motion.T], -1)


def _of_limb(
    problem: Problem, x: Variables, guess: Guess, q: Array, clock: Array, period: float, chain: list[int]
) -> Array:
    """(T, 3 J) rad, what is added to the angles of a limb's links `chain`; zeros in strides that stay as they are."""
    own = q[:, chain].reshape(len(q), -1)
    cut = clock[0] + period * _cut(own, clock, period)
    number = np.floor((clock - cut) / period).astype(int)
    number -= number[0]
    count = number[-1] + 1
    sources = np.unique(np.linspace(0, count - 1, min(TEMPLATES, count)).round().astype(int))
    then = clock[:, None] + period * (sources - number[:, None])  # (T, S)
    there = (then >= clock[0] - 1e-9) & (then <= clock[-1] + 1e-9)
    done = _at(own, clock, then)  # (T, S, 3 J)
    at = problem.obs.at.numpy()
    angles = np.concatenate([own[:, None], done], 1)[at].reshape(len(at), 1 + len(sources), len(chain), 3)
    cost = limb_track.costs(problem, x, guess, chain, angles)
    away = np.linalg.norm(done - own[:, None], axis=-1)
    whole = np.stack([there[number == j].all(0) for j in range(count)], 1)  # (S, strides)
    dearer = _means(cost[:, 1:] - cost[:, :1], number[at], count)
    apart = _means(away, number, count)
    share = np.bincount(number) / len(number)
    choice = _choose(np.where(whole, dearer, math.inf), apart, sources, share)
    change = np.zeros_like(own)
    for j, s in enumerate(choice):
        if s is not None and sources[s] != j and apart[s, j] > LEAST:
            change[number == j] = (done[:, s] - own)[number == j]
    return change


def _means(values: Array, number: Array, count: int) -> Array:
    """(S, count) means of values (F, S) over the frames of each stride, inf of a stride without any."""
    total = np.zeros((count, values.shape[1]))
    np.add.at(total, number, values)
    frames = np.bincount(number, minlength=count)[:, None]
    return np.where(frames > 0, total / np.maximum(frames, 1), math.inf).T


def _cut(own: Array, clock: Array, period: float) -> float:
    """Where in the stride, in turns from the first frame, the limb (T, D) does most alike in all of them."""
    places = np.arange(_PHASES) / _PHASES
    spread = []
    for place in places:
        then = clock[0] + period * (place + np.arange(math.ceil((clock[-1] - clock[0]) / period - place)))
        spread.append(_at(own, clock, then).std(0).sum())
    return float(places[int(np.argmin(spread))])


def _choose(dearer: Array, apart: Array, sources: Array, share: Array) -> list[int | None]:
    """Which of S sources each of n strides is done as; None where it is no source and stays what it is.

    Args:
        dearer: (S, n) what a frame costs more then, inf where it cannot be.  apart: (S, n) rad between that and what it
            is.  sources: (S,) their numbers among the strides.  share: (n,) of the frames.
    """
    n = dearer.shape[1]
    # Strides that are no source are what they are: a row more for each.
    rows = np.concatenate([sources, np.setdiff1d(np.arange(n), sources)])
    each = np.full((n, n), math.inf)
    each[: len(sources)] = dearer
    each[np.arange(n), rows] = 0.0
    between = np.full((n, n), MOST)  # of row and row
    between[: len(sources)] = np.minimum(apart, MOST)[:, rows]
    between = np.minimum(between, between.T)
    np.fill_diagonal(between, 0.0)
    own = np.argsort(rows)

    def total(choice: Array) -> float:
        seen = each[choice, np.arange(n)]
        unlike = between[np.ix_(choice, choice)].sum(1) / max(n - 1, 1)
        return float((share * (seen + UNLIKE * unlike)).sum())

    best = own
    for start in (own, *(np.where(np.isfinite(each[s]), s, own) for s in range(len(sources)))):
        choice = start.copy()
        for _ in range(2 * n):
            before = choice.copy()
            for j in range(n):
                tried = [
                    np.concatenate([choice[:j], [s], choice[j + 1 :]]) for s in range(n) if np.isfinite(each[s, j])
                ]
                choice = min(tried, key=total)
            if (choice == before).all():
                break
        if total(choice) < total(best) - 1e-12:
            best = choice
    return [int(s) if s < len(sources) else None for s in best]
