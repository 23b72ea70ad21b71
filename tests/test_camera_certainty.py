"""What is said of the camera's certainty, long clips, and backgrounds that say little."""

import os
import subprocess
import sys

import numpy as np
import pytest
import safetensors.numpy
from scipy.spatial.transform import Rotation

from slomo.reconstruct import certainty, resection, scale_breaks, sfm
from slomo.reconstruct.camera import estimate_camera
from slomo.reconstruct.moving_camera import key_frames
from slomo.reconstruct.tracks import Tracks
from slomo.stage import Silent
from test_camera import pan, settings, texture, turned_views

CENTER = np.array([159.5, 119.5])


class Stop(Exception):
    """The interruption."""


def structure(noise: float, cameras: int = 5, points: int = 40) -> sfm.Structure:
    """Cameras on an arc around random points, all of which they see; px errors of `noise`."""
    rng = np.random.default_rng(3)
    X = rng.uniform(-1, 1, (points, 3))
    T = np.tile(np.eye(4), (cameras, 1, 1))
    for T_c, angle in zip(T, np.linspace(-0.3, 0.3, cameras), strict=True):
        T_c[:3, :3] = Rotation.from_euler("y", -angle).as_matrix()
        T_c[:3, 3] = [4 * np.sin(angle), 0, -4 * np.cos(angle)]
    seen = np.stack(np.meshgrid(np.arange(cameras), np.arange(points), indexing="ij"), -1).reshape(-1, 2)
    local = np.einsum("mji,mj->mi", T[seen[:, 0], :3, :3], X[seen[:, 1]] - T[seen[:, 0], :3, 3])
    xy = 300 * local[:, :2] / local[:, 2:] + CENTER + rng.normal(0, noise, (len(seen), 2))
    return sfm.Structure(np.arange(cameras), T, 300.0, X, seen, xy, noise, 1.5)


