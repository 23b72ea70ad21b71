"""Legs that overtake each other, and legs that meet, change names and part again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import fit, hypotheses
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.overtaking import changes, overtaking
from slomo.reconstruct.problem import Schedule, rank
from slomo.reconstruct.run import Run
from slomo.skeleton import load_skeleton
from test_fit_people import FPS, T, problem_of
from test_limb_track import CENTRE

STEP = 1 / 30  # s
DUTY, STRIDE = 0.6, 0.8  # share of a stride of a second on the ground, and its length


def feet_of(seconds: float, noise: float = 0.0) -> np.ndarray:
    """(2, F, 2, 3) of the left and the right foot of one who walks, as they are and exchanged."""
    t = np.arange(round(seconds / STEP)) * STEP
    stride = t[:, None] + np.array([0.0, 0.5])
    swing = ((stride % 1 - DUTY) / (1 - DUTY)).clip(0, 1)
    ahead = STRIDE * (np.floor(stride) + 0.5 - 0.5 * np.cos(np.pi * swing)) - np.array([0.0, 0.5 * STRIDE])
    up = 0.1 * np.sin(np.pi * swing)
    own = np.stack([ahead, np.full_like(ahead, 0.1) * [1, -1], up], -1)
    own[..., 0] += noise * np.random.default_rng(0).standard_normal(ahead.shape)
    other = own[:, ::-1].copy()
    other[..., 1] *= -1
    return np.stack([own, other])


def meetings(paths: np.ndarray) -> list[int]:
    """The frames in which one foot overtakes the other."""
    between = paths[0, :, 0, 0] - paths[0, :, 1, 0]
    return (1 + np.flatnonzero(between[:-1] * between[1:] <= 0)).tolist()


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_feet_that_change_names_where_they_meet_get_them_back(noise):
    true = feet_of(4.0, noise)
    at = meetings(true)
    swapped = np.zeros(true.shape[1], bool)
    for first, end in zip(at[::2], at[1::2], strict=False):
        swapped[first:end] = True
    shuffled = np.where(swapped[:, None, None], true[::-1], true)
    found = changes(shuffled, STEP)
    assert found is not None
    wrong = (found ^ swapped).mean()
    assert min(wrong, 1 - wrong) < 0.1  # which of the two is the left one is another question


def test_feet_that_overtake_each_other_are_left_alone():
    assert changes(feet_of(4.0), STEP) is None


def walking(swapped: slice):
    """A dog that walks on the spot, seen half from the front, with its hind legs exchanged in a part of the clip."""
    kin = Kinematics(load_skeleton("quadruped"))
    walk = {g.name: g for g in kin.skeleton.gaits}["walk"]
    t = np.arange(T) / FPS
    gait = hypotheses.GaitHypothesis("walk", 0.5, 0.1)
    q, _ = hypotheses.gait_pose(kin, walk, gait, t, clock=t, speed=np.full(T, 0.35), leg=kin.leg)
    problem, root = problem_of(np.full(T, -0.6), q, skeleton="quadruped", centre=CENTRE)
    guess = hypotheses.placed(kin, root, np.full((1, T), -0.6))
    guess = replace(guess, q=torch.as_tensor(q, dtype=torch.float32)[None])
    x = problem.variables(1, torch.Generator().manual_seed(0))
    links = next(links for name, links, _ in hypotheses.leg_pairs(kin) if name == "hind")
    _, other = hypotheses.exchanged(problem, x, guess, links)
    shuffled = guess.q.clone()
    shuffled[:, swapped] = other.q[:, swapped]
    return problem, root, x, replace(guess, q=shuffled), guess


def test_hind_legs_that_change_names_are_tried_as_legs_that_overtake_each_other(monkeypatch):
    problem, root, x, shuffled, true = walking(slice(9, 16))
    swapped = np.zeros(T, bool)
    swapped[9:16] = True
    found = {"hind": swapped, "front": None}
    order = [name for name, *_ in hypotheses.leg_pairs(problem.kin)]
    answers = iter([found[name] for name in order] * 4)
    monkeypatch.setattr("slomo.reconstruct.overtaking.changes", lambda *a: next(answers))
    rivals = overtaking(problem, x, shuffled)
    assert [name for name, *_ in rivals] == ["hind"]
    _, _, guess = rivals[0]
    torch.testing.assert_close(guess.q, true.q, atol=1e-5, rtol=0)
    # It goes on beside the best one, of who travels and where there is time for it.
    run = Run(fit.LIMBS, x, shuffled, [{"gait": "none"}], {"limbs": [{}]})
    effort = fit.Effort(tuple(Schedule(1, 2, 8, ()) for _ in fit.PHASES), 1, 1)
    losses = rank(problem, x, shuffled)
    goes = lambda root, effort: fit._to_overtaking(problem, run, losses, root, effort).labels  # noqa: E731
    assert goes(replace(root, travelled=3.0), effort) == [{"gait": "none"}, {"gait": "none", "overtaking": "hind"}]
    assert len(goes(root, effort)) == 1
    none = replace(effort, schedules=(*effort.schedules[:-1], Schedule(0, 2, 8, ())))
    assert len(goes(replace(root, travelled=3.0), none)) == 1


def test_what_the_picture_denies_is_not_tried(monkeypatch):
    problem, _, x, _, true = walking(slice(0, 0))
    half = np.arange(T) < T // 2
    monkeypatch.setattr("slomo.reconstruct.overtaking.changes", lambda *a: half)
    assert overtaking(problem, x, true) == []
