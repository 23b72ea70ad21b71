"""The ray-caster against answers known in closed form."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from slomo.raycast import GROUND, SKY, Light, Part, Scene, intrinsics, look_at

SIZE = (160, 120)
K = intrinsics(*SIZE, hfov=0.9)
EYE = np.array([0.3, -4.0, 1.1])
T_WORLD_CAM = look_at(EYE, np.array([0.0, 0.0, 0.6]))


def rays() -> np.ndarray:
    """(H, W, 3) unit directions in the world, by the pinhole formula."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    d = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x, float)], -1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True) @ T_WORLD_CAM[:3, :3].T


def sphere_distance(d: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Distance along unit rays from EYE to a sphere, inf where they miss."""
    b = d @ (centre - EYE)
    disc = b**2 - (centre - EYE) @ (centre - EYE) + radius**2
    return np.where(disc > 0, b - np.sqrt(np.maximum(disc, 0)), np.inf)


@pytest.fixture(scope="module")
def ball() -> Part:
    mesh = trimesh.creation.icosphere(5, 0.5)
    return Part(mesh.vertices, mesh.faces, np.array([0.8, 0.3, 0.2]), id=7)


def test_depth_and_silhouette_of_a_sphere(ball):
    scene = Scene({"ball": ball})
    centre = np.array([0.1, 0.2, 0.7])
    pose = np.eye(4)
    pose[:3, 3] = centre
    scene.move({"ball": pose})
    image = scene.render(K, T_WORLD_CAM, SIZE)
    d = rays()
    t = sphere_distance(d, centre, 0.5)
    well_inside = np.isfinite(sphere_distance(d, centre, 0.49))
    assert well_inside.sum() > 500
    depth = t * (d @ T_WORLD_CAM[:3, 2])
    np.testing.assert_allclose(image.depth[..., 0][well_inside], depth[well_inside], atol=4e-3)
    seen = image.mask(7)
    assert seen[well_inside].all()
    assert not seen[~np.isfinite(sphere_distance(d, centre, 0.505))].any()
    np.testing.assert_allclose(
        np.linalg.norm(image.points[seen][:, 0] - centre, axis=-1), 0.5, atol=2e-3
    )  # the points that were hit lie on the sphere


def test_points_project_back_to_their_pixels(ball):
    image = Scene({"ball": ball}).render(K, T_WORLD_CAM, SIZE)
    hit = image.ids[..., 0] != SKY
    camera = (image.points[..., 0, :][hit] - T_WORLD_CAM[:3, 3]) @ T_WORLD_CAM[:3, :3]
    xy = (camera @ K.T)[:, :2] / camera[:, 2:]
    y, x = np.nonzero(hit)
    near = camera[:, 2] < 20  # float32 near the horizon
    np.testing.assert_allclose(xy[near], np.stack([x, y], 1)[near], atol=0.02)


def test_ground_plane_and_sky(ball):
    scene = Scene({"ball": ball})
    far_away = np.eye(4)
    far_away[0, 3] = 1e4
    scene.move({"ball": far_away})
    image = scene.render(K, T_WORLD_CAM, SIZE)
    d = rays()
    down = d[..., 2] < -1e-3
    assert (image.ids[..., 0][down] == GROUND).all()
    assert (image.ids[..., 0][d[..., 2] > 0] == SKY).all()
    t = -EYE[2] / d[..., 2]
    close = down & (t < 30)
    np.testing.assert_allclose(image.depth[..., 0][close], (t * (d @ T_WORLD_CAM[:3, 2]))[close], rtol=1e-4)


def test_box_silhouette_equals_the_hull_of_its_projected_corners():
    mesh = trimesh.creation.box((0.6, 0.8, 0.5))
    part = Part(mesh.vertices, mesh.faces, np.array([0.5, 0.5, 0.5]), smooth=False)
    scene = Scene({"box": part}, Light(ground="none"))
    pose = trimesh.transformations.rotation_matrix(0.5, [0.2, 0.3, 1.0])
    pose[:3, 3] = [0.1, 0.0, 0.7]
    scene.move({"box": pose})
    image = scene.render(K, T_WORLD_CAM, SIZE, supersample=2)
    corners = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    camera = (corners - T_WORLD_CAM[:3, 3]) @ T_WORLD_CAM[:3, :3]
    xy = (camera @ K.T)[:, :2] / camera[:, 2:]
    hull = ConvexHull(xy)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    outside = (np.stack([x, y], -1) @ hull.equations[:, :2].T + hull.equations[:, 2]).max(-1)  # px, signed
    mask = image.mask(1)
    assert mask[outside < -0.75].all()
    assert not mask[outside > 0.75].any()
    covered = (image.ids == 1).mean(-1).sum()
    assert abs(covered - hull.volume) < 0.01 * hull.volume  # "volume" of a plane hull is its area


def test_deformed_vertices_equal_the_rigid_pose(ball):
    pose = np.eye(4)
    pose[:3, 3] = [0.2, 0.1, 0.9]
    rigid, deformed = Scene({"ball": ball}), Scene({"ball": ball})
    rigid.move({"ball": pose})
    deformed.move({"ball": ball.vertices + pose[:3, 3]})
    a, b = (s.render(K, T_WORLD_CAM, SIZE) for s in (rigid, deformed))
    assert (a.ids == b.ids).mean() > 0.999
    assert np.abs(a.rgb.astype(int) - b.rgb).mean() < 0.1


def test_the_shadow_falls_away_from_the_sun(ball):
    scene = Scene({"ball": ball}, Light(sun=(1.0, 0.0, 1.0), ground="tiles"))
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 1.0]
    scene.move({"ball": pose})
    top = look_at(np.array([0.0, -0.01, 12.0]), np.zeros(3))
    image = scene.render(intrinsics(*SIZE, hfov=0.5), top, SIZE)
    ground = image.ids[..., 0] == GROUND
    xy = image.points[..., 0, :2]
    dark = (
        np.linalg.norm(xy - [-1.0, 0.0], axis=-1) < 0.3
    )  # the ball's centre, along the sun's ray, meets z = 0 at x = -1
    lit = np.linalg.norm(xy - [1.0, 0.0], axis=-1) < 0.3
    assert image.rgb[ground & dark].mean() < 0.8 * image.rgb[ground & lit].mean()


def test_the_picture_agrees_with_full_supersampling(ball):
    scene = Scene({"ball": ball})
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.2, 0.7]
    scene.move({"ball": pose})
    full = scene.render(K, T_WORLD_CAM, SIZE, supersample=2).rgb.astype(int)
    one = scene.render(K, T_WORLD_CAM, SIZE).rgb
    picture = scene.picture(K, T_WORLD_CAM, SIZE)
    assert np.abs(picture - full).mean() < 0.6 * np.abs(one - full).mean()
