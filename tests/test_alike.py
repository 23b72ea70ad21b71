"""Strides done as others of them were, on drawn silhouettes and on bare costs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import alike, fit, hypotheses, preferences
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.problem import Schedule, rank
from slomo.reconstruct.run import Run
from slomo.skeleton import load_skeleton
from test_fit_people import FPS, T, problem_of

STRIDE = 6  # frames
CLOCK = np.arange(T) / FPS
CENTRE = np.array([0.0, -4.5, 0.6])  # of a camera that sees the right flank
RAISED = {"shoulder": -40.0, "elbow": -85.0}
SWINGS = {"right": (1, 2), "left": (4, 5)}  # frames of a stride in which a front paw is up
INF = math.inf


def up(*legs: tuple[str, np.ndarray]) -> np.ndarray:
    """(T, B, 3) rad of a dog whose front paws on these sides are up in these frames."""
    kin = Kinematics(load_skeleton("quadruped"))
    q = np.zeros((T, kin.B, 3))
    for side, frames in legs:
        for joint, degrees in RAISED.items():
            q[frames, kin.skeleton.names.index(f"front_{side}_{joint}"), 1] = np.radians(degrees)
    return q


def raising(strides) -> np.ndarray:
    """(T, B, 3) rad of a dog that raises its right front paw in the middle of these strides."""
    return up(("right", np.array([k * STRIDE + n for k in strides for n in (2, 3, 4)], int)))


def of(seen: np.ndarray, fitted: np.ndarray):
    """One motion (T, B, 3) is seen, another one fitted."""
    problem, root = problem_of(np.zeros(T), seen, skeleton="quadruped", centre=CENTRE)
    guess = hypotheses.placed(problem.kin, root, np.zeros((1, T)))
    guess = replace(guess, q=torch.as_tensor(fitted, dtype=torch.float32)[None])
    return problem, root, problem.variables(1, torch.Generator().manual_seed(0)), guess


def done(seen, fitted, frequencies=(FPS / STRIDE,)) -> np.ndarray | None:
    """(T,) degrees of the elbow after strides were borrowed."""
    problem, _, x, guess = of(raising(seen), raising(fitted))
    found = alike.borrowed(problem, x, guess, clock=CLOCK, frequencies=frequencies)
    elbow = problem.kin.skeleton.names.index("front_right_elbow")
    return None if found is None else np.degrees(found[1].q[0, :, elbow, 1].numpy())


@pytest.mark.parametrize("missed", [1, 2])
def test_a_step_that_is_missed_is_done_as_the_others(missed):
    elbow = done(seen=range(4), fitted=[k for k in range(4) if k != missed])
    assert elbow is not None
    for k in range(4):
        assert elbow[k * STRIDE + 3] < -60
        assert abs(elbow[k * STRIDE]) < 35


def test_a_step_that_is_seen_to_be_another_stays_so():
    assert done(seen=[0, 1, 3], fitted=[0, 1, 3]) is None
    assert done(seen=range(4), fitted=range(4)) is None


def test_once_the_limbs_are_fitted_strides_are_borrowed_again(monkeypatch):
    """Beside the best one, whose strides may be borrowed ones already. Where there is nothing to borrow, or no time for
    it, the fit is at its end."""
    label = {"gait": "walk", "stride_hz": FPS / STRIDE, "strides": "alike"}
    effort = fit.Effort((Schedule(1, 2, 8, ()),) * len(fit.PHASES), 1, 1)

    def after_limbs(fitted, effort=effort):
        problem, root, x, guess = of(raising(range(4)), raising(fitted))
        run = Run(fit.LIMBS, x, guess, [label], {"limbs": [{}]})
        return fit._to_alike(problem, run, rank(problem, x, guess), replace(root, travelled=3.0), effort)

    monkeypatch.setattr(fit, "overtaking", lambda *a: [])
    beside = after_limbs([0, 1, 3])
    assert (fit.PHASES[beside.phase], beside.labels) == ("alike", [label, label | {"alike": "again"}])
    elbow = load_skeleton("quadruped").names.index("front_right_elbow")
    assert float(beside.guess.q[1, 2 * STRIDE + 3, elbow, 1].rad2deg()) < -60
    hasty = replace(effort, schedules=tuple(replace(s, iterations=0) for s in effort.schedules))
    for alone in (after_limbs(range(4)), after_limbs([0, 1, 3], hasty)):
        assert (alone.phase, alone.labels) == (len(fit.PHASES), [label])


def test_of_strides_that_the_picture_does_not_tell_apart_the_alike_ones_win():
    first = {"gait": "walk", "limbs": "on their own"}
    near = preferences.alike([first, first | {"alike": "again"}], torch.tensor([1.0, 1.005]), "alike")
    assert near[1] < near[0]
    far = preferences.alike([first, first | {"alike": "again"}], torch.tensor([1.0, 1.015]), "alike")
    assert far[0] < far[1]


def test_alike_strides_say_nothing_against_exchanged_legs():
    """Who has its legs exchanged wins by a lower loss than all others have, whichever strides those do."""
    first = {"gait": "walk"}
    labels = [first, first | {"limbs": "on their own", "strides": "alike"}, first | {"exchanged": "hind"}]
    order = lambda *losses: preferences.alike(labels, torch.tensor(losses), "strides").argsort().tolist()  # noqa: E731
    assert order(1.0, 1.001, 0.995) == [2, 1, 0]
    assert order(0.996, 1.001, 0.999) == [1, 2, 0]
    assert order(0.98, 1.001, 0.999) == [0, 1, 2]
    assert order(1.0, 0.99, 0.995) == [1, 2, 0]


def test_that_a_leg_does_as_the_other_one_is_no_reason_to_win():
    """An animal may be lame: the picture decides."""
    first = {"gait": "walk", "limbs": "on their own"}
    losses = torch.tensor([1.0, 1.001])
    assert torch.equal(preferences.alike([first, first | {"alike": "as the other side's"}], losses, "alike"), losses)


def walking(*fitted: str) -> np.ndarray:
    """Front paws are up by turns; those on the sides `fitted` all the time."""
    swings = {side: [k * STRIDE + n for k in range(4) for n in at] for side, at in SWINGS.items()}
    return up(*((side, np.arange(T) if side in fitted else np.array(swings[side])) for side in SWINGS))


def as_the_other(seen: np.ndarray, fitted: np.ndarray, frequencies=(FPS / STRIDE,)) -> dict[str, np.ndarray] | None:
    """(T,) degrees of both elbows when a leg that never comes down has done as the other one."""
    problem, _, x, guess = of(seen, fitted)
    found = alike.as_the_other(problem, x, guess, clock=CLOCK, frequencies=frequencies)
    number = problem.kin.skeleton.names.index
    elbows = {side: number(f"front_{side}_elbow") for side in SWINGS}
    return None if found is None else {s: np.degrees(found[1].q[0, :, j, 1].numpy()) for s, j in elbows.items()}


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_leg_that_never_comes_down_does_as_the_other_one_at_its_own_time(side):
    """Of the leg on the far side the picture shows the swings only."""
    elbow = as_the_other(walking(), walking(side))
    assert elbow is not None
    for own, at in SWINGS.items():
        middle = np.array([k * STRIDE + at[1] for k in range(1, 4)])
        assert (elbow[own][middle] < -60).all(), own
        assert (elbow[own][middle[:-1] + STRIDE // 2] > -35).all(), own


def test_legs_that_come_down_and_pairs_of_which_none_does_stay_as_they_are():
    assert as_the_other(walking(), walking()) is None
    assert as_the_other(walking(), walking("left", "right")) is None


def test_without_a_period_no_leg_does_as_the_other_one():
    assert as_the_other(walking(), walking("right"), frequencies=()) is None


@pytest.mark.parametrize("key", ["limbs", "alike"])
def test_a_leg_that_never_comes_down_is_tried_as_the_other_one_twice(key: str):
    label = {"gait": "walk", "stride_hz": FPS / STRIDE}
    problem, root, x, guess = of(walking(), walking("right"))
    root = replace(root, travelled=3.0)
    effort = fit.Effort((Schedule(1, 2, 8, ()),) * len(fit.PHASES), 1, 1)
    step, before = {"limbs": (fit._to_limbs, fit.FINAL), "alike": (fit._to_alike, fit.LIMBS)}[key]
    run = Run(before, x, guess, [label], {fit.PHASES[before]: [{}]})
    after = step(problem, run, rank(problem, x, guess), root, effort)
    assert label | {key: "as the other side's"} in after.labels
    assert fit.PHASES[after.phase] == key


def test_without_two_strides_nothing_is_borrowed():
    assert done(seen=range(4), fitted=[0, 1, 3], frequencies=(0.4,)) is None
    assert done(seen=range(4), fitted=[0, 1, 3], frequencies=()) is None


def test_the_stride_is_the_shortest_period_that_is_as_good():
    t = np.arange(0, 6, 1 / 30)
    twice = np.stack([np.sin(2 * np.pi * 1.5 * t), np.cos(2 * np.pi * 1.5 * t)], 1)
    assert alike._period(twice, t, (0.75, 1.5)) == pytest.approx(1 / 1.5, rel=0.02)
    other = np.stack([np.sin(2 * np.pi * 1.5 * t), np.cos(2 * np.pi * 0.75 * t)], 1)
    assert alike._period(other, t, (0.75, 1.5)) == pytest.approx(1 / 0.75, rel=0.02)


def test_what_costs_little_where_it_is_hidden_and_much_where_it_is_seen_goes():
    """Strides 0, 1 and 3 are done in one way, 2 and 4 in another. The first would cost much in 2 and 4, the second
    nothing anywhere: all are done in the second, though most were done in the first."""
    first, second = [0, 1, 3], [2, 4]
    dearer = np.zeros((5, 5))
    dearer[np.ix_(first, second)] = 0.022
    dearer[np.ix_(second, first)] = 0.002
    apart = np.full((5, 5), 0.05)
    apart[np.ix_(first, second)] = apart[np.ix_(second, first)] = 0.4
    share = np.full(5, 0.2)
    choice = alike._choose(dearer, apart, np.arange(5), share)
    assert set(choice) <= {2, 4}
    kept = alike._choose(10 * dearer, apart, np.arange(5), share)  # seen to be done in two ways
    assert {kept[j] for j in first} <= set(first)
    assert {kept[j] for j in second} <= set(second)


def test_strides_that_are_no_template_may_be_done_as_one_and_templates_need_not():
    dearer = np.array([[0.0, -0.03, 0.0], [INF, 0.02, 0.0]])  # of strides 0 and 2
    apart = np.array([[0.0, 0.4, 0.1], [0.1, 0.4, 0.0]])
    choice = alike._choose(dearer, apart, np.array([0, 2]), np.full(3, 1 / 3))
    assert choice[1] == 0
    assert choice[0] == 0
    dearer[:, 1] = 0.05
    assert alike._choose(dearer, apart, np.array([0, 2]), np.full(3, 1 / 3))[1] is None


def test_of_many_strides_a_few_are_templates(monkeypatch):
    monkeypatch.setattr(alike, "TEMPLATES", 2)
    elbow = done(seen=range(4), fitted=[0, 1, 3])
    assert elbow is not None
    assert all(elbow[k * STRIDE + 3] < -60 for k in range(4))
    assert done(seen=[0, 1, 3], fitted=[0, 1, 3]) is None


def test_a_stride_without_a_frame_has_no_mean():
    means = alike._means(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.array([0, 0, 2]), 3)
    assert means.tolist() == [[2.0, INF, 5.0], [3.0, INF, 6.0]]
