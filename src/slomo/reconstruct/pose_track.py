"""A first pose for every frame: where a person faces and where the arms are, from silhouettes, by the cheapest path.

A person turns on the spot and moves the arms freely, so one heading and one posture for the whole clip are not enough
to start from. Every frame is scored for every pair of a heading and a posture; the cheapest path through them (Viterbi
1967) pays for turns and for changes of posture.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.reconstruct import evidence_terms, losses
from slomo.reconstruct.evidence import Evidence
from slomo.reconstruct.hypotheses import RootGuess
from slomo.reconstruct.problem import Draw, Problem, Variables
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray
Tensor = torch.Tensor

RATE = 8.0  # scored frames a second
PIXELS = 160
HEADINGS = 12
AWAY = 0.08  # cost of a back seen square on: people are filmed from the front unless something says otherwise
TRAVEL = 0.25  # cost of moving backwards at a walk
# Cost of a turn by one step of heading between two scored frames. High: an oblique view and its mirror image
# look alike, and a person who stands while the camera goes around must not be turned along with it.
TURN = 0.15
SAID = 0.15  # cost of a heading that is 3 nats less likely by the view's evidence than the likeliest
CHANGE = 0.05  # cost of a change of all joints' angles by 90 degrees in sum

View = float | Evidence


@dataclass(frozen=True)
class Track:
    """yaw (T,) rad and q (T, B, 3) rad of the cheapest path, its mean cost, and how often each posture was taken."""

    yaw: Array
    q: Array
    cost: float
    postures: Array


def frame_costs(problem: Problem, x: Variables, guess: Guess, seen: Tensor) -> Array:
    """(H, S) how badly each hypothesis covers the mask of each of the fit frames `seen`."""
    draw = problem.draw(len(problem.obs.at), PIXELS, torch.Generator().manual_seed(5))
    draw = Draw(seen, draw.pixel[seen], draw.inside)
    with torch.no_grad():
        return losses.misfit(problem.state(x, guess, draw, stance_weight=0.0)).numpy()


def viterbi(cost: Array, step: Array) -> Array:
    """(S,) the states of the cheapest path. cost (S, N) of each state; step (N, N), or (S - 1, N, N) where it changes
    over time, from a state (row) to the next."""
    back = np.zeros(cost.shape, int)
    total = cost[0]
    steps = np.broadcast_to(step, (len(cost) - 1, *step.shape[-2:]))
    for k in range(1, len(cost)):
        via = total[:, None] + steps[k - 1]
        back[k] = via.argmin(0)
        total = via.min(0) + cost[k]
    path = [int(total.argmin())]
    for k in range(len(cost) - 1, 0, -1):
        path.append(int(back[k][path[-1]]))
    return np.array(path[::-1])


def tracks(
    problem: Problem, x: Variables, guess: Guess, root: RootGuess, postures: Tensor, *,
    turns: tuple[float, ...] = (0.0,), views: tuple[View, ...] = (AWAY,),
) -> list[Track]:  # fmt: skip
    """The cheapest path through headings and postures, for each of `views`.

    Args:
        x, guess: of one hypothesis, which says position, size and the heading that `turns` are added to.
        postures: (N, B, 3) rad.
        turns: rad, headings against the guess's, evenly spaced around the circle, or just (0,).
        views: what speaks for a heading: the cost of a back seen square on (a negative one prefers it), or evidence.
    """
    obs = problem.obs
    F, N = len(obs.at), len(postures)
    every = max(1, round(1 / (RATE * float(obs.dt.median()))))
    seen = torch.arange(0, F, every)
    wide = {k: v.expand(N, *v.shape[1:]) for k, v in x.items()}
    base = guess.pick(torch.zeros(N, dtype=torch.long))
    base = replace(base, q=postures[:, None].expand(-1, base.q.shape[1], -1, -1))
    at = obs.at[seen].numpy()
    to_camera = obs.T_world_cam[at, :2, 3] - root.middle[at]
    to_camera = np.arctan2(to_camera[:, 1], to_camera[:, 0])
    speed = (root.speed[at] / 0.5) ** 2
    moving = speed / (1 + speed)
    yaw = guess.yaw[0, obs.at[seen]].numpy() + np.array(turns)[:, None]
    fits = [frame_costs(problem, wide, replace(base, yaw=base.yaw + turn), seen) for turn in turns]
    sure = obs.quality[seen].numpy()  # frames whose mask is doubtful say little
    fit = np.stack(fits) * sure + (TRAVEL * moving * (1 - np.cos(yaw - root.heading[at])) / 2)[:, None]
    step = _steps(len(turns), postures)
    out = []
    for view in views:
        table = (fit + _view_cost(view, yaw, to_camera, seen)[:, None]).reshape(len(turns) * N, -1).T
        path = viterbi(table, step)
        way, posture = path // N, path % N
        turned = np.unwrap(np.asarray(turns)[way])[:, None]
        q = postures.numpy()[posture].reshape(len(at), -1)
        width = 2 * every * int(obs.at[1] - obs.at[0]) + 1
        turned, q = (smooth(fill(obs.t.numpy(), at, y), width) for y in (turned, q))
        cheapest = float(table[np.arange(len(path)), path].mean())
        out.append(Track(guess.yaw[0].numpy() + turned[:, 0], q.reshape(-1, *postures.shape[1:]), cheapest,
                         np.bincount(posture, minlength=N)))  # fmt: skip
    return out


def _view_cost(view: View, yaw: Array, to_camera: Array, seen: Tensor) -> Array:
    """(N, S) cost of the headings yaw (N, S) of the fit frames `seen` with the camera in direction to_camera (S,)."""
    if not isinstance(view, Evidence):
        return view * np.maximum(-np.cos(yaw - to_camera), 0)
    azimuth = torch.as_tensor(to_camera - yaw, dtype=torch.float32)
    cost = evidence_terms.at_azimuth(evidence_terms.doubtful(view.view[seen]), azimuth)
    return SAID * (cost * view.view_weight[seen]).numpy()


def _steps(headings: int, postures: Tensor) -> Array:
    """(S, S) cost of a change from every pair of a heading and a posture to every other."""
    n = np.arange(headings)
    apart = np.abs(n[:, None] - n)
    apart = np.minimum(apart, headings - apart)
    p = postures.reshape(len(postures), -1).numpy()
    change = CHANGE * np.abs(p[:, None] - p).sum(-1) / (math.pi / 2)
    return (TURN * apart[:, None, :, None] + change[None, :, None, :]).reshape(headings * len(p), -1)


def fill(t: Array, at: Array, y: Array) -> Array:
    """(T, D) values y (S, D) at frames `at`, linear between them."""
    return np.stack([np.interp(t, t[at], c) for c in y.T], 1)


def smooth(x: Array, width: int) -> Array:
    """(T, D) moving average over an odd number of frames."""
    half = width // 2
    padded = np.pad(x, ((half, half), (0, 0)), "edge")
    return np.stack([np.convolve(c, np.ones(width) / width, "valid") for c in padded.T], 1)
