"""Limbs that do for a while what no posture, gait or neighbouring frame says: a raised paw, a kick.

A limb far from where it is seen feels nothing of it: the pixels there pull whatever bone is nearest. So every limb is
laid into the postures that its joints allow, frame by frame, and the cheapest path through them and the pose it has
(Viterbi 1967) tells where it would be seen better.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import torch

from slomo.reconstruct import evidence_terms, losses
from slomo.reconstruct.hypotheses import as_guess, limb_links
from slomo.reconstruct.pose_track import fill, smooth, viterbi
from slomo.reconstruct.problem import Draw, Problem, Variables
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray
Tensor = torch.Tensor

RATE = 8.0  # scored frames a second
PIXELS = 400
# Places in the range of pitch of a limb's joints, from the trunk outwards: forwards and backwards, bent and straight.
PLACES = ((0.15, 0.45, 0.75), (0.1, 0.3, 0.5, 0.75), (0.25, 0.6))
LEAVE = 0.1  # cost of leaving the pose that the limb has, and of coming back
CHANGE = 0.03  # cost of a change of a limb's joints by 90 degrees in sum
LEAST = 0.2  # s, for which a limb must be elsewhere


def by_limb(problem: Problem, x: Variables, guess: Guess) -> tuple[Variables, Guess] | None:
    """One hypothesis with its limbs where they are seen better, as a guess with no corrections to it; None when no limb
    is."""
    x, guess = as_guess(problem, x, guess)
    obs = problem.obs
    every = max(1, round(1 / (RATE * float(obs.dt.median()))))
    seen = torch.arange(0, len(obs.at), every)
    width = 2 * every * int(obs.at[1] - obs.at[0]) + 1
    left, moved = list(problem.kin.skeleton.limbs), False
    while left:
        # The one that gains most goes first: what it covers then, no other needs to.
        found = [_path(problem, x, guess, limb_links(problem.kin.skeleton, limb), seen) for limb in left]
        best = max(range(len(left)), key=lambda n: found[n][0])
        gain, chain, angles = found[best]
        if gain <= 0:
            break
        # Between scored frames, and into and out of the other pose, joints move evenly.
        own = guess.q[0, obs.at[seen]][:, chain].numpy()
        change = fill(obs.t.numpy(), obs.at[seen].numpy(), (angles - own).reshape(len(seen), -1))
        q = guess.q.clone()
        q[0][:, chain] += torch.as_tensor(smooth(change, width), dtype=torch.float32).reshape(-1, len(chain), 3)
        guess, moved = replace(guess, q=q), True
        del left[best]
    return (x, guess) if moved else None


def _path(
    problem: Problem, x: Variables, guess: Guess, chain: list[int], seen: Tensor
) -> tuple[float, list[int], Array]:
    """What the cheapest path of a limb's links `chain` gains, and its angles (S, J, 3) rad; they are those of the guess
    where that is as good."""
    places = _postures(problem, chain)
    N = len(places) + 1
    q = guess.q.expand(N, -1, -1, -1).clone()
    for joint, angles in zip(chain, places.T, strict=True):
        q[1:, :, joint] = 0.0
        q[1:, :, joint, 1] = torch.as_tensor(angles, dtype=torch.float32)[:, None]
    wide = guess.pick(torch.zeros(N, dtype=torch.long))
    cost = _costs(problem, {k: v.expand(N, *v.shape[1:]) for k, v in x.items()}, replace(wide, q=q), seen)
    step = np.zeros((N, N))
    step[1:, 1:] = CHANGE * np.abs(places[:, None] - places).sum(-1) / (math.pi / 2)
    step[0, 1:] = step[1:, 0] = LEAVE
    path = viterbi(cost, step)
    away = path > 0
    own = guess.q[0, problem.obs.at[seen]][:, chain].numpy()
    if away.sum() < LEAST * RATE:
        return 0.0, chain, own
    angles = own.copy()
    angles[away] = 0.0
    angles[away, :, 1] = places[path[away] - 1]
    total = cost[np.arange(len(path)), path].sum() + step[path[:-1], path[1:]].sum()
    return float(cost[:, 0].sum() - total), chain, angles


def _postures(problem: Problem, chain: list[int]) -> Array:
    """(N, J) rad, pitch of the chain's joints in every combination; those beyond `PLACES` in the middle."""
    lower, upper = (x[:, 1].numpy().clip(-math.pi, math.pi) for x in (problem.kin.lower, problem.kin.upper))
    places = [PLACES[k] if k < len(PLACES) else (0.5,) for k in range(len(chain))]
    values = [lower[j] + np.array(p) * (upper[j] - lower[j]) for j, p in zip(chain, places, strict=True)]
    return np.array(list(itertools.product(*values)))


def _costs(problem: Problem, x: Variables, guess: Guess, seen: Tensor) -> Array:
    """(S, N) how badly each of the hypotheses is seen in each of the fit frames `seen`."""
    draw = problem.draw(len(problem.obs.at), PIXELS, torch.Generator().manual_seed(5))
    draw = Draw(seen, draw.pixel[seen], draw.inside)
    w = problem.weights
    with torch.no_grad():
        state = problem.state(x, guess, draw, stance_weight=0.0)
        cost = w["mask"] * losses.misfit(state)
        if problem.said and "keypoints" in problem.said.groups:
            cost = cost + w["keypoints"] * evidence_terms.keypoints_by_frame(problem.said, state)[:, seen]
    return (cost * problem.obs.quality[seen]).numpy().T
