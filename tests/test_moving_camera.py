"""Structure from motion from several starts: the same each time, and the one that explains the tracks best."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slomo.reconstruct import moving_camera, sfm
from slomo.reconstruct.rotation_ba import RotationFit
from slomo.reconstruct.tracked_path import Epipolar, TrackedPath
from slomo.stage import Silent
from test_camera import angle_between, settings, texture
from test_tracked_path import CENTER, FOCAL, retreating

T, W, H = 24, 480, 270


def street() -> np.ndarray:
    """Frames (10, 240, 320, 3) of a camera that goes sideways before a wall behind a floor; focal length 300 px."""
    K, K_inv = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]]), np.diag([0.01, 0.01, 1])
    wall, floor = texture(600, 1600, seed=3), texture(600, 1600, seed=4)
    frames = []
    for x in np.linspace(0, 1.2, 10):
        # Plane pixels to the world: the wall stands 5 m away, the floor lies 1 m below.
        onto_wall = np.array([[1, 0, -6 - x], [0, 1, -5], [0, 0, 5.0]]) @ K_inv
        onto_floor = np.array([[1, 0, -6 - x], [0, 0, 1.0], [0, 1, 1.5]]) @ K_inv
        far, near = (
            cv2.warpPerspective(image, K @ plane, (320, 240))
            for image, plane in ((wall, onto_wall), (floor, onto_floor))
        )
        frames.append(np.where(np.arange(240)[:, None] > 119.5 + 300 / 5, near, far))
    return np.repeat(np.array(frames)[..., None], 3, -1)


def test_structure_is_the_same_each_time_and_features_are_found_once():
    frames = street()
    arguments = frames, np.zeros(frames.shape[:3], bool), np.arange(len(frames))
    options = {"refine_focal": True, "features": 1000, "overlap": 5, "seed": 1}
    found = [sfm.reconstruct_structure(*arguments, focal=330.0, **options) for _ in range(2)]
    assert all(found)
    for name, value in found[0].arrays().items():
        np.testing.assert_array_equal(value, found[1].arrays()[name])
    assert len(found[0].frames) == len(frames)
    assert angle_between(found[0].T_world_cam[:1, :3, :3], found[0].T_world_cam[:, :3, :3]).max() < 0.5
    with sfm.workspace() as folder:
        first = sfm.reconstruct_structure(*arguments, focal=330.0, folder=folder, **options)
        made = (folder / "10" / "matched").stat().st_mtime_ns
        path = found[0].T_world_cam
        second = sfm.reconstruct_structure(*arguments, focal=found[0].focal, path=path, folder=folder, **options)
        third = sfm.reconstruct_structure(*arguments, focal=330.0, folder=folder, **options)
        assert (folder / "10" / "matched").stat().st_mtime_ns == made
    assert not folder.exists()
    # The model of the path before it leaves nothing behind.
    for name, value in first.arrays().items():
        np.testing.assert_array_equal(value, third.arrays()[name])
    assert second.error_px < 1.1 * first.error_px
    assert len(second.frames) == len(frames)


@pytest.fixture(scope="module")
def clip():
    """Tracks of a camera whose true path is known, as `find_structure` takes them, and the path."""
    R, p, tracks = retreating(0, 14.0)
    T_world_cam = np.tile(np.eye(4), (T, 1, 1))
    T_world_cam[:, :3, :3], T_world_cam[:, :3, 3] = R, p
    frames = np.zeros((T, H, W, 3), np.uint8)
    turned = RotationFit(R, FOCAL, np.inf, np.zeros(0))
    shown = np.arange(T)
    taken = frames, frames[..., 0] > 0, shown / 30, tracks, shown, turned, turned, settings(FOCAL, key_every=1)
    return taken, T_world_cam


def found(monkeypatch, clip, paths: list[tuple[TrackedPath, np.ndarray]], pair: np.ndarray | None):
    """What is chosen, and what was begun with, where bundle adjustment makes other cameras of each path."""
    taken, _ = clip
    begun = []

    def solved(frames, masks, keys, *, focal, path, **options):
        begun.append("pair" if path is None else "path")
        cameras = pair if path is None else next(made for start, made in paths if start.T_world_cam is path)
        if cameras is None:
            return None
        none = np.zeros((0, 2), int)
        return sfm.Structure(keys, cameras, FOCAL, np.zeros((0, 3)), none, none, 0.3, 1.5)

    monkeypatch.setattr(moving_camera, "track_path", lambda *a, **k: [start for start, _ in paths])
    monkeypatch.setattr(sfm, "reconstruct_structure", solved)
    report = {}
    structure = moving_camera.find_structure(*taken, report, Silent())
    return structure, report.get("structure_start"), begun


def bent(T_world_cam: np.ndarray, degrees: float) -> np.ndarray:
    turned = T_world_cam.copy()
    for n, turn in enumerate(np.radians(np.linspace(0, degrees, len(turned)))):
        turned[n, :3, :3] = turned[n, :3, :3] @ cv2.Rodrigues(np.array([0, turn, 0]))[0]
    return turned


def test_the_start_that_explains_the_tracks_best_is_taken(monkeypatch, clip):
    taken, true = clip
    epipolar = Epipolar(taken[3], np.arange(T), (1, 3, 15, 30), CENTER, 0)
    cost = epipolar.cost(true, FOCAL)
    wrong, worse = bent(true, 3.0), bent(true, 10.0)
    assert cost < 0.9 * epipolar.cost(wrong, FOCAL) < 0.9**2 * epipolar.cost(worse, FOCAL)
    high = 10 * epipolar.cost(worse, FOCAL)
    freed, kept = (TrackedPath(true.copy(), FOCAL, high, 1.0) for _ in range(2))

    structure, start, begun = found(monkeypatch, clip, [(freed, wrong), (kept, true)], worse)
    np.testing.assert_array_equal(structure.T_world_cam, true)
    assert (start, begun) == ("tracks", ["path", "path", "pair"])
    structure, start, _ = found(monkeypatch, clip, [(freed, true), (kept, wrong)], worse)
    np.testing.assert_array_equal(structure.T_world_cam, true)
    assert start == "tracks"
    structure, start, _ = found(monkeypatch, clip, [(freed, worse), (kept, wrong)], true)
    np.testing.assert_array_equal(structure.T_world_cam, true)
    assert start == "pair"
    # Cameras that explain the tracks far worse than their start did are not taken at all.
    near = replace(freed, cost=cost)
    structure, start, _ = found(monkeypatch, clip, [(near, worse)], None)
    assert structure is None
    assert start is None


def test_starts_that_agree_need_no_pair(monkeypatch, clip):
    _, true = clip
    freed, kept = (TrackedPath(true.copy(), FOCAL, 1e3, 1.0) for _ in range(2))
    _, start, begun = found(monkeypatch, clip, [(freed, true), (kept, bent(true, 1e-3))], None)
    assert (start, begun) == ("tracks", ["path", "path"])
    _, _, begun = found(monkeypatch, clip, [(replace(kept, agreed=True), true)], None)
    assert begun == ["path"]
    _, _, begun = found(monkeypatch, clip, [(kept, true)], None)
    assert begun == ["path", "pair"]
    # A path whose points lie behind the camera is no start.
    _, _, begun = found(monkeypatch, clip, [(replace(kept, in_front=0.9), true)], None)
    assert begun == ["pair"]