def test_derivatives_of_a_sighting_against_finite_differences():
    s = structure(0.0, cameras=3, points=4)
    _, by_pose, by_focal, by_point = certainty._linearise(s, CENTER)
    e = 1e-6

    def residual(turn=(0, 0, 0), shift=(0, 0, 0), move=(0, 0, 0), focal=0.0):
        T = s.T_world_cam.copy()
        # The turn and shift are of the points in the camera frame: exp(turn) X + shift.
        inverse = np.linalg.inv(T)
        inverse[:, :3, :] = Rotation.from_rotvec(turn).as_matrix() @ inverse[:, :3, :]
        inverse[:, :3, 3] += shift
        moved = sfm.Structure(
            s.frames, np.linalg.inv(inverse), s.focal + focal, s.points + move, s.observations, s.xy, 0.0, 1.5
        )
        return certainty._linearise(moved, CENTER)[0]

    for name, jacobian in (("turn", by_pose[..., :3]), ("shift", by_pose[..., 3:]), ("move", by_point)):
        for axis in range(3):
            step = e * np.eye(3)[axis]
            numeric = (residual(**{name: step}) - residual(**{name: -step})) / (2 * e)
            np.testing.assert_allclose(jacobian[..., axis], numeric, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(by_focal, (residual(focal=e) - residual(focal=-e)) / (2 * e), rtol=1e-5, atol=1e-6)


def test_focal_certainty_is_that_of_the_whole_bundle_adjustment():
    s = structure(0.4)
    r, by_pose, by_focal, by_point = certainty._linearise(s, CENTER)
    N, P = len(s.frames), len(s.points)
    J = np.zeros((len(r), 2, 1 + 6 * N + 3 * P))
    for row, (n, p) in enumerate(s.observations):
        J[row, :, 0] = by_focal[row]
        J[row, :, 1 + 6 * n : 7 + 6 * n] = by_pose[row]
        J[row, :, 1 + 6 * N + 3 * p : 4 + 6 * N + 3 * p] = by_point[row]
    J = J.reshape(-1, J.shape[-1])
    covariance = np.linalg.pinv(J.T @ J, rcond=1e-10) * (1.4826 * np.median(abs(r))) ** 2
    expected = np.sqrt(covariance[0, 0] * certainty._DEPENDENT)
    assert certainty.focal_std(s, CENTER) == pytest.approx(expected, rel=1e-3)


def test_focal_certainty_of_many_cameras_is_computed_from_some(monkeypatch):
    s = structure(0.4, cameras=12)
    full = certainty.focal_std(s, CENTER)
    monkeypatch.setattr(certainty, "_MOST_CAMERAS", 6)
    assert full < certainty.focal_std(s, CENTER) < 3 * full


def test_certainty_of_a_plane_is_its_spread_over_draws():
    rng = np.random.default_rng(0)
    said, tilts = [], []
    for _ in range(60):
        X = np.column_stack([rng.uniform(-2, 2, (120, 2)), rng.normal(0, 0.05, 120)])
        n, _ = certainty.fit_plane(X, np.ones(120))
        n *= np.sign(n[2])
        said.append(certainty.plane_std(X, np.ones(120), n))
        tilts.append(np.arccos(n[2]))
    assert np.mean(said) == pytest.approx(np.sqrt(np.mean(np.square(tilts))), rel=0.4)
    bent = X.copy()
    bent[:, 2] += 0.2 * np.abs(X[:, 0])  # a fold is no noise, yet makes up uncertain
    n, _ = certainty.fit_plane(bent, np.ones(120))
    assert certainty.plane_std(bent, np.ones(120), n * np.sign(n[2])) > 2 * np.mean(said)


@pytest.mark.parametrize(("seconds", "fps", "most"), [(3, 30, 31), (20, 30, 121), (60, 15, 151), (600, 12, 1201)])
def test_key_frames_are_bounded_and_near_each_other(seconds, fps, most):
    t = np.arange(seconds * fps) / fps
    keys, gaps = key_frames(t, np.arange(len(t)), 3)
    assert keys[0] == 0
    assert keys[-1] == len(t) - 1
    assert len(keys) <= most
    assert np.diff(keys).max() <= max(3, 0.5 * fps)
    assert max(gaps) * np.median(np.diff(keys)) / fps >= 1.0


def test_pairs_of_tracks():
    frame, track = np.array([0, 1, 2, 3, 1, 2, 5]), np.array([0, 0, 0, 0, 1, 1, 1])
    tracks = Tracks(frame, track, np.column_stack([frame, track]).astype(float))
    which, first, second = tracks.pairs((1, 2), np.array([0, 1, 3, 5]))
    assert sorted(map(tuple, which)) == [(0, 1), (0, 2), (1, 2), (1, 3)]
    np.testing.assert_array_equal(first[:, 1], second[:, 1])
    np.testing.assert_array_equal(np.array([0, 1, 3, 5])[which[:, 1]], second[:, 0])
    assert [list(rows) for rows in tracks.rows_by_frame(6)] == [[0], [1, 4], [2, 5], [3], [], [6]]


def test_background_that_is_nearly_all_masked_is_said():
    frames = turned_views(300.0, pan(16, 10.0))
    masks = np.ones(frames.shape[:3], bool)
    masks[:, :, :6] = False
    path = estimate_camera(frames, masks, np.arange(16) / 24, settings(300.0), Silent())
    assert path.report["mode"] == "static"
    assert "corners" in path.report["fallback"]
    assert path.report["gravity_std_deg"] > 5
    assert np.isfinite(path.T_world_cam).all()


def layers(T: int) -> np.ndarray:
    """Frames (T, 120, 160, 3) of a near strip that passes by a far one twice as fast."""
    far, near = texture(120, 480, seed=1), texture(120, 480, seed=2)
    frames = [np.vstack([far[:60, 2 * t : 2 * t + 160], near[60:, 4 * t : 4 * t + 160]]) for t in range(T)]
    return np.repeat(np.array(frames)[..., None], 3, -1)


def test_structure_from_motion_that_falls_to_pieces_is_named(monkeypatch):
    tried = []

    def pieces(frames, masks, keys, **options):
        tried.append((len(keys), options["path"] is not None))
        return None

    monkeypatch.setattr(sfm, "reconstruct_structure", pieces)
    frames = layers(45)
    path = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(45) / 30, settings(300.0), Silent())
    assert tried == [(16, True), (16, False)]  # from the tracks' path, then from a pair of frames
    assert path.report["parallax_px"] > path.report["parallax_limit_px"]
    assert path.report["mode"] == "panning"
    assert path.report["fallback"] == "structure from motion placed 0 of 16 key frames"


