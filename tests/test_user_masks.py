"""Masks that the user gives: in which formats, and in which order."""

import cv2
import numpy as np
import pytest

from slomo.reconstruct.flow import Flow
from slomo.reconstruct.user_masks import UserMasks

H, W = 90, 160
LOSS = {"jpg": [cv2.IMWRITE_JPEG_QUALITY, 60], "webp": [cv2.IMWRITE_WEBP_QUALITY, 60]}
FLOW = Flow(*(np.zeros(0),) * 3, size=(W, H))  # not looked at


def squares(count: int) -> np.ndarray:
    """(T, H, W) bool: a square that goes right."""
    masks = np.zeros((count, H, W), bool)
    for i, mask in enumerate(masks):
        mask[30:61, 10 + 5 * i : 41 + 5 * i] = True
    return masks


def segment(path, count: int) -> np.ndarray:
    return UserMasks(path).segment(np.zeros((count, H, W, 3), np.uint8), FLOW, lambda fraction: None).masks


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "jpg", "jpeg", "webp"])
@pytest.mark.parametrize("colour", [255, (255, 255, 255)])
def test_compression_leaves_no_mark(tmp_path, suffix, colour):
    """What rings around the edges of JPEG and WebP is no subject."""
    truth = squares(8)
    for i, mask in enumerate(truth):
        picture = (mask[..., None] * np.uint8(colour)).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{i}.{suffix}"), picture, LOSS.get(suffix, []))
    np.testing.assert_array_equal(segment(tmp_path, 8), truth)


def test_any_value_counts_where_nothing_is_lost(tmp_path):
    truth = squares(8)
    for i, mask in enumerate(truth):
        cv2.imwrite(str(tmp_path / f"{i}.png"), mask.astype(np.uint8))  # 1, as annotation tools number their objects
    np.testing.assert_array_equal(segment(tmp_path, 8), truth)


def test_pictures_come_in_the_order_of_the_numbers_in_their_names(tmp_path):
    truth = squares(12)
    for i, mask in enumerate(truth):
        cv2.imwrite(str(tmp_path / f"cat 2 frame{i}.png"), 255 * mask.astype(np.uint8))
    np.testing.assert_array_equal(segment(tmp_path, 12), truth)
