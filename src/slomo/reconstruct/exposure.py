"""Clips that are dark or hazy all over: thresholds of features, flow and networks are made for others."""

import cv2
import numpy as np

FLAT = 110.0  # of 255, between the darkest and the brightest hundredth of a clip without contrast
WHOLE = 1.5  # times that, between the thousandths: a small subject that stands out is contrast
FULL = 190.0  # what the former is brought to
BLACK = 10.0  # where the darkest hundredth lies then at most
MOST = 6.0  # times, beyond which there is nothing but noise


def stretch(frames: np.ndarray) -> float:
    """Give frames (T, H, W, 3) uint8 RGB of a clip without contrast more of it, in place; by one line for all frames
    and channels, so that nothing flickers. Colours grow stronger with it.

    Returns:
        By what differences were multiplied; 1 for a clip that has contrast.
    """
    some = frames[:: max(1, len(frames) // 32), ::4, ::4]
    least, low = np.percentile(some.min(-1), [0.1, 1]).tolist()
    high, most = np.percentile(some.max(-1), [99, 99.9]).tolist()
    if high - low >= FLAT or most - least >= WHOLE * FLAT:
        return 1.0
    gain = min(MOST, FULL / max(high - low, 1.0))
    # What even that leaves flat stays as bright as it was in the middle.
    black = min(low, BLACK) if gain < MOST else float(np.clip((high + low - gain * (high - low)) / 2, 0, 255))
    table = np.clip(np.rint((np.arange(256) - low) * gain + black), 0, 255).astype(np.uint8)
    for k, frame in enumerate(frames):
        frames[k] = cv2.LUT(np.ascontiguousarray(frame), table)
    return round(gain, 2)