class Saved(Silent):
    """Progress that is interrupted right after its first checkpoint."""

    def __init__(self, state=None):
        self.state = state

    def load(self):
        return self.state

    def save(self, state) -> None:
        self.state = safetensors.numpy.load(safetensors.numpy.save(state))
        raise Stop


def test_structure_is_not_made_twice(monkeypatch):
    """Interrupted after structure from motion, the stage goes on from there."""
    frames = layers(45)
    keys = np.array([*range(0, 45, 3), 44])
    s = structure(0.3, cameras=len(keys))
    made = sfm.Structure(keys, s.T_world_cam, 300.0, s.points, s.observations, s.xy - CENTER + [79.5, 59.5], 0.3, 1.5)
    arguments = frames, np.zeros(frames.shape[:3], bool), np.arange(45) / 30, settings(300.0)
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: made)
    progress = Saved()
    with pytest.raises(Stop):
        estimate_camera(*arguments, progress)
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: pytest.fail("made again"))
    path = estimate_camera(*arguments, Saved(progress.state))
    assert path.report["mode"] == "moving"
    assert path.report["key_frames_registered"] == path.report["key_frames"] == 16
    assert path.report["fallback"] is None
    assert 0 < path.report["focal_std_px"] < 300


def test_frames_that_structure_from_motion_does_not_reach_are_named(monkeypatch):
    frames = layers(45)
    keys = np.array([*range(0, 45, 3), 44])
    s = structure(0.3, cameras=len(keys))
    made = sfm.Structure(keys, s.T_world_cam, 300.0, s.points, s.observations, s.xy, 0.3, 1.5)
    path = np.repeat(s.T_world_cam, 3, 0)[:45]
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: made)
    monkeypatch.setattr(resection, "camera_path", lambda *a: (path, np.arange(45) < 40))
    found = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(45) / 30, settings(300.0), Silent())
    assert found.report["fallback"] == "the camera of 5 of 45 frames is interpolated"


def test_a_break_in_the_scale_that_was_mended_is_said(monkeypatch):
    said: list[str] = []

    class Notes(Silent):
        def note(self, message):
            said.append(message)

    frames = layers(45)
    keys = np.array([*range(0, 45, 3), 44])
    s = structure(0.3, cameras=len(keys))
    made = sfm.Structure(keys, s.T_world_cam, 300.0, s.points, s.observations, s.xy, 0.3, 1.5)
    monkeypatch.setattr(sfm, "reconstruct_structure", lambda *a, **k: made)
    monkeypatch.setattr(scale_breaks, "mended", lambda structure, weights: (structure, [(15, 14.288)]))
    path = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(45) / 30, settings(300.0), Notes())
    assert path.report["scale_breaks"] == [{"after_frame": 15, "times": 14.288}]
    assert any("broke at 0.5 s" in message and "times 14)" in message for message in said)


def test_featureless_background_is_said():
    frames = np.full((12, 120, 160, 3), 128, np.uint8)
    path = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(12) / 24, settings(200.0), Silent())
    assert "corners" in path.report["fallback"]
    assert path.report["reprojection_error_px"] is None


def test_folders_of_killed_processes_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(sfm.tempfile, "gettempdir", lambda: str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for owner in (ended.pid, os.getpid(), "other"):
        (tmp_path / f"slomo-sfm-{owner}-x").mkdir()
    sfm._remove_orphans()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([f"slomo-sfm-{os.getpid()}-x", "slomo-sfm-other-x"])


def test_waiting_ends_the_process_and_its_errors_are_kept(tmp_path):
    def stop(seconds: float) -> None:
        if seconds > 0.2:
            raise Stop

    marker = tmp_path / "ended"
    code = f"import time, pathlib; time.sleep(20); pathlib.Path({str(marker)!r}).touch()"
    with pytest.raises(Stop):
        sfm._run([sys.executable, "-c", code], tmp_path / "errors.txt", stop)
    assert not marker.exists()
    assert sfm._run([sys.executable, "-c", "raise SystemExit('no good')"], tmp_path / "errors.txt", print) == 1
    assert "no good" in (tmp_path / "errors.txt").read_text()


def test_structure_as_arrays_and_back():
    s = structure(0.1)
    back = sfm.Structure.of(s.arrays())
    assert isinstance(back.focal, float)
    for name, x in s.arrays().items():
        np.testing.assert_array_equal(x, back.arrays()[name])
