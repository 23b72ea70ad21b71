"""Clips that the camera is hard to follow through: blank frames, cuts, key frames with nothing in common, no ground."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import StageFailed, UsageError
from slomo.reconstruct import resection, rotation_ba, sfm
from slomo.reconstruct.camera import estimate_camera
from slomo.reconstruct.camera_world import GROUND_SUPPORT, GUESSED_SCALE
from slomo.reconstruct.ground import find_ground
from slomo.reconstruct.stage import CameraConfig
from slomo.reconstruct.tracked_path import Epipolar, track_path
from slomo.reconstruct.tracks import Tracks, background_tracks
from slomo.stage import Silent
from test_camera import angle_between, pan, settings, texture, turned_views
from test_camera_certainty import layers, structure

TURNS = pan(36, 18.0)
CENTER = np.array([159.5, 119.5])


@pytest.fixture(scope="module")
def panned() -> np.ndarray:
    return turned_views(300.0, TURNS)


class Notes(Silent):
    def __init__(self):
        self.said: list[str] = []

    def note(self, message):
        self.said.append(message)


def camera(frames: np.ndarray, masks: np.ndarray | None = None, progress=None, **changes):
    masks = np.zeros(frames.shape[:3], bool) if masks is None else masks
    options = settings(300.0, refine_focal=False, **changes)
    return estimate_camera(frames, masks, np.arange(len(frames)) / 30, options, progress or Silent())


def off_by(path, seen: slice = slice(None)) -> float:
    """Degrees, at most, by which the camera is turned otherwise than it was, in the frames `seen`."""
    R = path.T_world_cam[seen, :3, :3]
    return float(angle_between(R[0].T @ R, TURNS[seen][0].T @ TURNS[seen]).max())


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("blank", [[19], [18], [17, 18, 19, 20]])
def test_tracks_go_on_after_blank_frames(panned, blank, level):
    frames = panned.copy()
    frames[blank] = level
    path = camera(frames)
    assert path.report["mode"] == "panning"
    assert path.report["fallback"] is None
    assert off_by(path) < 0.2


def test_tracks_go_on_after_frames_of_something_else(panned):
    """A flash, a single frame of another picture, dark noise, and a mask that covers all of one frame."""
    rng = np.random.default_rng(0)
    frames, masks = panned.copy(), np.zeros(panned.shape[:3], bool)
    frames[7] = np.clip(3.0 * frames[7], 0, 255)
    frames[14] = texture(240, 320, seed=7)[..., None]
    frames[22] = rng.normal(20, 8, frames[22].shape).clip(0, 255)
    masks[29] = True
    path = camera(frames, masks)
    assert path.report["fallback"] is None
    assert off_by(path) < 0.2


@pytest.mark.parametrize("blank", [[0], [35], [0, 1, 2, 3, 34, 35]])
def test_blank_frames_at_the_ends_hold_the_camera(panned, blank):
    frames = panned.copy()
    frames[blank] = 0
    path = camera(frames)
    assert path.report["fallback"] is None
    seen = np.setdiff1d(np.arange(36), blank)
    assert off_by(path, slice(seen[0], seen[-1] + 1)) < 0.1
    for t in blank:
        nearest = seen[np.abs(seen - t).argmin()]
        np.testing.assert_allclose(path.T_world_cam[t], path.T_world_cam[nearest], atol=1e-9)


def test_blank_key_frames_do_not_keep_the_path_of_a_moving_camera_from_being_tracked(monkeypatch):
    tried = []

    def nothing(frames, masks, keys, **options):
        tried.append((keys.tolist(), options["path"] is not None))

    monkeypatch.setattr(sfm, "reconstruct_structure", nothing)
    frames = layers(45)
    frames[[21, 44]] = 0
    camera(frames)
    keys = [*range(0, 21, 3), 20, *range(24, 43, 3), 43]
    assert tried == [(keys, True), (keys, False)]


def test_a_cut_is_named(panned):
    frames = panned.copy()
    frames[18:] = frames[18:, ::-1]
    notes = Notes()
    path = camera(frames, progress=notes)
    assert path.report["mode"] == "panning"
    assert path.report["fallback"] == "the background's tracks break at 0.6 s"
    assert any("break at 0.6 s: how the camera before is turned" in said for said in notes.said)
    still = np.repeat(frames[[0, -1]], 12, axis=0)
    path = camera(still)
    assert path.report["mode"] == "static"
    assert path.report["fallback"] == "the background's tracks break at 0.4 s"
    twice = np.concatenate([still, still])
    assert camera(twice).report["fallback"] == "the background's tracks break 3 times, first at 0.4 s"


def test_no_corner_is_followed_across_a_cut(panned):
    frames = np.concatenate([panned[:5], panned[:5, ::-1]])
    tracks = background_tracks(frames, np.zeros(frames.shape[:3], bool))
    assert not np.intersect1d(tracks.track[tracks.frame < 5], tracks.track[tracks.frame >= 5]).size


def test_pairs_of_frames_without_any_corner():
    tracks = Tracks(np.array([0, 1]), np.array([0, 0]), np.zeros((2, 2)))
    which, _, _ = tracks.pairs((1,), np.array([0, 1, 4]))
    assert which.tolist() == [[0, 1]]
    empty = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    assert [len(x) for x in empty.pairs((1, 2), np.array([0, 4]))] == [0, 0, 0]


def test_no_frame_turns_without_correspondences():
    nothing = np.zeros((0, 2), int), np.zeros((0, 2)), np.zeros((0, 2))
    fit = rotation_ba.fit_rotations(*nothing, 3, center=CENTER, focal=300.0, refine_focal=True)
    np.testing.assert_array_equal(fit.R_world_cam, np.tile(np.eye(3), (3, 1, 1)))
    assert fit.focal == 300.0
    assert fit.focal_std == np.inf
    assert len(fit.residual) == 0


def test_no_path_from_tracks_that_are_in_two_key_frames_only():
    rng = np.random.default_rng(0)
    frame, track = (
        np.repeat([0, 1, 1, 2], 20),
        np.r_[np.arange(20), np.arange(20), np.arange(20, 40), np.arange(20, 40)],
    )
    tracks, keys = Tracks(frame, track, rng.uniform(0, 200, (80, 2))), np.arange(3)
    epipolar = Epipolar(tracks, keys, (1,), CENTER, 0)
    assert epipolar.least_shared == 20
    still = np.tile(np.eye(3), (3, 1, 1))
    freed = rotation_ba.RotationFit(still, 300.0, np.inf, np.zeros(0))
    assert track_path(epipolar, tracks, keys, CENTER, 300.0, 0, still, freed=freed) == []


@pytest.mark.parametrize("every", [44, 1000])
def test_two_key_frames_with_parallax(monkeypatch, every):
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: None)
    path = camera(layers(45), key_every=every)
    assert path.report["key_frames"] == 2
    assert "placed 0 of 2 key frames" in path.report["fallback"]


def test_key_frames_that_share_nothing_leave_the_camera_as_it_is():
    """Two key frames 80 degrees apart."""
    frames = turned_views(300.0, pan(40, 80.0))
    path = camera(frames, key_every=100)
    assert path.report["reprojection_error_px"] is None
    assert "tracks break" in path.report["fallback"]
    assert np.isfinite(path.T_world_cam).all()


LOOKING = Rotation.from_euler("x", -102, degrees=True).as_matrix()  # along y, twelve degrees down


def test_a_wall_from_the_front_is_no_ground():
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-3, 3, 500), rng.normal(4, 0.01, 500), rng.uniform(-2, 3, 500)])
    centers = np.array([[0, -3.0, 1.2], [0.3, -3.0, 1.25]])
    plane = find_ground(wall, np.ones(500), LOOKING, centers)
    assert plane is None or plane.support < GROUND_SUPPORT


def test_a_ground_that_ends_up_above_a_camera_is_none():
    """Of two layers that are one within the tolerance, the lower one alone is below the low camera."""
    rng = np.random.default_rng(1)
    low = np.column_stack([rng.uniform(-3, 3, 300), rng.uniform(3, 9, 300), np.zeros(300)])
    high = np.column_stack([rng.uniform(-3, 3, 300), rng.uniform(3, 9, 300), np.full(300, 0.03)])
    points = np.concatenate([low, high])
    plane = find_ground(points, np.ones(600), LOOKING, np.array([[0, -3.0, 0.005], [0, -3.0, 2.0]]))
    assert plane is None or plane.offset < 0.005
    assert find_ground(points, np.ones(600), LOOKING, np.array([[0, -3.0, 1.0], [0, -3.0, 2.0]])) is not None


def test_points_above_the_camera_give_no_height(monkeypatch):
    frames = layers(45)
    keys = np.array([*range(0, 45, 3), 44])
    s = structure(0.3, cameras=len(keys))
    made = sfm.Structure(keys, s.T_world_cam, 300.0, s.points - [0, 3, 0], s.observations, s.xy, 0.3, 1.5)
    sent = np.repeat(s.T_world_cam, 3, 0)[:45]
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: made)
    monkeypatch.setattr(resection, "camera_path", lambda *a: (sent, np.ones(45, bool)))
    notes = Notes()
    path = camera(frames, progress=notes)
    assert path.report["mode"] == "moving"
    assert path.report["fallback"] == "no ground is seen under the camera"
    assert path.report["scale_source"] == GUESSED_SCALE
    assert "camera: no ground is seen under the camera: its height is a guess" in notes.said
    assert path.T_world_cam[:, 2, 3].min() > 0.5
    assert path.T_world_cam[:, 2, 3].mean() == pytest.approx(1.0)
    # Steps are not turned round, and no longer than a few heights.
    moved = np.linalg.inv(path.T_world_cam[0]) @ path.T_world_cam[-1]
    was = np.linalg.inv(sent[0]) @ sent[-1]
    scale = (moved[:3, 3] @ was[:3, 3]) / (was[:3, 3] @ was[:3, 3])
    assert 0.5 < scale < 5


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("fov_deg", value) for value in (-1.0, 0.5, 180.0, float("nan"))),
        *(("default_fov_deg", value) for value in (0.0, 171.0)),
        *(("key_every", -1), ("features", 0), ("overlap", 0), ("seed", -1), ("seed", 2**31)),
    ],
)
def test_parameters_out_of_range_are_refused(name, value):
    with pytest.raises(UsageError, match=rf"camera\.{name}: is .* \(valid: \d+ to \d+\)"):
        CameraConfig(**{name: value})


@pytest.mark.parametrize(("status", "raises"), [(-11, False), (-6, False), (-9, True), (1, True)])
def test_a_crash_of_structure_from_motion_is_a_clip_without_a_model(monkeypatch, status: int, raises: bool):
    def ended(command: list[str], errors: Path, waiting: object) -> int:
        errors.write_text("no memory")
        return status

    monkeypatch.setattr(sfm, "_run", ended)
    frames, masks = np.zeros((4, 8, 8, 3), np.uint8), np.zeros((4, 8, 8), bool)

    def made():
        return sfm.reconstruct_structure(
            frames, masks, np.arange(4), focal=10.0, refine_focal=False, features=100, overlap=3, seed=0
        )

    if raises:
        with pytest.raises(StageFailed, match=f"status {status}: no memory"):
            made()
    else:
        assert made() is None
