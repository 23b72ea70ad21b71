"""Where chunks of a long clip meet: legs that change places are found, and put right where the fit likes it best."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from slomo.reconstruct import hypotheses, seams
from slomo.reconstruct.hypotheses import GaitHypothesis, RootGuess
from slomo.reconstruct.kinematics import Kinematics, limb_links
from slomo.reconstruct.run import Run
from slomo.reconstruct.trajectory import Guess, Trajectory
from slomo.skeleton import load_skeleton

KIN = Kinematics(load_skeleton("quadruped"))
FPS, T = 15, 75
WHERE = [(0, 45), (30, T)]  # frames of the two chunks
HIND = torch.tensor([k for limb in KIN.skeleton.limbs if "hind" in limb.name
                     for k in limb_links(KIN.skeleton, limb)])  # fmt: skip


def motion() -> Guess:
    """A walk."""
    t = np.arange(T) / FPS
    root = RootGuess(np.stack([0.8 * t, 0 * t], 1), 1.0, 0 * t, 4.0, np.full(T, 0.8))
    walk = next(g for g in KIN.skeleton.gaits if g.name == "walk")
    guess = hypotheses.placed(KIN, root, np.zeros((1, T)))
    q, _ = hypotheses.gait_pose(KIN, walk, GaitHypothesis("walk", 0.9, 0.1), t, clock=t, speed=root.speed, leg=0.75)
    guess.q[0] = torch.as_tensor(q, dtype=torch.float32)
    return guess


def cut(guess: Guess, first: int, last: int) -> Guess:
    return Guess(**{k: v[:, first:last].clone() for k, v in vars(guess).items()})


def exchange(guess: Guess, first: int, last: int) -> None:
    q = guess.q.clone()
    guess.q[:, first:last, HIND] = q[:, first:last, KIN.mirror[HIND]] * torch.tensor([-1.0, 1.0, -1.0])


@pytest.fixture
def settled(monkeypatch):
    """`settle` with a loss that is the distance of the joint angles from the truth."""
    true = [cut(motion(), *w) for w in WHERE]

    def rank(problem, x, guess: Guess, *, draws: int) -> torch.Tensor:
        own = true[problem.number]
        return (guess.q - own.q).abs().mean((1, 2, 3)) + 1 - torch.cos(guess.yaw - own.yaw).mean(1)

    def problem_of(n: int) -> SimpleNamespace:
        t = torch.arange(*WHERE[n]) / FPS
        path = Trajectory(t, KIN.B, joint_hz=4, root_hz=2, width=8)
        camera = torch.tensor([12.0, 1.0, 0.6])
        return SimpleNamespace(
            number=n, kin=KIN, path=path, obs=SimpleNamespace(t=t),
            cameras=lambda tilt, at: (None, camera.expand(1, len(at), 3)),
        )  # fmt: skip

    def call(guesses: list[Guess], *, facing: bool = False) -> tuple[list[Guess], list[dict]]:
        runs, log = [], []
        for n, guess in enumerate(guesses):
            shape = {f"shape.{k}": v for k, v in KIN.shape_variables(1).items()}
            moves = problem_of(n).path.variables(1, torch.Generator().manual_seed(0))
            runs.append(Run(4, shape | moves | {"tilt": torch.zeros(1, 2)}, guess, [{}]))
        if facing:
            runs, log = seams.one_way(problem_of, [problem_of(n).path for n in range(2)], runs, WHERE)  # type: ignore
        out, exchanged = seams.settle(problem_of, runs, WHERE)  # type: ignore[arg-type]
        return [r.guess for r in out], log + exchanged

    monkeypatch.setattr(seams, "rank", rank)
    return call, true


def test_chunks_that_agree_stay_as_they_are(settled):
    call, true = settled
    found, log = call([cut(motion(), *w) for w in WHERE], facing=True)
    assert log == []
    for f, g in zip(found, true, strict=True):
        torch.testing.assert_close(f.q, g.q)


@pytest.mark.parametrize("late", [True, False])
def test_legs_that_change_places_at_a_seam_are_put_right(settled, late: bool):
    """The later chunk begins with its hind legs exchanged, or the earlier one ends with them so."""
    call, true = settled
    wrong = [cut(motion(), *w) for w in WHERE]
    exchange(wrong[late], *((0, 26) if late else (18, 45)))
    found, log = call(wrong)
    assert len(log) == 1
    assert log[0]["limbs"] == "hind"
    assert log[0]["chunk"] == 1 + late
    torch.testing.assert_close(found[1 - late].q, true[1 - late].q)
    before, after = ((g.q - true[late].q).abs().mean() for g in (wrong[late], found[late]))
    assert after < 0.25 * before


def test_a_chunk_that_is_wrong_all_through_is_exchanged_all_through(settled):
    call, true = settled
    wrong = [cut(motion(), *w) for w in WHERE]
    exchange(wrong[1], 0, 45)
    found, log = call(wrong)
    assert log == [{"limbs": "hind", "exchanged_s": [2.0, round(74 / FPS, 3)], "chunk": 2}]
    torch.testing.assert_close(found[1].q, true[1].q)


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_chunk_that_faces_the_other_way_is_turned_around(settled, wrong: int):
    """The legs go with it: seen from the front, what was the left one on the back is the right one."""
    call, true = settled
    guesses = [cut(motion(), *w) for w in WHERE]
    camera = torch.tensor([12.0, 1.0])
    away = guesses[wrong].position[..., :2] - camera
    guesses[wrong].yaw[:] = 2 * torch.atan2(away[..., 1], away[..., 0]) + np.pi - guesses[wrong].yaw
    guesses[wrong].q[:] = KIN.mirrored(guesses[wrong].q)
    found, log = call(guesses, facing=True)
    assert log == [{"turned_around": True, "chunk": wrong + 1}]
    for f, g in zip(found, true, strict=True):
        torch.testing.assert_close(f.q, g.q)
        torch.testing.assert_close(torch.cos(f.yaw - g.yaw), torch.ones_like(g.yaw))
