"""Limbs that do for a while what no posture, gait or neighbouring frame says: a raised paw, a kick, a step missed.

A limb far from where it is seen feels nothing of it: the pixels there pull whatever bone is nearest, and one leg hides
behind the other. So every limb, or the outer joints of it, is laid into the postures that its joints allow, frame by
frame, and the cheapest path through them and the pose it has (Viterbi 1967) tells where it would be seen better.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import torch

from slomo.reconstruct import evidence_terms, losses
from slomo.reconstruct.hypotheses import as_guess
from slomo.reconstruct.kinematics import limb_links
from slomo.reconstruct.pose_track import smooth, viterbi
from slomo.reconstruct.problem import Problem, Variables
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray
Tensor = torch.Tensor

RATE = 30.0  # frames a second that the costs below are for
PIXELS = 400
AT_ONCE = 1000  # poses
# Places in the range of pitch of a limb's joints, from the trunk outwards: forwards and backwards, bent and straight.
PLACES = ((0.15, 0.45, 0.75), (0.1, 0.3, 0.5, 0.75), (0.25, 0.55, 0.85))
# Cost of leaving the pose that a limb has, and of coming back: among rivals that are hardly fitted yet only what is
# plain may change it, at the end whatever is likely, and the loss decides.
PLAINLY, LIKELY = 0.4, 0.05
CHANGE = 0.03  # cost of a change of a limb's joints by 90 degrees in sum
LEAST = 0.2  # s, for which a limb must be elsewhere


def by_limb(problem: Problem, x: Variables, guess: Guess, *, leave: float) -> tuple[Variables, Guess] | None:
    """One hypothesis with its limbs where they are seen better, as a guess with no corrections to it; None when no limb
    is.

    Args:
        leave: what it costs that a limb leaves the pose that it has, and comes back (`PLAINLY` or `LIKELY`).
    """
    x, guess = as_guess(problem, x, guess)
    at = problem.obs.at.numpy()
    left, moved = list(problem.kin.skeleton.limbs), False
    while left:
        # The one that gains most goes first: what it covers then, no other needs to.
        found = [_path(problem, x, guess, limb_links(problem.kin.skeleton, limb), leave) for limb in left]
        best = max(range(len(left)), key=lambda n: found[n][0])
        gain, chain, change = found[best]
        if gain <= 0:
            break
        # Between fit frames, and into and out of the other pose, joints move evenly.
        t = problem.obs.t.numpy()
        change = np.stack([np.interp(t, t[at], c) for c in change.reshape(len(at), -1).T], 1)
        change = smooth(change, 2 * int(at[1] - at[0]) + 1)
        q = guess.q.clone()
        q[0][:, chain] += torch.as_tensor(change, dtype=torch.float32).reshape(-1, len(chain), 3)
        guess, moved = replace(guess, q=q), True
        del left[best]
    return (x, guess) if moved else None


def _path(
    problem: Problem, x: Variables, guess: Guess, chain: list[int], leave: float
) -> tuple[float, list[int], Array]:
    """What the cheapest path of a limb's links `chain` gains, and what it adds to the guess's angles, (F, J, 3) rad."""
    obs = problem.obs
    places = _postures(problem, chain)
    own = guess.q[0, obs.at][:, chain].numpy()
    elsewhere = ~np.isnan(places)
    pitch = np.stack([np.zeros_like(places), np.nan_to_num(places), np.zeros_like(places)], -1)
    angles = np.where(elsewhere[None, :, :, None], pitch, own[:, None])
    cost = costs(problem, x, guess, chain, angles) * RATE * float(obs.dt.median())
    flexion = angles[..., 1]
    turn = np.abs(flexion[1:, None] - flexion[:-1, :, None])  # (F - 1, from, to, J)
    turn *= elsewhere[:, None] | elsewhere  # its own motion costs nothing
    leaves = (elsewhere[:, None] != elsewhere).sum(-1)
    step = CHANGE * turn.sum(-1) / (math.pi / 2) + leave * leaves / len(chain)
    path = viterbi(cost, step)
    frames = np.arange(len(path))
    if (path > 0).sum() * float(obs.dt.median()) < LEAST:
        return 0.0, chain, np.zeros_like(own)
    total = cost[frames, path].sum() + step[frames[:-1], path[:-1], path[1:]].sum()
    return float(cost[:, 0].sum() - total), chain, angles[frames, path] - own


def _postures(problem: Problem, chain: list[int]) -> Array:
    """(N, J) rad, pitch of the chain's joints: first none, then the last, the last two, ... in every combination, NaN
    where a joint keeps the pose it has. Joints beyond `PLACES` are in the middle of their range."""
    lower, upper = (x[:, 1].numpy().clip(-math.pi, math.pi) for x in (problem.kin.lower, problem.kin.upper))
    places = [PLACES[k] if k < len(PLACES) else (0.5,) for k in range(len(chain))]
    values = [lower[j] + np.array(p) * (upper[j] - lower[j]) for j, p in zip(chain, places, strict=True)]
    J = len(chain)
    return np.array([(math.nan,) * k + p for k in range(J, -1, -1) for p in itertools.product(*values[k:])])


def costs(problem: Problem, x: Variables, guess: Guess, chain: list[int], angles: Array) -> Array:
    """(F, N) how badly the limb `chain` is seen in each fit frame with each of the angles (F, N, J, 3) rad."""
    obs, w = problem.obs, problem.weights
    F, N = angles.shape[:2]
    draw = problem.draw(F, PIXELS, torch.Generator().manual_seed(5))
    q = torch.as_tensor(angles, dtype=torch.float32)
    out = []
    for some in torch.arange(N).split(max(1, AT_ONCE // F)):
        wide = guess.pick(torch.zeros(len(some), dtype=torch.long))
        posed = wide.q.clone()
        posed[:, obs.at[:, None], torch.tensor(chain)] = q[:, some].transpose(0, 1)
        with torch.no_grad():
            y = {k: v.expand(len(some), *v.shape[1:]) for k, v in x.items()}
            state = problem.state(y, replace(wide, q=posed), draw, stance_weight=0.0)
            cost = w["mask"] * losses.misfit(state)
            if problem.said and "keypoints" in problem.said.groups:
                cost = cost + w["keypoints"] * evidence_terms.keypoints_by_frame(problem.said, state)
        out.append((cost * obs.quality).T.numpy())
    return np.concatenate(out, 1)
