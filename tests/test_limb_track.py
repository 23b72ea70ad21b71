"""Limbs that are elsewhere for a while, from drawn silhouettes of the skeleton itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.reconstruct import hypotheses, limb_track
from slomo.reconstruct.evidence import gather
from slomo.reconstruct.kinematics import Kinematics
from slomo.skeleton import load_skeleton
from test_fit_people import K, T, problem_of

CENTRE = np.array([0.0, -4.5, 0.6])  # of a camera that sees the right flank
UP = slice(8, 17)  # frames with a raised paw
RAISED = {"shoulder": -40.0, "elbow": -85.0}


def standing(side: str | None, raised: dict[str, float] = RAISED):
    """A dog that stands and raises its front paw of that side for a second: the problem, and the root's guess."""
    kin = Kinematics(load_skeleton("quadruped"))
    q = np.zeros((T, kin.B, 3))
    for joint, degrees in raised.items() if side else ():
        q[UP, kin.skeleton.names.index(f"front_{side}_{joint}"), 1] = np.radians(degrees)
    return problem_of(np.zeros(T), q, skeleton="quadruped", centre=CENTRE)


def at_rest(problem, root):
    """Variables and guess of the rest pose."""
    return problem.variables(1, torch.Generator().manual_seed(0)), hypotheses.placed(
        problem.kin, root, np.zeros((1, T))
    )


def paws(problem, x, guess) -> np.ndarray:
    """(T, 4) heights of the paws, in body lengths."""
    shape = {k.removeprefix("shape."): v for k, v in x.items() if k.startswith("shape.")}
    position, R, q = problem.path(x, guess, x["shape.log_length"].exp(), torch.arange(T))
    return problem.kin.pose(shape, position, R, q).nodes[0][:, problem.kin.contacts, 2].numpy()


def test_a_raised_paw_is_found_while_it_is_raised():
    problem, root = standing("right")
    x, guess = at_rest(problem, root)
    found = limb_track.by_limb(problem, x, guess, leave=limb_track.PLAINLY)
    assert found is not None
    height = paws(problem, *found) - paws(problem, x, guess)
    names = [limb.name for limb in problem.kin.skeleton.limbs]
    front = height[:, [n for n, name in enumerate(names) if "front" in name]]
    assert front[10:15].max(1).min() > 0.25
    assert front[10:15].min(1).max() < 0.05  # one of the two: a silhouette does not tell which
    assert np.abs(height[[0, 1, 2, 3, -4, -3, -2, -1]]).max() < 0.05
    assert np.abs(height[:, [n for n, name in enumerate(names) if "hind" in name]]).max() < 0.05


def test_a_folded_wrist_leaves_the_joints_above_it_where_they_are():
    problem, root = standing("right", {"wrist": 100.0})
    x, guess = at_rest(problem, root)
    found = limb_track.by_limb(problem, x, guess, leave=limb_track.LIKELY)
    assert found is not None
    turned = np.degrees(np.abs(found[1].q[0, :, :, 1].numpy()))
    names = problem.kin.skeleton.names
    wrists = turned[:, [names.index(f"front_{side}_wrist") for side in ("left", "right")]]
    assert wrists[10:15].max(1).min() > 60
    assert wrists[[0, 1, 2, -3, -2, -1]].max() < 5
    assert turned[:, [names.index(f"front_{s}_{j}") for s in ("left", "right") for j in RAISED]].max() < 5


@pytest.mark.parametrize("side", ["left", "right"])
def test_key_points_tell_which_paw_it_is(side):
    problem, root = standing(side)
    x, guess = at_rest(problem, root)
    names = problem.kin.skeleton.names
    q = guess.q.clone()
    for joint, degrees in RAISED.items():
        q[0, UP, names.index(f"front_{side}_{joint}"), 1] = np.radians(degrees)
    shape = {k.removeprefix("shape."): v for k, v in x.items() if k.startswith("shape.")}
    body = problem.kin.pose(shape, guess.position, torch.eye(3).expand(1, T, 3, 3), q)
    points = ["front_left_paw", "front_right_paw", "front_left_wrist", "front_right_wrist"]
    X = body.nodes[0][:, [names.index(n) for n in points]].numpy() - CENTRE
    uv = np.stack([K.fx * X[..., 0] / X[..., 1] + K.cx, -K.fy * X[..., 2] / X[..., 1] + K.cy], -1)
    arrays = dict(
        frame=np.arange(T), keypoint_names=np.array(points), keypoints=uv,
        keypoint_confidence=np.full(uv.shape[:2], 0.8), keypoint_side=np.full(4, 0.9),
    )  # fmt: skip
    problem = replace(problem, said=gather(arrays, problem.obs, problem.kin.skeleton))
    found = limb_track.by_limb(problem, x, guess, leave=limb_track.PLAINLY)
    assert found is not None
    height = paws(problem, *found) - paws(problem, x, guess)
    which = [limb.name for limb in problem.kin.skeleton.limbs].index(f"front_{side}")
    assert height[10:15, which].min() > 0.25
    assert np.abs(np.delete(height, which, axis=1)).max() < 0.05


def test_limbs_that_are_where_they_are_seen_stay_there():
    problem, root = standing(None)
    assert limb_track.by_limb(problem, *at_rest(problem, root), leave=limb_track.LIKELY) is None
