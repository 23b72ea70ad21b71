"""Camera: turning cameras with known answers, Jacobian against finite differences, ground, gravity, and truth clips."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import UsageError
from slomo.packed import pack
from slomo.reconstruct import decode_stage
from slomo.reconstruct.camera import estimate_camera
from slomo.reconstruct.camera_world import CameraSettings
from slomo.reconstruct.ground import find_ground, gravity_from_lines
from slomo.reconstruct.resection import interpolate_poses
from slomo.reconstruct.stage import CameraConfig, run_camera
from slomo.stage import Artifact, Inputs, Silent

SHARED = Path(__file__).parents[2] / "shared"
CENTER = np.array([159.5, 119.5])


def texture(h: int, w: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.resize(rng.uniform(0, 1, (h // s, w // s)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        for s in (4, 16, 64)
    )
    return np.uint8(255 * np.clip(np.asarray(image) / 3, 0, 1))


def turned_views(focal: float, rotations: np.ndarray) -> np.ndarray:
    """Frames (T, 240, 320, 3) of a camera that turns by `rotations` (T, 3, 3) before a far textured wall."""
    wall, far = texture(900, 1400), 800.0
    K = np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1]])
    K_wall = np.array([[far, 0, 700], [0, far, 450], [0, 0, 1]])
    views = [cv2.warpPerspective(wall, K @ R.T @ np.linalg.inv(K_wall), (320, 240)) for R in rotations]
    return np.repeat(np.array(views)[..., None], 3, -1)


def pan(T: int, degrees: float) -> np.ndarray:
    angle = np.radians(np.linspace(0, degrees, T))
    wobble = np.radians(1.5) * np.sin(np.linspace(0, 7, T))
    return Rotation.from_euler("yx", np.column_stack([angle, wobble - wobble[0]])).as_matrix()


def angle_between(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(np.swapaxes(A, -1, -2) @ B).magnitude())


def settings(focal: float, **changes) -> CameraSettings:
    defaults = {
        "focal_std": 0.2 * focal,
        "refine_focal": True,
        "key_every": 3,
        "features": 1200,
        "overlap": 5,
        "seed": 0,
    }
    return CameraSettings(focal=focal, **(defaults | changes))


def test_panning_camera_and_focal_are_found():
    R = pan(48, 25.0)
    frames = turned_views(420.0, R)
    path = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(48) / 24, settings(277.0), Silent())
    assert path.report["mode"] == "panning"
    assert path.report["focal_observed"]
    assert path.K[0, 0] == pytest.approx(420.0, rel=0.03)
    turned = path.T_world_cam[0, :3, :3].T @ path.T_world_cam[:, :3, :3]
    assert angle_between(turned, R).max() < 0.3
    np.testing.assert_allclose(path.T_world_cam[:, :3, 3], np.tile([0, 0, 1], (48, 1)), atol=1e-9)


def test_static_camera_keeps_the_given_focal():
    rng = np.random.default_rng(0)
    view = turned_views(300.0, pan(1, 0))[0].astype(float)
    frames = np.uint8(np.clip(view + rng.normal(0, 2, (20, *view.shape)), 0, 255))
    path = estimate_camera(frames, np.zeros(frames.shape[:3], bool), np.arange(20) / 30, settings(300.0), Silent())
    assert path.report["mode"] == "static"
    assert not path.report["focal_observed"]
    assert path.K[0, 0] == 300.0
    assert np.ptp(path.T_world_cam, axis=0).max() == 0


def test_ground_is_the_low_plane_and_not_the_wall():
    rng = np.random.default_rng(1)
    tilt = Rotation.from_euler("xy", [0.3, 0.1]).as_matrix()
    looking = Rotation.from_euler("x", -100, degrees=True).as_matrix()  # along y, ten degrees down
    axes = tilt @ looking
    ground = np.column_stack([rng.uniform(-3, 3, (300, 2)), rng.normal(0, 0.01, 300)])
    wall = np.column_stack([rng.uniform(-3, 3, 500), np.full(500, 4.0), rng.uniform(0, 3, 500)])
    table = np.column_stack([rng.uniform(0, 2, (350, 2)), np.full(350, 0.7)])
    points = np.concatenate([ground, wall, table]) @ tilt.T
    centers = np.array([[0, -3.0, 1.2], [0.3, -3.0, 1.25]]) @ tilt.T
    plane = find_ground(points, np.ones(len(points)), axes, centers)
    assert plane is not None
    assert np.degrees(np.arccos(plane.normal @ tilt[:, 2])) < 0.5
    assert abs(plane.offset) < 0.02


def test_no_ground_among_few_points():
    assert find_ground(np.zeros((5, 3)), np.ones(5), np.eye(3), np.ones((2, 3))) is None


@pytest.mark.parametrize(("pitch", "roll"), [(20.0, 3.0), (5.0, -4.0), (-4.0, 1.0)])
def test_gravity_from_vertical_lines(pitch, roll):
    """A camera with a wide lens before upright bars."""
    # Looks down by pitch, and is rolled clockwise: y points down in the camera frame, z ahead.
    up = Rotation.from_euler("ZX", [-roll, pitch], degrees=True).apply([0, -1.0, 0])
    focal = 250.0
    forward = np.array([0, 0, 1.0]) - up[2] * up
    forward /= np.linalg.norm(forward)
    side = np.cross(forward, up)
    image = np.full((240, 320, 3), 120, np.uint8)
    for k, x in enumerate(np.arange(-4, 4, 0.5)):
        bar = [4 * forward + (x + dx) * side + y * up for dx, y in ((0, -9), (0, 9), (0.2, 9), (0.2, -9))]
        pixels = np.array([focal * p[:2] / p[2] + CENTER for p in bar if p[2] > 0.1])
        cv2.fillPoly(image, [np.int32(16 * pixels)], (40 + 10 * k,) * 3, cv2.LINE_AA, shift=4)
    g = gravity_from_lines(image[None], np.zeros((1, 240, 320), bool), np.eye(3)[None], focal, CENTER)
    assert np.linalg.norm(g.up - up) < np.radians(1.5)
    assert g.lines >= 5


def test_gravity_without_lines_is_the_prior_and_says_so():
    image = np.full((1, 240, 320, 3), 128, np.uint8)
    g = gravity_from_lines(image, np.zeros((1, 240, 320), bool), np.eye(3)[None], 250.0, CENTER)
    assert g.lines == 0
    assert np.degrees(g.pitch_std) > 6
    assert g.roll == pytest.approx(0.0, abs=1e-9)


def test_gravity_without_lines_knows_that_the_subject_stands_on_the_ground():
    """Feet high in the picture of a camera that, by the prior alone, would have its horizon below them."""
    image, masks = np.full((1, 240, 320, 3), 128, np.uint8), np.zeros((1, 240, 320), bool)
    masks[0, 20:60, 140:180] = True
    focal = 250.0
    high = gravity_from_lines(image, masks, np.eye(3)[None], focal, CENTER)
    feet = np.array([0.0, (59 - CENTER[1]) / focal, 1.0])
    assert feet @ high.up < 0
    assert high.pitch > gravity_from_lines(image, masks[:, ::-1], np.eye(3)[None], focal, CENTER).pitch
    # A mask that the picture's border cuts off shows no feet.
    cut = np.zeros_like(masks)
    cut[0, 20:, 140:180] = True
    none = gravity_from_lines(image, np.zeros_like(masks), np.eye(3)[None], focal, CENTER)
    assert gravity_from_lines(image, cut, np.eye(3)[None], focal, CENTER).pitch == none.pitch


def test_poses_between_are_on_the_way():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [1, 2, 3]
    T[1, :3, :3] = Rotation.from_rotvec([0, 0, 1.0]).as_matrix()
    out = interpolate_poses(np.array([2, 6]), T, np.arange(8))
    np.testing.assert_allclose(out[4, :3, 3], [0.5, 1, 1.5])
    np.testing.assert_allclose(Rotation.from_matrix(out[4, :3, :3]).as_rotvec(), [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(out[0], T[0])
    np.testing.assert_allclose(out[7], T[1])


def stage_inputs(frames: np.ndarray) -> Inputs:
    decoded = Artifact(
        npz={"frames.npz": {"frames": frames, "t": np.arange(len(frames)) / 30}}, json={"video.json": {}}
    )
    masks = Artifact(npz={"masks.npz": pack(np.zeros(frames.shape[:3], bool))})
    return Inputs(artifacts={"decode": decoded, "masks": masks})


def test_stage_with_a_given_field_of_view():
    frames = turned_views(300.0, pan(12, 0))
    out = run_camera(stage_inputs(frames), CameraConfig(fov_deg=50.0), Silent())
    assert out.npz["camera.npz"]["K"][0, 0] == pytest.approx(160 / np.tan(np.radians(25)))
    assert out.json["report.json"]["focal_source"] == "given"
    with pytest.raises(UsageError, match=r"camera\.fov_deg"):
        run_camera(stage_inputs(frames), CameraConfig(fov_deg=180.0), Silent())
    with pytest.raises(UsageError, match="'drft'"):
        run_camera(stage_inputs(frames), CameraConfig(quality="drft"), Silent())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["husky_walk", "dog_d1_008", "human_wave"])
def test_moving_camera_of_truth_clips(name):
    """Structure from motion against the truth: focal, gravity, and path after the best similarity."""
    folder = SHARED / "truth" / name
    if not folder.exists():
        pytest.skip("needs ../shared/truth")
    decoded = decode_stage.run(Inputs(files={"clip": folder / "clip.mp4"}), decode_stage.Config(), Silent())
    with np.load(folder / "masks.npz") as z:
        masks = Artifact(npz={"masks.npz": dict(z)})
    out = run_camera(Inputs(artifacts={"decode": decoded, "masks": masks}), CameraConfig(), Silent())
    with np.load(folder / "truth.npz") as z:
        K, truth = z["K"], z["T_world_cam"]
    assert out.json["report.json"]["mode"] == "moving"
    assert out.npz["camera.npz"]["K"][0, 0] == pytest.approx(K[0, 0], rel=0.03)
    T = out.npz["camera.npz"]["T_world_cam"]
    up = np.degrees(np.arccos(np.clip((T[:, 2, :3] * truth[:, 2, :3]).sum(-1), -1, 1)))
    assert up.mean() < 1.0
    a, b = T[:, :3, 3] - T[:, :3, 3].mean(0), truth[:, :3, 3] - truth[:, :3, 3].mean(0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1, 1, np.linalg.det(U @ Vt)])
    scale = (S * np.diag(D)).sum() / (a**2).sum()
    assert np.linalg.norm(b - scale * a @ (U @ D @ Vt).T, axis=-1).max() < 0.03
    assert scale == pytest.approx(truth[:, 2, 3].mean(), rel=0.03)
