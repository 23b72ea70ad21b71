"""Pairs of legs that may be exchanged, from drawn silhouettes of the skeleton itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import fit, hypotheses, sides
from slomo.reconstruct.evidence import gather
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.problem import Schedule, rank
from slomo.reconstruct.run import Run
from slomo.skeleton import load_skeleton
from test_fit_people import TOWARDS_CAMERA, T, problem_of
from test_limb_track import CENTRE, RAISED, UP

KIN = Kinematics(load_skeleton("quadruped"))


def raising(yaw: float, when: slice = UP):
    """A dog that stands and raises its right front paw for a second: the problem, the root's guess, and the motion."""
    q = np.zeros((T, KIN.B, 3))
    for joint, degrees in RAISED.items():
        q[when, KIN.skeleton.names.index(f"front_right_{joint}"), 1] = np.radians(degrees)
    problem, root = problem_of(np.full(T, yaw), q, skeleton="quadruped", centre=CENTRE)
    guess = hypotheses.placed(problem.kin, root, np.full((1, T), yaw))
    guess = replace(guess, q=torch.as_tensor(q, dtype=torch.float32)[None])
    return problem, root, problem.variables(1, torch.Generator().manual_seed(0)), guess


def test_a_pair_is_exchanged_by_itself():
    problem, _, x, guess = raising(0.0)
    for name, links, _ in hypotheses.leg_pairs(KIN.skeleton):
        _, other = hypotheses.exchanged(problem, x, guess, links)
        moved = (other.q - guess.q)[0].abs().amax((0, 2)) > 1e-6
        raised = {KIN.skeleton.names.index(f"front_{s}_{j}") for s in ("left", "right") for j in RAISED}
        assert set(torch.nonzero(moved)[:, 0].tolist()) == (raised if name == "front" else set())


def test_what_the_picture_leaves_open_is_tried():
    """From the flank a paw is the one or the other; half from the front it is not. Hind legs side by side are the
    same exchanged."""
    for yaw, expected in ((0.0, {"front"}), (TOWARDS_CAMERA + 0.7, set())):
        problem, _, x, guess = raising(yaw, slice(0, T))
        assert {name for name, _, _ in sides.exchanged_pairs(problem, x, guess)} == expected


def test_it_goes_on_beside_the_best_one():
    problem, root, x, guess = raising(0.0)
    run = Run(fit.FINAL, x, guess, [{"gait": "none"}], {"final": [{}]})
    phases = tuple(Schedule(1, 2, 8, ()) for _ in fit.PHASES)
    best = fit._to_limbs(problem, run, rank(problem, x, guess), root, fit.Effort(phases, 1, 1))
    assert {label.get("exchanged") for label in best.labels} == {None, "front"}
    assert len(best.guess.yaw) == len(best.labels)


@pytest.mark.parametrize(("side", "share"), [(0.8, sides.BELIEVED), (1.0, 1.0)])
def test_networks_are_believed_less_than_the_user(side: float, share: float):
    """Key points of networks say in how many frames left and right are exchanged; the user's are not asked."""
    problem, *_ = raising(0.0)
    names = ["front_left_paw", "front_right_paw"]
    arrays = dict(
        frame=np.arange(T), keypoint_names=np.array(names), keypoints=np.full((T, 2, 2), 20.0),
        keypoint_confidence=np.ones((T, 2)), keypoint_side=np.full(2, side),
    )  # fmt: skip
    weights = {"mask": 1.0, "view": 0.05, "keypoints": 0.5, "parts": 0.25, "surface": 0.25}
    said = gather(arrays, problem.obs, KIN.skeleton)
    problem = replace(problem, said=said, weights=weights)
    expected = weights | {k: weights[k] * sides.BELIEVED for k in ("parts", "surface")} | {"keypoints": 0.5 * share}
    assert sides.doubting(problem).weights == pytest.approx(expected)
