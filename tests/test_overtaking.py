"""Legs that overtake each other, and legs that meet, change names and part again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import fit, hypotheses
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.overtaking import overtaking, taking_turns
from slomo.reconstruct.problem import Schedule
from slomo.reconstruct.run import Run
from slomo.skeleton import load_skeleton
from test_fit_people import FPS, T, problem_of
from test_limb_track import CENTRE

STEP = 1 / 30  # s


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_legs_that_part_again_are_told_from_those_that_overtake_each_other(noise):
    """Feet that meet twice in a stride of a second, and come nearer by a little in between."""
    t = np.arange(105) * STEP
    ahead = np.sin(2 * np.pi * (t + 0.1))
    away = np.abs(ahead) + 0.1 * np.sin(8 * np.pi * t)
    away = np.abs(away + noise * np.random.default_rng(0).standard_normal(len(t)))
    assert not taking_turns(away, ahead, STEP).any()
    odd = np.floor(2 * (t + 0.1)) % 2 > 0
    always = taking_turns(away, np.abs(ahead), STEP)
    assert (always != odd).mean() < 0.08
    once = taking_turns(away, np.where(t < 1.4, -ahead, ahead), STEP)
    assert (once != (t >= 1.4)).mean() < 0.04
    assert not taking_turns(np.ones(105), np.ones(105), STEP).any()  # they never meet


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


MEET = slice(6, 12)  # frames between two moments in which the hind feet of `walking` meet


def test_hind_legs_that_change_names_are_tried_as_legs_that_overtake_each_other():
    problem, root, x, shuffled, true = walking(MEET)
    assert overtaking(problem, x, true) == []
    rivals = overtaking(problem, x, shuffled)
    assert [name for name, *_ in rivals][:2] in (["hind"], ["hind", "hind, the others"])
    wrong = (rivals[0][2].q - true.q).abs().amax((0, 2, 3)) > 1e-5
    assert set(np.flatnonzero(wrong.numpy())) <= {MEET.start - 1, MEET.start, MEET.stop - 1, MEET.stop}
    # It goes on beside the best one, of who travels and where there is time for it.
    run = Run(fit.LIMBS, x, shuffled, [{"gait": "none"}], {"limbs": [{}]})
    effort = fit.Effort(tuple(Schedule(1, 2, 8, ()) for _ in fit.PHASES), 1, 1)
    goes = lambda root, effort: fit._overtaking(problem, run, root, effort)  # noqa: E731
    beside = goes(replace(root, travelled=3.0), effort)
    assert beside.labels == [{"gait": "none"}, *({"gait": "none", "overtaking": name} for name, *_ in rivals)]
    assert fit.PHASES[beside.phase] == "overtaking"
    none = replace(effort, schedules=(*effort.schedules[:-1], Schedule(0, 2, 8, ())))
    for alone in (goes(root, effort), goes(replace(root, travelled=3.0), none)):
        assert (alone.labels, alone.phase) == ([{"gait": "none"}], len(fit.PHASES))


def test_what_the_picture_denies_is_not_tried(monkeypatch):
    problem, _, x, shuffled, _ = walking(MEET)
    monkeypatch.setattr("slomo.reconstruct.overtaking.OPEN", -0.5)
    assert overtaking(problem, x, shuffled) == []


@pytest.mark.parametrize(("loss", "won"), [(0.4, True), (0.504, True), (0.51, False)])
def test_the_other_pair_is_tried_where_one_has_changed_names(monkeypatch, loss: float, won: bool):
    """Which legs that overtake each other are believed to have, though the picture be worse for it by 1.2 %."""
    problem, _, x, shuffled, _ = walking(MEET)
    labels = [{"gait": "none"}, {"gait": "none", "overtaking": "front"}]
    x = {k: torch.cat([v, v]) for k, v in x.items()}
    x |= {fit.BEFORE + k: v for k, v in x.items()}
    run = Run(fit.PHASES.index("overtaking"), x, shuffled.pick(torch.tensor([0, 0])), labels, {"overtaking": [{}, {}]})
    monkeypatch.setattr(fit, "_by_picture", lambda *a: torch.tensor([0.5, loss]))
    after = fit._to_the_other_pair(problem, run)
    if won:
        assert fit.PHASES[after.phase] == "the other pair"
        assert after.labels[:2] == [labels[1], labels[1] | {"the other pair": "hind"}]
    else:
        assert (after.phase, after.labels) == (len(fit.PHASES), labels[:1])


@pytest.mark.parametrize("phase", ["alike", "overtaking", "the other pair"])
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
