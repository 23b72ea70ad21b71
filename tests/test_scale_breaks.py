"""Parts of a structure from motion that are of unlike scale are told from what merely looks so, and mended."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.reconstruct.scale_breaks import mended
from slomo.reconstruct.sfm import Structure

CAMERAS = 24
PITCH = 15.0  # degrees that the cameras look down


def structure(*, height=lambda n: 1.0, table=(), speed=lambda n: 0.3, seed=0) -> Structure:
    """Cameras that go sideways over plain ground, z = 0, and see what of it lies before them, with some noise; where
    `table` says so they see a table top at half their height instead."""
    rng = np.random.default_rng(seed)
    R = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ Rotation.from_euler("x", -PITCH, degrees=True).as_matrix()
    x = np.cumsum([speed(n) for n in range(CAMERAS)])
    T = np.tile(np.eye(4), (CAMERAS, 1, 1))
    T[:, :3, :3], T[:, 0, 3] = R, x
    T[:, 2, 3] = [height(n) for n in range(CAMERAS)]
    points, observations = [], []
    for n in range(CAMERAS):
        for _ in range(25):
            level = 0.5 if n in table else 0.0
            place = [x[n] + rng.uniform(-1, 1), rng.uniform(2, 6), level]
            # Seen by its neighbours, too, as tracks are that last a few key frames.
            observations += [(m, len(points)) for m in range(n, min(n + 3, CAMERAS)) if (m in table) == (n in table)]
            points.append(place + rng.normal(0, 0.004, 3))
    rows = np.array(observations)
    return Structure(np.arange(0, 3 * CAMERAS, 3), T, 300.0, np.array(points), rows, np.zeros((len(rows), 2)), 0.3, 1.5)


def broken(s: Structure, after: int, scale: float) -> Structure:
    """The structure with everything up to camera `after` smaller, seen from that camera."""
    T, points = s.T_world_cam.copy(), s.points.copy()
    pivot = T[after, :3, 3].copy()
    first = np.full(len(points), CAMERAS)
    np.minimum.at(first, s.observations[:, 1], s.observations[:, 0])
    T[: after + 1, :3, 3] = pivot + scale * (T[: after + 1, :3, 3] - pivot)
    points[first <= after] = pivot + scale * (points[first <= after] - pivot)
    return Structure(s.frames, T, s.focal, points, s.observations, s.xy, s.error_px, s.least_angle)


@pytest.mark.parametrize("scale", [0.07, 0.5, 3.0])
def test_a_break_is_mended(scale):
    whole = structure()
    mine, found = mended(broken(whole, 9, scale), np.ones(len(whole.points)))
    assert [frame for frame, _ in found] == [27]
    assert found[0][1] == pytest.approx(1 / scale, rel=0.05)
    away = np.linalg.norm(mine.T_world_cam[:, :3, 3] - whole.T_world_cam[:, :3, 3], axis=-1)
    assert away.max() < 0.05 * 0.3 * CAMERAS
    assert np.median(abs(mine.points[:, 2])) < 0.05


def test_two_breaks_are_mended():
    whole = structure()
    mine, found = mended(broken(broken(whole, 7, 0.4), 15, 0.3), np.ones(len(whole.points)))
    assert [frame for frame, _ in found] == [21, 45]
    step = np.linalg.norm(np.diff(mine.T_world_cam[:, :3, 3], axis=0), axis=-1)
    np.testing.assert_allclose(step, 0.3, rtol=0.1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"table": range(10, CAMERAS)},  # the layer below seems to come up
        {"table": range(10, CAMERAS), "speed": lambda n: 0.3 if n < 12 else 0.0},  # and the camera stops over it
        {"height": lambda n: 1.0 + 0.06 * n},  # a camera that is lifted
        {"speed": lambda n: 0.1 if n < 10 else 0.5},  # one that begins to run
    ],
)
def test_what_is_no_break_stays(options):
    s = structure(**options)
    same, found = mended(s, np.ones(len(s.points)))
    assert found == []
    assert same is s


def test_without_ground_nothing_is_said():
    s = structure()
    few = Structure(s.frames, s.T_world_cam, s.focal, s.points[:5], s.observations[:5], s.xy[:5], 0.3, 1.5)
    assert mended(few, np.ones(5)) == (few, [])
