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
    for name, links, _ in hypotheses.leg_pairs(KIN):
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


def spread(degrees: float, yaw: float = 0.0):
    """A person seen from the flank (of a `yaw` of 0) with the legs apart sideways, crossed where that is negative."""
    kin = Kinematics(load_skeleton("human"))
    q = np.zeros((T, kin.B, 3))
    for side, sign in (("left", 1), ("right", -1)):
        q[:, kin.skeleton.names.index(f"{side}_hip"), 0] = sign * np.radians(degrees)
    problem, root = problem_of(np.full(T, yaw), q)
    guess = hypotheses.placed(kin, root, np.full((1, T), yaw))
    guess = replace(guess, q=torch.as_tensor(q, dtype=torch.float32)[None])
    return problem, root, problem.variables(1, torch.Generator().manual_seed(0)), guess


@pytest.mark.parametrize("degrees", [-20.0, 0.0, 20.0])
def test_crossed_legs_are_uncrossed_where_they_are_seen(degrees: float):
    problem, _, x, guess = spread(degrees)
    found = {name: other for name, *other in sides.exchanged_pairs(problem, x, guess)}
    assert ("legs, uncrossed" in found) == (degrees < 0)
    if degrees < 0:
        now, feet = (sides.feet(problem, *motion)[0] for motion in (found["legs, uncrossed"], (x, guess)))
        assert (now[:, 0] - now[:, 1])[:, 1].min() > 0.2  # left is left of right
        hips = 0.11
        assert (now[:, [1, 0]] - feet).norm(dim=-1).max() < 1.1 * hips


def test_legs_may_cross_and_people_lean_until_the_last_phase():
    values = {}
    for degrees in (-20.0, 0.0, 20.0):
        problem, _, x, guess = spread(degrees)
        problem = replace(problem, weights={"crossed": 1.0})
        leaning = replace(problem, weights={"upright": 1.0})
        assert float(rank(leaning, x, guess)[0]) > float(rank(sides.unsettled(leaning), x, guess)[0]) == 0
        values[degrees] = [float(rank(p, x, guess)[0]) for p in (problem, sides.unsettled(problem))]
    assert values[-20.0][0] > 1
    assert values[0.0][0] == values[20.0][0] == 0
    assert all(free == 0 for _, free in values.values())


def test_a_skeleton_without_pairs_of_legs_has_none_that_cross():
    skeleton = replace(load_skeleton("human"), limbs=load_skeleton("human").limbs[:1])
    kin = Kinematics(skeleton)
    assert kin.pairs.shape == (0, 2)
    assert hypotheses.leg_pairs(kin) == []
    problem, _, x, guess = spread(-20.0)
    problem = replace(problem, kin=kin, weights={"crossed": 1.0})
    assert float(rank(problem, x, guess)[0]) == 0


def test_who_stays_in_place_is_turned_around_once_more_with_time_to_settle():
    problem, root, x, guess = spread(0.0, TOWARDS_CAMERA)
    run = Run(fit.FINAL, x, guess, [{"gait": "none"}], {"final": [{}], "stride_candidates_hz": []})
    phases = tuple(Schedule(1, 2, 8, ()) for _ in fit.PHASES)
    best = fit._to_limbs(problem, run, rank(problem, x, guess), root, fit.Effort(phases, 1, 1))
    turned = [label.get("seen") for label in best.labels].index("the other way")
    assert np.degrees(float(best.guess.yaw[turned, 0]) - TOWARDS_CAMERA) % 360 == pytest.approx(180, abs=3)
    long = fit.Effort((*(replace(p, rate=n) for n, p in enumerate(phases)),), 1, 1)
    assert [s.rate for s in fit._long_enough(long, problem, root).schedules] == [0, 1, 2, 3, 3, 5, 6, 7]
    assert fit._long_enough(long, problem, replace(root, travelled=3.0)) is long


def waving(first: str, second: str):
    """A person seen from the flank who raises one hand for a second and a half, and then one for as long."""
    problem, root, x, guess = spread(0.0)
    names = problem.kin.skeleton.names
    for when, side in ((slice(0, 12), first), (slice(12, T), second)):
        guess.q[0, when, names.index(f"{side}_shoulder"), 1] = np.radians(-150)
        guess.q[0, when, names.index(f"{side}_elbow"), 1] = np.radians(-30)
    return problem, root, x, guess


def test_arms_that_change_places_are_kept_apart():
    problem, _, x, guess = waving("left", "right")
    found = {name: other for name, _, other in sides.kept_apart(problem, x, guess)}
    assert [name.split()[:2] for name in found] == [["shoulder", "before"], ["shoulder", "after"]]
    assert all(abs(float(name.split()[2]) - 1.5) <= sides.MOMENT for name in found)
    for name, raised, hanging in zip(found, ("right", "left"), ("left", "right"), strict=True):
        shoulder = {s: problem.kin.skeleton.names.index(f"{s}_shoulder") for s in ("left", "right")}
        pitch = found[name].q[0, :, :, 1].numpy()
        np.testing.assert_allclose(pitch[:, shoulder[raised]], np.radians(-150), atol=1e-5)
        np.testing.assert_allclose(pitch[:, shoulder[hanging]], 0, atol=1e-5)
    problem, _, x, guess = waving("left", "left")
    assert sides.kept_apart(problem, x, guess) == []


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
