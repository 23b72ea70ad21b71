"""Clips that are dark or hazy all over: thresholds of features, flow and networks are made for others."""

import cv2
import numpy as np

FLAT = 110.0  # of 255, between the darkest and the brightest hundredth of a clip without contrast
FULL = 190.0  # what it is brought to
BLACK = 10.0  # where its darkest hundredth lies then at most
MOST = 6.0  # times, beyond which there is nothing but noise


def stretch(frames: np.ndarray) -> float:
    """Give frames (T, H, W, 3) uint8 RGB of a clip without contrast more of it, in place; all of them and all channels
    alike, so that nothing flickers or changes its hue.

    Returns:
        By what differences were multiplied; 1 for a clip that has contrast.
    """
    some = frames[:: max(1, len(frames) // 32), ::4, ::4]
    low, high = float(np.percentile(some.min(-1), 1)), float(np.percentile(some.max(-1), 99))
    if high - low >= FLAT:
        return 1.0
    gain = min(MOST, FULL / max(high - low, 1.0))
    table = np.clip(np.rint((np.arange(256) - low) * gain + min(low, BLACK)), 0, 255).astype(np.uint8)
    for k, frame in enumerate(frames):
        frames[k] = cv2.LUT(np.ascontiguousarray(frame), table)
    return round(gain, 2)
