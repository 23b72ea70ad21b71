"""Optical flow of pictures whose motion is known."""

import cv2
import numpy as np

from slomo.packed import pack
from slomo.reconstruct import subject_flow
from slomo.reconstruct.flow import dense_flow
from slomo.reconstruct.segment import blend_over_time
from test_masks import iou, moving_disc, noise


def test_flow_of_a_shift():
    image = np.uint8(noise(100, 160, 2))
    flow = dense_flow(np.array([image[10:90, 20:140], image[12:92, 17:137]]))
    middle = flow.forward[0, 20:60, 20:100].astype(float)
    np.testing.assert_allclose(np.median(middle, axis=(0, 1)), [3, -2], atol=0.1)
    np.testing.assert_allclose(np.median(flow.backward[0, 20:60, 20:100].astype(float), axis=(0, 1)), [-3, 2], atol=0.1)
    assert flow.consistent[0, 20:60, 20:100].mean() > 0.95


def test_chained_flow_and_the_frames_between():
    frames, masks = moving_disc(8)
    flow = dense_flow(frames)
    inner = cv2.erode(masks[6].astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    np.testing.assert_allclose(np.median(flow.chain(6, 0)[inner], axis=0), [-12, 0], atol=0.04 * 12)
    np.testing.assert_allclose(np.median(flow.chain(0, 6)[np.roll(inner, -12, 1)], axis=0), [12, 0], atol=0.04 * 12)
    layers = {t: masks[t].astype(np.float32) for t in (0, 2, 4, 6, 7)}
    filled = np.stack([*blend_over_time(layers, flow, lambda f: None, neighbours=1)])
    assert iou(filled > 0.5, masks).min() > 0.9


def swinging_legs(T: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Two legs 5 px wide that swing against each other before a textured background: frames, and masks of each leg."""
    ground, coat = noise(120, 200, 4), 0.5 * noise(120, 200, 5)
    y, x = np.mgrid[:120, :200]
    frames, legs = [], []
    for t in range(T):
        picture, each = ground.copy(), []
        for start, speed in ((80.0, 5.0), (130.0, -3.0)):
            leg = (abs(x - start - speed * t) < 2.5) & (y > 30) & (y < 100)
            picture[leg] = np.roll(coat, round(speed * t), axis=1)[leg]
            each.append(leg)
        frames.append(np.uint8(np.clip(picture, 0, 255)))
        legs.append(each)
    return np.array(frames), np.array(legs)


def test_a_closer_look_tells_how_legs_move():
    frames, legs = swinging_legs()
    whole = dense_flow(frames)
    arrays = {"flow": whole.forward, "consistent": pack(whole.consistent)["packed"]}
    closer = arrays | subject_flow.closer(frames, legs.any(1))
    field, home = subject_flow.merged(closer, 0)
    for leg, speed in zip(legs[0, :, 40:90:2, ::2], (5, -3), strict=True):
        off = [np.median(abs(f[20:45][leg] - [speed, 0]).max(-1)) for f in (whole.forward[0], field)]
        assert off[1] < 0.5 < off[0]
        assert home[20:45][leg].mean() > 0.8
    outside = ~cv2.dilate(legs[0].any(0).astype(np.uint8), np.ones((9, 9)))[::2, ::2].astype(bool)
    np.testing.assert_array_equal(field[outside], whole.forward[0][outside])
    np.testing.assert_array_equal(home[outside], whole.consistent[0][outside])


def test_frames_without_a_subject_and_one_too_small_for_a_closer_look():
    frames, legs = swinging_legs()
    whole = dense_flow(frames)
    arrays = {"flow": whole.forward, "consistent": pack(whole.consistent)["packed"]}
    masks = legs.any(1)
    masks[1] = False
    speck = np.zeros_like(masks)
    speck[:, 50:53, 50:53] = True
    for seen, known in ((masks, [False, False, True]), (speck, [False] * 3)):
        closer = arrays | subject_flow.closer(frames, seen)
        for t in range(3):
            field, home = subject_flow.merged(closer, t)
            assert (field != whole.forward[t]).any() == known[t]
            assert known[t] or (home == whole.consistent[t]).all()
