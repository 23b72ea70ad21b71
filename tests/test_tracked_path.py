"""Cameras that are compared two by two: derivatives, and the path of a moving camera from tracks alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.reconstruct import rotation_ba
from slomo.reconstruct.tracked_path import Epipolar, TrackedPath, track_path
from slomo.reconstruct.tracks import Tracks

FOCAL, CENTER = 500.0, np.array([239.5, 134.5])


def finite_differences(linearise, R, p, focal, by_frame):
    """Derivatives by turn (and shift if `by_frame` is 6) of each of two frames, and the focal length's logarithm."""
    columns, e = [], 1e-6
    for column in range(2 * by_frame + 1):
        sides = []
        for sign in (1, -1):
            R2, p2, f2 = R.copy(), p.copy(), focal
            frame, place = divmod(column, by_frame)
            step = sign * e * np.eye(3)[place % 3]
            if frame == 2:
                f2 = focal * np.exp(sign * e)
            elif place < 3:
                R2[frame] = R[frame] @ Rotation.from_rotvec(step).as_matrix()
            else:
                p2[frame] = p[frame] + step
            sides.append(linearise(R2, p2, f2)[0])
        columns.append((sides[0] - sides[1]) / (2 * e))
    return np.stack(columns, -1)


def two_frames():
    rng = np.random.default_rng(3)
    R = Rotation.random(2, random_state=4).as_matrix()
    R[1] = R[0] @ Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    return R, rng.normal(0, 1, (2, 3)), rng.uniform(-150, 150, (2, 5, 2)), (np.zeros(5, int), np.ones(5, int))


def test_jacobian_of_a_turning_camera_against_finite_differences():
    R, p, (x, y), (i, j) = two_frames()
    _, jacobian = rotation_ba._linearise(R, FOCAL, x, y, i, j)
    slow = finite_differences(lambda R, p, f: rotation_ba._linearise(R, f, x, y, i, j), R, p, FOCAL, 3)
    np.testing.assert_allclose(jacobian, slow, rtol=1e-5, atol=1e-4)


def test_jacobian_of_the_epipolar_constraint_against_finite_differences():
    R, p, (x, y), (i, j) = two_frames()
    epipolar = object.__new__(Epipolar)
    epipolar.x, epipolar.y, epipolar.i, epipolar.j = x, y, i, j
    _, jacobian = epipolar.linearise((R, p, FOCAL))
    slow = finite_differences(lambda *state: epipolar.linearise(state), R, p, FOCAL, 6)
    np.testing.assert_allclose(jacobian, slow, rtol=1e-5, atol=1e-4)


def retreating(seed: int, degrees: float):
    """A camera that goes backwards, turns by `degrees` and sees nothing but the ground: R (T, 3, 3), p (T, 3), and its
    tracks, a tenth of them wrong."""
    rng = np.random.default_rng(seed)
    T = 24
    along = np.linspace(0, 1, T)
    p = np.column_stack([0.3 * along + 0.02 * np.sin(9 * along), 0.02 * np.cos(7 * along), -1.2 * along])
    R = Rotation.from_euler("yx", np.column_stack([degrees * along, -12 + 1.5 * np.sin(8 * along)]), degrees=True)
    ground = np.column_stack([rng.uniform(-8, 8, 1500), np.full(1500, 0.5), rng.uniform(0.6, 14, 1500)])
    return R.as_matrix(), p, tracks_of(R.as_matrix(), p, ground, rng, noise=0.15, wrong=4.0)


