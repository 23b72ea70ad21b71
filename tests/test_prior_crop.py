"""The crop that the networks see: places there and back, the camera's motion taken off, the same input on both ways."""

import time

import numpy as np
import pytest

from slomo.prior import crop


def scene(h=180, w=240, seed=0):
    """rgb, mask of a disc that touches the left edge, flow: affine (the camera) plus the disc's own."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:h, :w].astype(float)
    mask = (u - 30) ** 2 + (v - 80) ** 2 < 50**2
    rgb = rng.integers(0, 255, (h, w, 3), np.uint8)
    rgb[mask] = rgb[mask] // 4 + 90
    camera = np.stack([4 + 0.02 * u - 0.01 * v, -3 + 0.015 * u + 0.03 * v], -1)
    own = np.where(mask[..., None], np.stack([2.0 + 0 * u, (v - 80) / 25], -1), 0)
    return rgb, mask, camera, own


def test_box_is_centred_on_the_mask_and_places_go_there_and_back():
    mask = np.zeros((50, 60), bool)
    mask[10:30, 20:24] = True
    box = crop.crop_box(mask)
    assert box == crop.Box(22 - 12.5, 20 - 12.5, 25.0)
    assert np.allclose(crop.to_crop(np.array([21.5, 19.5]), box, 128), 63.5)  # the middle is the middle
    uv = np.random.default_rng(0).uniform(-20, 80, (7, 3, 2))
    assert np.allclose(crop.from_crop(crop.to_crop(uv, box, 128), box, 128), uv)
    boxes = np.array([box, (3.0, 4.0, 50.0)] + 5 * [box])[:, None]
    assert np.allclose(crop.from_crop(crop.to_crop(uv, boxes, 96), boxes, 96), uv)
    with pytest.raises(ValueError, match="empty"):
        crop.crop_box(np.zeros((5, 5), bool))


@pytest.mark.parametrize("side", [40.0, 128.0, 300.5, 900.0])
def test_cut_samples_where_to_crop_says(side):
    """A picture whose values are its own coordinates: the crop holds the places of its pixels."""
    h, w = 1000, 1100
    v, u = np.mgrid[:h, :w].astype(np.float32)
    box = crop.Box(37.3, 61.8, side)
    got = crop.cut(np.stack([u, v], -1), box, 128)
    j, i = np.mgrid[:128, :128]
    assert np.abs(got - crop.from_crop(np.stack([i, j], -1), box, 128)).max() < 0.06  # cv2 has 1/32 px


def test_the_camera_s_motion_vanishes_and_the_subject_s_stays():
    _, mask, camera, own = scene()
    assert np.abs(crop.compensate(camera, mask)).max() < 1e-3
    rng = np.random.default_rng(1)
    seen = camera + own
    wrong = (rng.random(mask.shape) < 0.25) & ~mask  # something else that moves there
    seen[wrong] += (9.0, -6.0)
    assert np.abs(crop.compensate(seen, mask) - own)[~wrong].max() < 0.15


def test_without_background_the_flow_stays_as_it_is():
    flow = np.ones((32, 32, 2))
    assert np.array_equal(crop.compensate(flow, np.ones((32, 32))), flow)


def test_input_is_normalised_inside_and_nothing_outside_even_beyond_the_picture():
    rgb, mask, camera, own = scene()
    box = crop.crop_box(mask)
    assert box.x0 < 0
    x = crop.network_input(rgb, mask, camera + own, box, 128)
    assert x.shape == (6, 128, 128)
    assert x.dtype == np.float32
    inside = x[3] > 0.99
    assert np.abs(x[:3, inside].mean(1)).max() < 0.15
    assert 0.5 < x[:3, inside].std() < 1.1
    assert np.abs(x[:, x[3] == 0]).max() == 0
    scale = np.percentile(np.linalg.norm(own[mask], axis=-1), 90)
    middle = crop.to_crop(np.array([30.0, 105.0]), box, 128).round().astype(int)
    assert np.abs(x[4:, middle[1], middle[0]] - own[105, 30] / scale).max() < 0.05
    assert np.abs(crop.network_input(rgb, mask, None, box, 128)[4:]).max() == 0


def test_what_stands_still_shows_no_noise():
    rgb, mask, camera, _ = scene()
    noise = np.random.default_rng(0).normal(0, 0.02, camera.shape)
    x = crop.network_input(rgb, mask, camera + noise, crop.crop_box(mask), 128)
    assert np.abs(x[4:]).mean() < 0.1


def test_stored_crops_give_the_same_input_as_frames():
    """What a dataset keeps (a compensated crop) and what inference makes of the frame end in the same numbers."""
    rgb, mask, camera, own = scene()
    box, size = crop.crop_box(mask), 96
    m = crop.cut(mask.astype(np.float32), box, size)
    valid = crop.cut(np.ones(mask.shape, np.float32), box, size) > 0.99
    flow = crop.compensate(crop.cut((camera + own).astype(np.float32), box, size) * size / box.side, m, valid=valid)
    stored = [np.stack([x, x]) for x in (crop.cut(rgb, box, size), m, flow)]
    batch = crop.normalised(*stored)
    assert batch.shape == (2, 6, size, size)
    assert np.allclose(batch[1], crop.network_input(rgb, mask, camera + own, box, size), atol=1e-5)
    assert np.array_equal(crop.normalised(*stored[:2], None)[:, :4], batch[:, :4])


def test_a_frame_takes_milliseconds():
    rgb, mask, camera, own = scene(480, 854)
    flow, box = (camera + own).astype(np.float32), crop.crop_box(mask)
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        crop.network_input(rgb, mask, flow, box, 128)
        best = min(best, time.perf_counter() - start)
    assert best < 0.02
