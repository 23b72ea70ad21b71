"""People: the first pose of every frame, from drawn silhouettes of the skeleton itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from slomo.packed import pack
from slomo.pinhole import Intrinsics
from slomo.prior.labels import BINS
from slomo.reconstruct import fit, gaits, hypotheses, pose_track, posture, silhouette
from slomo.reconstruct.evidence import gather
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.observations import observe
from slomo.reconstruct.problem import Problem, Schedule
from slomo.reconstruct.run import Run
from slomo.reconstruct.trajectory import Guess, Trajectory
from slomo.skeleton import load_skeleton
from slomo.stage import Silent

T, FPS, W, H = 24, 8.0, 80, 120
K = Intrinsics(120, 120, 39.5, 59.5, W, H)
CENTRE = np.array([0.0, -2.2, 1.0])
TOWARDS_CAMERA = -np.pi / 2


def problem_of(
    yaw: np.ndarray, q: np.ndarray, *, skeleton: str = "human", centre: np.ndarray = CENTRE
) -> tuple[Problem, hypotheses.RootGuess]:
    """A body one unit long at the origin with headings yaw (T,) and joint angles q (T, B, 3), seen along y."""
    kin = Kinematics(load_skeleton(skeleton))
    f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
    root = hypotheses.RootGuess(np.zeros((T, 2)), 1.0, np.zeros(T), 0.0, np.zeros(T))
    guess = hypotheses.placed(kin, root, yaw[None])
    R = torch.eye(3).repeat(1, T, 1, 1)
    R[0, :, 0, 0] = R[0, :, 1, 1] = f(np.cos(yaw))
    R[0, :, 1, 0], R[0, :, 0, 1] = f(np.sin(yaw)), -f(np.sin(yaw))
    body = kin.pose(kin.shape_variables(1), guess.position, R, f(q)[None])
    M = np.eye(4)
    M[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    M[:3, 3] = centre
    Rc, c = f(M[:3, :3].T).expand(1, T, 3, 3), f(centre).expand(1, T, 3)
    a, b = (silhouette.to_camera(Rc, c, x) for x in (body.a, body.b))
    v, u = torch.meshgrid(torch.arange(float(H)), torch.arange(float(W)), indexing="ij")
    out = silhouette.outline(K, a, b, body.radii)
    sd, _ = silhouette.distances(out, u.reshape(1, -1).expand(T, -1), v.reshape(1, -1).expand(T, -1))
    mask = (sd[0].amin(-1) < 0).reshape(T, H, W).numpy()
    masks = dict(**pack(mask), quality=np.ones(T))
    flow = dict(flow=np.zeros((T - 1, H, W, 2), np.float16), consistent=np.packbits(mask[1:], axis=-1))
    camera = dict(K=np.array([[K.fx, 0, K.cx], [0, K.fy, K.cy], [0, 0, 1]]), T_world_cam=np.tile(M, (T, 1, 1)))
    obs = observe(np.arange(T) / FPS, masks, flow, camera, fps=8, subject_px=42)
    path = Trajectory(obs.t, kin.B, joint_hz=2, root_hz=2, width=8)
    return Problem(obs, kin, path, {"mask": 1.0, "keypoints": 0.5}, 0.01), root


def _track(problem: Problem, root: hypotheses.RootGuess, **options) -> pose_track.Track:
    postures, _ = hypotheses.posture_angles(problem.kin)
    start = hypotheses.placed(problem.kin, root, np.zeros((1, T)))
    x = problem.variables(1, torch.Generator().manual_seed(0))
    ring = tuple(2 * np.pi * n / pose_track.HEADINGS for n in range(pose_track.HEADINGS))
    return pose_track.tracks(problem, x, start, root, postures, turns=ring, **options)[0]


def _away(yaw: np.ndarray, true: np.ndarray | float) -> np.ndarray:
    return np.degrees(np.abs((yaw - true + np.pi) % (2 * np.pi) - np.pi))


@pytest.fixture(scope="module")
def raising() -> tuple[Problem, hypotheses.RootGuess]:
    """Arms hang, then the hands are up, then they hang again; front to the camera."""
    kin = Kinematics(load_skeleton("human"))
    postures, names = hypotheses.posture_angles(kin)
    both = postures[names.index("left_arm hand_up, right_arm hand_up")].numpy()
    q = np.zeros((T, kin.B, 3))
    q[8:16] = both
    return problem_of(np.full(T, TOWARDS_CAMERA), q)


def test_raised_hands_are_found_when_they_are_raised(raising):
    track = _track(*raising)
    shoulder = raising[0].kin.skeleton.names.index("left_shoulder")
    raised = np.abs(track.q[:, shoulder, 0])
    assert np.degrees(raised[10:14].min()) > 45
    assert np.degrees(raised[[0, 1, 2, -3, -2, -1]].max()) < 30


def test_a_person_is_seen_from_the_front_unless_asked_otherwise(raising):
    assert _away(_track(*raising).yaw, TOWARDS_CAMERA).max() < 46
    behind = _track(*raising, views=(-pose_track.AWAY,))
    assert _away(behind.yaw, -TOWARDS_CAMERA).max() < 46


@pytest.mark.parametrize("azimuth", [0.0, np.pi])
def test_the_view_decides_between_front_and_back(raising, azimuth: float):
    problem, root = raising
    apart = (2 * np.pi * np.arange(BINS) / BINS - azimuth + np.pi) % (2 * np.pi) - np.pi
    view = np.exp(-0.5 * (apart / 0.3) ** 2)
    view = 0.8 * view / view.sum() + 0.2 / BINS
    arrays = dict(frame=np.arange(T), view=np.tile(view, (T, 1)), view_path=np.full(T, azimuth))
    track = _track(problem, root, views=(gather(arrays, problem.obs, problem.kin.skeleton),))
    assert _away(track.yaw, TOWARDS_CAMERA - azimuth).max() < 46


def test_a_turn_to_the_side_is_followed():
    yaw = np.interp(np.arange(T), [8, 16], [TOWARDS_CAMERA, 0.0])
    kin = Kinematics(load_skeleton("human"))
    track = _track(*problem_of(yaw, np.zeros((T, kin.B, 3))))
    assert _away(track.yaw, yaw).mean() < 35


def test_the_cheapest_path_pays_for_changes():
    cost = np.array([[0.0, 1.0], [0.4, 0.0], [0.0, 1.0]])
    assert pose_track.viterbi(cost, np.array([[0, 0.1], [0.1, 0]])).tolist() == [0, 1, 0]
    assert pose_track.viterbi(cost, np.array([[0, 0.3], [0.3, 0]])).tolist() == [0, 0, 0]
    dear_at_last = np.array([[[0, 0.1], [0.1, 0]], [[0, 0.5], [0.5, 0]]])
    assert pose_track.viterbi(cost, dear_at_last).tolist() == [0, 0, 0]


def test_only_a_back_costs(raising):
    problem, root = raising
    yaw = np.stack([np.full(T, TOWARDS_CAMERA + turn) for turn in (0, np.pi / 2, np.pi)])
    x = problem.variables(3, torch.Generator().manual_seed(0))
    draw = problem.draw(4, 20, torch.Generator().manual_seed(0))
    state = problem.state(x, hypotheses.placed(problem.kin, root, yaw), draw, stance_weight=0.0)
    assert posture.facing(state).tolist() == pytest.approx([0, 0, 1], abs=1e-4)


def test_who_is_turned_around_is_the_reflection_in_depth(raising):
    """Every node where its opposite was, reflected in the plane through the pelvis that faces the camera; twice is as
    it was."""
    problem, root = raising
    kin, every = problem.kin, torch.arange(T)
    generator = torch.Generator().manual_seed(1)
    guess = hypotheses.placed(kin, root, np.linspace(TOWARDS_CAMERA - 0.4, TOWARDS_CAMERA + 0.9, T)[None])
    guess = replace(guess, q=0.3 * torch.randn(guess.q.shape, generator=generator), lean=guess.lean + 0.1)
    x = problem.variables(1, generator)
    x = {k: v + 0.05 * torch.randn(v.shape, generator=generator) if k[0] in "QG" else v for k, v in x.items()}
    shape = {k.removeprefix("shape."): v for k, v in x.items() if k.startswith("shape.")}

    def nodes(x: dict[str, torch.Tensor], guess: Guess) -> torch.Tensor:
        return kin.pose(shape, *problem.path(x, guess, torch.ones(1), every)).nodes[0]

    once = hypotheses.turned_around(problem, x, guess)
    before, after = nodes(x, guess), nodes(*once)
    away = before[:, 0, :2] - torch.as_tensor(CENTRE[:2], dtype=torch.float32)
    away = (away / away.norm(dim=-1, keepdim=True))[:, None]
    reflected = before[:, kin.mirror].clone()
    along = ((reflected - before[:, :1])[..., :2] * away).sum(-1, keepdim=True)
    reflected[..., :2] -= 2 * along * away
    torch.testing.assert_close(after, reflected, atol=1e-4, rtol=0)
    assert (after - before).norm(dim=-1).max() > 0.2
    torch.testing.assert_close(nodes(*hypotheses.turned_around(problem, *once)), before, atol=1e-4, rtol=0)


def test_headings_are_told_apart_by_how_far_they_are_turned(raising):
    problem, root = raising
    yaw = np.radians([170.0, -175.0, 90.0])[:, None] * np.ones(T)
    x = problem.variables(3, torch.Generator().manual_seed(0))
    run = Run(0, x, hypotheses.placed(problem.kin, root, yaw), [{}, {}, {}])
    assert np.degrees(gaits.turned(problem, run, 0).numpy()) == pytest.approx([0, 15, 80], abs=0.1)


@pytest.mark.parametrize(("far", "strides"), [(0.2, False), (1.5, True)])
def test_who_stays_in_place_takes_no_strides(raising, monkeypatch, far: float, strides: bool):
    """A squat may have the rhythm of a walk; who walks there and back has gone somewhere."""
    monkeypatch.setattr(hypotheses, "gait_grid", lambda *a, **k: [hypotheses.GaitHypothesis("walk", 1.0, 0.0)])
    problem, root = raising
    middle = np.stack([far * np.sin(np.linspace(0, np.pi, T)), np.zeros(T)], 1)
    root = replace(root, middle=middle, travelled=far / root.length, speed=np.full(T, 2 * far / (T / FPS)))
    x = problem.variables(1, torch.Generator().manual_seed(0))
    guess = hypotheses.placed(problem.kin, root, np.zeros((1, T)))
    effort = fit.Effort((Schedule(1, 4, 16, ()),) * len(fit.PHASES), candidates=4, phases_of_gait=2)
    run = fit._to_gait(problem, Run(0, x, guess, [{}], {}), torch.ones(1), root, effort, None, Silent())
    assert any(label["gait"] != "none" for label in run.labels) == strides


def test_all_evidence_tells_front_from_back():
    labels = [{"gait": "none"}, {"gait": "none", "seen": "turned around"}]
    assert fit._front_or_back(Run(3, {}, None, labels, {}))  # pyright: ignore[reportArgumentType]
    assert not fit._front_or_back(Run(3, {}, None, labels[:1], {}))  # pyright: ignore[reportArgumentType]