def tracks_of(R: np.ndarray, p: np.ndarray, things: np.ndarray, rng, *, noise: float, wrong: float) -> Tracks:
    """Tracks of `things` (N, 3) with `noise` px, every tenth of them off by `wrong` px more."""
    rows = []
    for t in range(len(R)):
        X = (things - p[t]) @ R[t]
        uv = FOCAL * X[:, :2] / X[:, 2:] + CENTER + rng.normal(0, noise, (len(X), 2))
        seen = np.flatnonzero((X[:, 2] > 0.2) & (uv >= 0).all(-1) & (uv < [480, 270]).all(-1))
        tenth = seen[seen % 10 == 0]
        uv[tenth] += rng.normal(0, wrong, (len(tenth), 2))
        rows.append((np.full(len(seen), t), seen, uv[seen]))
    return Tracks(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def paths_of(R: np.ndarray, tracks: Tracks, focal: float, *, refine_focal: bool) -> tuple[list[TrackedPath], Epipolar]:
    """The paths that the tracks give, and their correspondences."""
    keys, gaps = np.arange(len(R)), (1, 3, 8, 16)
    epipolar = Epipolar(tracks, keys, gaps, CENTER, 0)
    assert epipolar.least_shared > 20
    turning, freed = (
        rotation_ba.fit_rotations(*tracks.pairs(gaps, keys), len(keys), center=CENTER, focal=focal, refine_focal=free)
        for free in (False, True)
    )
    free = freed if refine_focal else None
    return track_path(epipolar, tracks, keys, CENTER, focal, 0, turning.R_world_cam, freed=free), epipolar


def path_of(R: np.ndarray, tracks: Tracks, focal: float, *, refine_focal: bool):
    """The best of them, the degrees by which its rotations are off at most, and the correspondences."""
    (path, *_), epipolar = paths_of(R, tracks, focal, refine_focal=refine_focal)
    return path, off_by(path, R), epipolar


def off_by(path: TrackedPath, R: np.ndarray) -> float:
    """Degrees."""
    turned = Rotation.from_matrix(path.T_world_cam[:, :3, :3]) * Rotation.from_matrix(R[0].T @ R).inv()
    return float(np.degrees(turned.magnitude()).max())


@pytest.mark.parametrize(("seed", "degrees"), [(0, 14.0), (1, -8.0), (2, 40.0)])
def test_path_before_one_plane(seed, degrees):
    """A plane, before which incremental structure from motion may take the wrong one of two motions."""
    R, p, tracks = retreating(seed, degrees)
    path, off, epipolar = path_of(R, tracks, FOCAL, refine_focal=False)
    assert off < 1.0
    assert path.focal == FOCAL
    assert path.in_front > 0.97
    truth = (p - p[0]) @ R[0]
    scale = np.linalg.norm(truth[-1]) / np.linalg.norm(path.T_world_cam[-1, :3, 3])
    assert np.linalg.norm(scale * path.T_world_cam[:, :3, 3] - truth, axis=-1).max() < 0.1
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    assert path.cost < 1.1 * epipolar.cost(T, FOCAL)


@pytest.mark.parametrize("degrees", [40.0, 60.0])
def test_a_wrong_focal_length_does_not_bend_the_path_of_a_camera_that_turns_far(degrees):
    R, _, tracks = retreating(2, degrees)
    kept, bent, _ = path_of(R, tracks, 1.2 * FOCAL, refine_focal=False)
    assert kept.focal == 1.2 * FOCAL
    found, off, _ = path_of(R, tracks, 1.2 * FOCAL, refine_focal=True)
    assert found.focal == pytest.approx(FOCAL, rel=0.08)  # so much a plane tells
    assert off < min(2.0, 0.5 * bent)


def test_a_focal_length_that_tracks_hardly_tell_is_kept():
    """Let go it would be 1.5 times the true one, at a cost that is lower by a hundredth."""
    R, _, tracks = retreating(1, -8.0)
    path, _, _ = path_of(R, tracks, 1.2 * FOCAL, refine_focal=True)
    assert path.focal == 1.2 * FOCAL


def turning_about(degrees: float, travel: float):
    """A camera that turns by `degrees` and travels next to nothing, among things all around: R (T, 3, 3), tracks."""
    rng, T, N = np.random.default_rng(0), 40, 3000
    along = np.linspace(0, 1, T)
    p = travel * np.column_stack([along, 0.1 * np.sin(7 * along), 0.3 * np.sin(5 * along)])
    R = Rotation.from_euler("yx", np.column_stack([degrees * along, -8 + 1.5 * np.sin(8 * along)]), degrees=True)
    angle, away = np.radians(rng.uniform(-40, degrees + 40, N)), rng.uniform(4, 16, N)
    height = np.where(rng.random(N) < 0.6, 1.4, rng.uniform(-2, 1.4, N))
    things = np.column_stack([away * np.sin(angle), height, away * np.cos(angle)])
    R = R.as_matrix()
    return R, tracks_of(R, p, things, rng, noise=0.05, wrong=0.0)


def test_a_camera_that_hardly_travels_is_also_sought_with_a_focal_length_of_its_own():
    """A focal length that is wrong by 8 % bends its path; which path is right, bundle adjustment will tell."""
    R, tracks = turning_about(110.0, 0.1)
    paths, _ = paths_of(R, tracks, 0.92 * FOCAL, refine_focal=True)
    bent, right = sorted(paths, key=lambda path: abs(path.focal - FOCAL), reverse=True)
    assert bent.focal == 0.92 * FOCAL
    assert off_by(bent, R) > 3.0
    assert off_by(right, R) < 1.0
    assert right.focal == pytest.approx(FOCAL, rel=0.01)
