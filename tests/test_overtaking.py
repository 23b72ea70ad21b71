"""Legs that overtake each other, and legs that meet, change names and part again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import fit, hypotheses
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.overtaking import every_other, overtaking
from slomo.reconstruct.problem import Schedule
from slomo.reconstruct.run import Run
from slomo.skeleton import load_skeleton
from test_fit_people import FPS, T, problem_of
from test_limb_track import CENTRE

STEP = 1 / 30  # s


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_every_other_moment_in_which_feet_meet(noise):
    """Feet that meet twice in a stride of a second, and come nearer by a little in between."""
    t = np.arange(105) * STEP
    away = np.abs(np.sin(2 * np.pi * (t + 0.1))) + 0.1 * np.sin(8 * np.pi * t)
    away = np.abs(away + noise * np.random.default_rng(0).standard_normal(len(t)))
    found = every_other(away, STEP)
    assert found is not None
    expected = np.floor(2 * (t + 0.1)) % 2 > 0
    assert (found != expected).mean() < 0.08
    assert every_other(np.ones(105), STEP) is None
    assert every_other(np.abs(t - 1.5), STEP) is None  # once


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
    monkeypatch.setattr("slomo.reconstruct.overtaking.every_other", lambda *a: next(answers))
    rivals = overtaking(problem, x, shuffled)
    assert [name for name, *_ in rivals] == ["hind"]
    _, _, guess = rivals[0]
    torch.testing.assert_close(guess.q, true.q, atol=1e-5, rtol=0)
    # It goes on beside the best one, of who travels and where there is time for it.
    run = Run(fit.LIMBS, x, shuffled, [{"gait": "none"}], {"limbs": [{}]})
    effort = fit.Effort(tuple(Schedule(1, 2, 8, ()) for _ in fit.PHASES), 1, 1)
    goes = lambda root, effort: fit._overtaking(problem, run, root, effort)  # noqa: E731
    beside = goes(replace(root, travelled=3.0), effort)
    assert beside.labels == [{"gait": "none"}, {"gait": "none", "overtaking": "hind"}]
    assert fit.PHASES[beside.phase] == "overtaking"
    none = replace(effort, schedules=(*effort.schedules[:-1], Schedule(0, 2, 8, ())))
    for alone in (goes(root, effort), goes(replace(root, travelled=3.0), none)):
        assert (alone.labels, alone.phase) == ([{"gait": "none"}], len(fit.PHASES))


def test_what_the_picture_denies_is_not_tried(monkeypatch):
    problem, _, x, _, true = walking(slice(0, 0))
    half = np.arange(T) < T // 2
    monkeypatch.setattr("slomo.reconstruct.overtaking.OPEN", 0.0)
    monkeypatch.setattr("slomo.reconstruct.overtaking.every_other", lambda *a: half)
    assert overtaking(problem, x, true) == []


@pytest.mark.parametrize("phase", ["alike", "overtaking"])
@pytest.mark.parametrize(("wins", "loss"), [(True, 0.4), (False, 0.5)])
def test_who_was_the_best_stays_as_it_was_unless_it_is_beaten(phase: str, wins: bool, loss: float):
    _, _, x, _, guess = walking(slice(0, 0))
    now = {k: v + 1 for k, v in x.items()}
    label = {phase: "hind"} if wins else {}
    log = {"limbs": [{"loss": 0.5}], phase: [label | {"loss": 0.4}]}
    both = now | {fit.BEFORE + k: v for k, v in x.items()}
    run = fit._as_it_was(Run(fit.PHASES.index(phase), both, guess, [label], log))
    assert run.x.keys() == x.keys()
    for k, v in run.x.items():
        torch.testing.assert_close(v, now[k] if wins else x[k], rtol=0, atol=0)
    assert run.loss == loss
