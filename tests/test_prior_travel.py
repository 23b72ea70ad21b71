"""The view by the way that a subject goes, with known answers: a box on the ground seen by a known camera."""

import numpy as np
import pytest

from slomo.ground_path import ground_path
from slomo.pinhole import Intrinsics
from slomo.prior.clip import CENTRES, view_over_clip
from slomo.prior.evidence import travelled
from slomo.prior.travel import view_of_travel
from slomo.raycast import look_at

K = Intrinsics(400, 400, 159.5, 89.5, 320, 180)
T, FPS = 45, 15.0
t = np.arange(T) / FPS


def seen(places, *, eye=(0.0, -4.0, 1.0), size=0.5, jitter=0.0):
    """T_world_cam (T, 4, 4) of a camera that follows, and boxes (T, 4) of upright squares at places (T, 2)."""
    rng = np.random.default_rng(0)
    cameras, boxes = [], []
    for x, y in places:
        T_world_cam = look_at(np.array(eye), np.array([x, y, size / 2]))
        corners = np.array([[x, y, 0.0], [x, y, size]])
        c = (corners - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
        u, v = K.fx * c[:, 0] / c[:, 2] + K.cx, K.fy * c[:, 1] / c[:, 2] + K.cy
        v = v + jitter * rng.standard_normal(2)
        boxes.append([u[0] - 20, v[1], u[0] + 20, v[0] - 0.5])
        cameras.append(T_world_cam)
    return np.array(cameras), np.array(boxes)


def walked(places, **options):
    cameras, boxes = seen(places, **options)
    path = ground_path(t, np.arange(T), K, cameras, boxes, quality=np.ones(T), empty=np.zeros(T, bool))
    return path, view_of_travel(path, t, np.arange(T), cameras, "quadruped"), cameras


def away(p, azimuth):
    """(F,) rad from the likeliest bin."""
    return np.abs(np.mod(CENTRES[p.argmax(1)] - azimuth + np.pi, 2 * np.pi) - np.pi)


def test_the_path_and_the_size_are_those_of_the_box():
    places = np.stack([0.6 * t - 0.8, 0.2 * t], 1)
    path, _, _ = walked(places)
    assert np.abs(path.middle - places).max() < 0.02
    assert path.height == pytest.approx(0.5, rel=0.03)
    assert np.abs(path.velocity - [0.6, 0.2]).max() < 0.02


@pytest.mark.parametrize(
    ("velocity", "azimuth"),
    # the camera looks along y: who goes to its right shows the right side, who comes nearer the front
    [((0.6, 0.0), -90), ((-0.6, 0.0), 90), ((0.0, -0.6), 0), ((0.0, 0.6), 180)],
)
def test_who_goes_somewhere_faces_there(velocity, azimuth):
    places = np.outer(t - t.mean(), velocity)
    _, p, _ = walked(places, eye=(0.0, -8.0, 1.5), jitter=0.3)
    middle = slice(10, 35)  # straight ahead of the camera
    assert away(p, np.radians(azimuth))[middle].max() < np.radians(16)
    assert np.allclose(p.sum(1), 1, atol=1e-5)
    assert p.min() > 1e-4  # it may go backwards


def test_who_stands_says_nothing():
    _, p, _ = walked(np.zeros((T, 2)), jitter=0.5)
    assert p.max() < 2 / 36


def test_what_travel_tells_of_who_walks_and_who_stands():
    _, walks, _ = walked(np.outer(t - t.mean(), [1.2, 0.0]), eye=(0, -9, 1.5))
    _, stands, _ = walked(np.zeros((T, 2)), jitter=0.5)
    assert travelled(walks).mean() > 0.7
    assert travelled(stands).mean() < 0.1


def test_a_doubtful_path_says_little():
    places = np.outer(t, [0.6, 0.0])
    sharp, blurred = (walked(places, jitter=j, eye=(0, -9, 0.7))[1].max(1).mean() for j in (0.1, 2.5))
    assert blurred < 0.6 * sharp


def test_the_clip_s_view_leans_towards_the_way_of_travel():
    """A network that is off by 20 degrees in every frame is corrected, one that sees a standing subject is not."""
    said = np.exp(-0.5 * ((np.mod(CENTRES + np.radians(70) + np.pi, 2 * np.pi) - np.pi) / np.radians(15)) ** 2)
    said = np.tile(said / said.sum() + 1e-4, (T, 1))
    _, p, _ = walked(np.outer(t - t.mean(), [0.6, 0.0]), eye=(0, -9, 1.5))
    path = view_over_clip(said, p, t=t)[1]
    assert np.abs(np.degrees(path) + 90)[10:35].max() < 15
    _, p, _ = walked(np.zeros((T, 2)))
    assert np.abs(np.degrees(view_over_clip(said, p, t=t)[1]) + 70).max() < 6
