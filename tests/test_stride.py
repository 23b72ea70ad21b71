"""Stride frequencies from the self-similarity of silhouettes, and which gaits are tried."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from slomo.gravity import GRAVITY
from slomo.pinhole import Intrinsics
from slomo.reconstruct import gaits
from slomo.reconstruct.gaits import SHORTLIST, Laid, diverse, ranked
from slomo.reconstruct.hypotheses import GaitHypothesis, gait_grid, gait_pose
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.stride import Steps, steps_of
from slomo.skeleton import load_skeleton

FPS, WIDTH, HEIGHT = 30.0, 96, 64


def seen(frequency: float, T: int = 90, *, seed: int = 0, clock: np.ndarray | None = None):
    """A body with a near pair of legs and a thinner far pair in the other phase: masks (T, 64 * 96), as observed. Its
    strides keep a `clock` (T,) s, or time."""
    rng = np.random.default_rng(seed)
    clock = np.arange(T) / FPS if clock is None else clock
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    masks = np.zeros((T, HEIGHT, WIDTH), bool)
    for t in range(T):
        masks[t] = (np.abs(y - 20) < 10) & (np.abs(x - 48) < 34)
        for hip, phase, half in ((22, 0.0, 4), (22, 0.5, 2), (72, 0.5, 4), (72, 0.0, 2)):
            swing = 0.35 * np.sin(2 * np.pi * (frequency * clock[t] + phase)) + 0.02 * rng.normal()
            masks[t] |= (np.abs(x - hip - swing * (y - 28)) < half) & (y >= 28) & (y < 58)
    box = np.array([[np.flatnonzero(m.any(0)).min(), 10, np.flatnonzero(m.any(0)).max(), 57] for m in masks])
    return SimpleNamespace(
        t=torch.arange(T) / FPS,
        at=torch.arange(T),
        K=Intrinsics(100.0, 100.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT),
        mask=torch.as_tensor(masks.reshape(T, -1)),
        box=box,
        empty=np.zeros(T, bool),
    )


def steps(obs: SimpleNamespace, speed: np.ndarray | None = None) -> Steps:
    return steps_of(obs, np.ones(len(obs.at)) if speed is None else speed)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("frequency", [1.2, 2.0, 2.5])
def test_a_fast_stride_is_not_taken_for_several(frequency, seed):
    """What two or three strides later looks most alike by chance is not the period."""
    found = steps(seen(frequency, seed=seed)).frequencies(0.45, 5.0)[:2]
    assert min(abs(f / frequency - 1) for f in found) < 0.05


def test_frequencies_stay_within_the_range():
    found = steps(seen(1.2)).frequencies(0.9, 1.5)
    assert found
    assert all(0.9 <= f <= 1.5 for f in found)


@pytest.mark.parametrize("power", [0.5, 1.0])
@pytest.mark.parametrize("change", ["faster", "stops"])
def test_strides_of_a_body_that_speeds_up_or_stops_keep_a_clock_of_its_speed(change, power):
    T = 120
    t = np.arange(T) / FPS
    speed = 0.4 + 1.2 * t / t[-1] if change == "faster" else np.clip(3.2 - t, 0.05, 1)
    pace = (speed / speed.mean()) ** power
    clock = np.concatenate([[0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) / FPS)])
    clock *= t[-1] / clock[-1]
    noise = np.random.default_rng(0).normal(1, 0.1, T)
    found = steps(seen(1.5, T, clock=clock), speed * noise)
    assert found.power > 0
    assert np.abs(found.clock - clock).max() < 0.25 / 1.5
    assert min(abs(f / 1.5 - 1) for f in found.frequencies(0.45, 5.0)[:2]) < 0.06


def test_strides_of_an_even_walk_keep_time():
    """Neither the noise of a path nor a speed that strides know nothing of makes them a clock of their own."""
    obs = seen(1.5)
    for speed in (np.random.default_rng(0).normal(1, 0.2, 90), np.linspace(0.5, 1.5, 90)):
        found = steps(obs, speed)
        assert found.power == 0
        np.testing.assert_allclose(found.clock, np.arange(90) / FPS, atol=1e-9)


def test_who_stops_has_all_feet_on_the_ground():
    skeleton = load_skeleton("quadruped")
    walk = next(g for g in skeleton.gaits if g.name == "walk")
    t = np.arange(120) / FPS
    speed = np.where(t < 2, 1.0, 0.01)
    clock = np.concatenate([[0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) / FPS)])
    gait = GaitHypothesis("walk", 1.2, 0.3)
    q, contact = gait_pose(Kinematics(skeleton), walk, gait, t, clock=clock, speed=speed, leg=0.75)
    assert contact[t < 1.9].mean() == pytest.approx(walk.duty, abs=0.1)
    assert contact[t > 2.1].all()
    folds = [joint for limb in skeleton.limbs for joint, _ in limb.lift]
    assert np.abs(q[t > 2.1][:, folds, 1]).max() < 0.1 * np.abs(q[:, folds, 1]).max()


def test_a_gait_is_tried_of_every_size_that_the_animal_may_have():
    """A horse that trots slowly: were it as long as a middling dog, it would walk."""
    skeleton, leg = load_skeleton("quadruped"), 0.75
    trot = next(g for g in skeleton.gaits if g.name == "trot")
    speed = (0.6 * trot.froude[0] * GRAVITY * leg / 1.6) ** 0.5  # of 1.6 m, as doubtful as speeds are

    def tried(metres: float | None) -> set[str]:
        grid = gait_grid(steps(seen(1.2)), skeleton, leg=leg, speed=speed, metres=metres, phases=4)
        return {g.name for g in grid}

    assert "trot" in tried(1.6)
    assert "trot" in tried(None)
    assert "trot" not in tried(skeleton.typical_length)
    assert "gallop" not in tried(None)


def test_the_best_gaits_are_ranked_once_more_with_more_pixels(monkeypatch):
    """Few pixels prefer one phase, many another; what is far behind is not looked at again."""
    seen = []

    def rank(problem, x, guess, *, draws, frames):
        seen.append(len(guess))
        return torch.tensor([abs(g.phase - 0.5) for g in guess])

    monkeypatch.setattr(gaits, "rank", rank)
    monkeypatch.setattr(gaits, "pick", lambda x, which: x)
    monkeypatch.setattr(gaits, "join", lambda guesses: guesses)
    tried = [GaitHypothesis("gallop", 1.7, n / 100) for n in range(60)]
    entries = [Laid(abs(g.phase - 0.4), 0, g, g) for g in tried]  # type: ignore[arg-type]
    found = ranked(None, {}, entries)  # type: ignore[arg-type]
    assert found[0].gait.phase == 0.5
    assert sum(seen) == SHORTLIST
    assert sorted(e.gait.phase for e in found) == [g.phase for g in tried]
    assert [e.loss for e in found[SHORTLIST:]] == sorted(e.loss for e in entries)[SHORTLIST:]


def test_every_gait_is_tried_though_all_phases_of_another_rank_before_it():
    entries = [
        Laid(worse + n / 100, 0, GaitHypothesis(name, 2.0, n / 12), None)  # type: ignore[arg-type]
        for worse, name in ((0.0, "gallop"), (1.0, "trot"), (2.0, "walk"))
        for n in range(12)
    ]
    chosen = diverse(entries, 6)
    assert [e.gait.name for e in chosen[:3]] == ["gallop", "trot", "walk"]
    assert [e.loss for e in chosen[:3]] == [0.0, 1.0, 2.0]
    assert len(chosen) == 6
    assert any(e.gait == GaitHypothesis("gallop", 2.0, 6 / 12) for e in chosen)  # the best one's opposite
    assert any(e.gait == GaitHypothesis("gallop", 2.0, 1 / 12) for e in chosen)  # and the phase next to its own
    assert [e.gait.phase for e in diverse(entries, 2)] == [0.0, 6 / 12]  # the opposite before another gait
    assert [e.gait.phase for e in diverse(entries, 1)] == [0.0]


def test_the_phase_next_to_the_best_gait_goes_on_with_it():
    """Of the same heading, gait and frequency, across the end of the stride, too; and not what is merely better."""
    best = {"heading": "travel+0", "gait": "gallop", "stride_hz": 1.7, "phase": 0.0}
    labels = [
        {"heading": "travel+0", "gait": "none"},
        best,
        best | {"phase": 0.5},
        best | {"phase": 0.083, "stride_hz": 1.8},
        best | {"phase": 0.083, "gait": "trot"},
        best | {"phase": 0.083, "heading": "travel+30"},
        best | {"phase": 0.917},
        best | {"phase": 0.083},
    ]
    assert gaits.beside(labels, [1, 2, 3, 4, 5, 6, 7]) == [6]
    assert gaits.beside(labels, [1, 2, 3, 4, 5]) == []
    assert gaits.beside(labels, []) == []
