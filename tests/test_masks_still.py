"""The segmenter for a camera that stands still, on drawn frames with known answers."""

import cv2
import numpy as np
import pytest

from slomo.errors import InvalidData
from slomo.packed import unpack
from slomo.reconstruct.background import SHADOW
from slomo.reconstruct.flow import dense_flow
from slomo.reconstruct.instances import Choice
from slomo.reconstruct.segment import Masks
from slomo.reconstruct.stage import MasksConfig, _segmented, run_masks
from slomo.reconstruct.still_segment import StillSegmenter, _darkest_shade, _trimmed
from slomo.stage import Silent
from test_masks import inputs, iou, moving_disc


def test_still_segmenter_finds_what_a_network_would_miss():
    frames, masks = moving_disc(40, speed=3.0, camera=0.0)
    rng = np.random.default_rng(0)
    frames = np.uint8(np.clip(frames + rng.normal(0, 3, frames.shape), 0, 255))
    found = run_masks(inputs(frames), MasksConfig(), Silent())
    assert found.json["report.json"]["segmenter"] == "still"
    assert iou(unpack(found.npz["masks.npz"]), masks).min() > 0.85
    with pytest.raises(InvalidData, match="this one moves"):
        run_masks(inputs(moving_disc()[0]), MasksConfig(segmenter="still"), Silent())
    rests = np.uint8(np.clip(frames[:1] + rng.normal(0, 3, frames.shape), 0, 255))
    with pytest.raises(InvalidData, match="nothing"):
        run_masks(inputs(rests), MasksConfig(segmenter="still"), Silent())


@pytest.mark.parametrize(("missed", "taken"), [(0.1, "network"), (0.4, "still")])
def test_a_network_that_misses_much_of_what_differs_is_not_taken(missed: float, taken: str):
    frames, truth = moving_disc(40, speed=3.0, camera=0.0)
    rows = np.cumsum(truth.sum(2), 1) / np.maximum(truth.sum((1, 2)), 1)[:, None]
    seen = truth & (rows > missed)[:, :, None]

    class Network:
        name = "network"

        def segment(self, *_) -> Masks:
            return Masks(seen, np.ones(len(seen)))

    flow = dense_flow(frames)
    segmenter, found = _segmented(Network(), MasksConfig(), Choice(), frames, flow, Silent())
    assert segmenter.name == taken
    assert iou(found.masks, truth).mean() > 0.85


def test_still_segmenter_keeps_a_foot_whose_leg_looks_like_the_ground():
    frames, masks = moving_disc(40, speed=3.0, camera=0.0)
    foot = np.zeros_like(masks)
    for t in range(40):
        x = round(60 + 3.0 * t)
        foot[t, 88:97, x : x + 8] = True  # 8 px below the ellipse
    frames[foot] = 255
    found = StillSegmenter().segment(frames, dense_flow(frames), lambda f: None).masks
    assert (found & foot).sum() > 0.8 * foot.sum()
    assert iou(found, masks | foot)[foot.any((1, 2))].min() > 0.8


def test_still_segmenter_keeps_a_coat_that_looks_like_shade_and_leaves_the_shadow_out():
    """What is darker may be either: the coat's colours are not those of darkened ground."""
    frames, masks = moving_disc(40, speed=3.0, camera=0.0)
    ground = np.median(frames, axis=0)
    y, x = np.mgrid[: masks.shape[1], : masks.shape[2]]
    shadow, coat = np.zeros_like(masks), np.zeros_like(masks)
    for t in range(40):
        coat[t] = masks[t] & (np.abs(x - 60 - 3.0 * t) < 14)
        shadow[t] = (((x - 60 - 3.0 * t) / 24) ** 2 + ((y - 84) / 9) ** 2 < 1) & ~masks[t]
        frames[t][shadow[t]] = 0.75 * ground[shadow[t]]
    frames[coat] = 45
    found = StillSegmenter().segment(frames, dense_flow(frames), lambda f: None).masks
    assert (found & coat).sum() > 0.95 * coat.sum()
    assert (found & shadow).sum() < 0.25 * shadow.sum()
    assert iou(found, masks).mean() > 0.85


def legs_and_shadow() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """An ellipse with two legs of the ground's own hue, darker than the shadow at their feet: frames, and masks of the
    whole, the legs and the shadow."""
    frames, masks = moving_disc(40, speed=3.0, camera=0.0)
    ground = np.median(frames, axis=0)
    y, x = np.mgrid[: masks.shape[1], : masks.shape[2]]
    legs, shadow = np.zeros_like(masks), np.zeros_like(masks)
    for t in range(40):
        u = x - 60 - 3.0 * t
        legs[t] = ((np.abs(u - 12) < 3) | (np.abs(u + 12) < 3)) & (y > 66) & (y < 104) & ~masks[t]
        shadow[t] = ((u / 40) ** 2 + ((y - 102) / 8) ** 2 < 1) & ~masks[t] & ~legs[t]
        frames[t][shadow[t]] = 0.7 * ground[shadow[t]]
        frames[t][legs[t]] = 0.42 * ground.mean((0, 1))
    return frames, masks | legs, legs, shadow


def test_still_segmenter_keeps_legs_that_are_darker_than_the_shadow():
    frames, masks, legs, shadow = legs_and_shadow()
    found = StillSegmenter().segment(frames, dense_flow(frames), lambda f: None).masks
    assert (found & legs).sum() > 0.75 * legs.sum()
    assert (found & shadow).sum() < 0.25 * shadow.sum()
    assert iou(found, masks).mean() > 0.85


def test_how_dark_shadows_are_is_read_where_they_show_the_ground():
    frames, masks, _, _ = legs_and_shadow()
    background = np.median(frames, axis=0)
    spread = np.zeros(background.shape[:2], np.float32)
    body = dict(enumerate(masks))
    assert _darkest_shade(frames, body, background, spread) == pytest.approx(0.7 - 0.08, abs=0.04)
    plain = np.where(masks[..., None], np.uint8(40), np.uint8(120)) * np.ones(3, np.uint8)
    assert _darkest_shade(plain, body, np.full_like(background, 120), spread) == SHADOW[0]


def test_rim_that_shows_more_of_the_background_is_trimmed():
    ground = np.full((40, 60, 3), 90, np.uint8)
    truth = np.zeros((40, 60), bool)
    truth[12:28, 15:45] = True
    sharp = np.where(truth[..., None], np.uint8(210), ground)
    frame = cv2.GaussianBlur(sharp, (0, 0), 1.0)
    fat = cv2.dilate(truth.astype(np.uint8), np.ones((3, 3))) > 0
    trimmed = _trimmed(fat, frame, ground.astype(np.float32))
    np.testing.assert_array_equal(trimmed[5:35, 16:44], truth[5:35, 16:44])  # corners are rounder than that
    np.testing.assert_array_equal(_trimmed(truth, frame, ground.astype(np.float32))[:, 16:44], truth[:, 16:44])


def test_still_segmenter_leaves_out_a_small_companion():
    frames, masks = moving_disc(40, speed=3.0, camera=0.0)
    young = np.zeros_like(masks)
    y, x = np.mgrid[: masks.shape[1], : masks.shape[2]]
    for t in range(40):
        young[t] = ((x - 60 - 3.0 * t) / 14) ** 2 + ((y - 96) / 10) ** 2 < 1  # 6 px below the ellipse
    frames[young] = [230, 230, 60]
    found = StillSegmenter().segment(frames, dense_flow(frames), lambda f: None).masks
    assert (found & young).sum() < 0.1 * young.sum()
    assert iou(found, masks).min() > 0.8
