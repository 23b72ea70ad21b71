"""Dense optical flow between consecutive frames and what follows from it: consistency, warping, chains.

Flow (H, W, 2) px is x then y: the pixel p of the first image is at p + flow[p] in the second. A clip's flow is kept
on a grid of half as many cells either way, which is the one that it is computed on, and is spread when it is used.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.prior.frames import spread
from slomo.threads import in_order


@dataclass(frozen=True)
class Flow:
    """Flow of a clip of T frames of H x W pixels, on a grid of h x w cells that covers them.

    Attributes:
        forward: (T-1, h, w, 2) float16, px of the frames, frame t -> t+1.
        backward: (T-1, h, w, 2) float16, px of the frames, frame t+1 -> t.
        consistent: (T-1, h, w) bool, at cells of frame t: forward then backward leads home.
        size: (W, H) px of the frames.
    """

    forward: np.ndarray
    backward: np.ndarray
    consistent: np.ndarray
    size: tuple[int, int]

    def step(self, source: int, target: int) -> np.ndarray:
        """(H, W, 2) float32 px from frame `source` to its neighbour `target`."""
        return spread(self.forward[source] if target > source else self.backward[target], self.size)

    def chain(self, source: int, target: int) -> np.ndarray:
        """(H, W, 2) float32 px from frame `source` to any frame `target`, by composing the steps between."""
        total = np.zeros((self.size[1], self.size[0], 2), np.float32)
        direction = 1 if target > source else -1
        for t in range(source, target, direction):
            total += sample(self.step(t, t + direction), total)
        return total


def dense_flow(frames: np.ndarray, progress=lambda fraction: None) -> Flow:
    """DIS flow (Kroeger et al., ECCV 2016; medium preset) of (T, H, W, 3) uint8 RGB frames, both ways."""
    height, width = frames.shape[1:3]
    cells = ((width + 1) // 2, (height + 1) // 2)
    shape = (len(frames) - 1, cells[1], cells[0])
    forward, backward = np.empty((*shape, 2), np.float16), np.empty((*shape, 2), np.float16)
    consistent = np.empty(shape, bool)

    def both_ways(t: int) -> None:
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        a, b = (cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames[t : t + 2])
        there, back = dis.calc(a, b, None), dis.calc(b, a, None)  # type: ignore[call-overload]
        forward[t], backward[t] = (cv2.resize(f, cells, interpolation=cv2.INTER_AREA) for f in (there, back))
        home = consistent_px(there, back).astype(np.float32)
        consistent[t] = cv2.resize(home, cells, interpolation=cv2.INTER_AREA) > 0.5

    for t, _ in enumerate(in_order(both_ways, range(shape[0]))):
        progress((t + 1) / shape[0])
    return Flow(forward, backward, consistent, (width, height))


def consistent_px(there: np.ndarray, back: np.ndarray, zoom: float = 1.0) -> np.ndarray:
    """(H, W) bool. Forward-backward check with the bound of Sundaram, Brox and Keutzer (ECCV 2010), equation 5.

    Its constant is in pixels of a picture that was not magnified by `zoom`.
    """
    home = sample(back, there)
    error = np.sum((there + home) ** 2, axis=-1)
    return error < 0.01 * (np.sum(there**2, axis=-1) + np.sum(home**2, axis=-1)) + 0.5 * zoom**2


def sample(image: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """`image` (H, W[, C]) read bilinearly at p + offset[p] for every pixel p; the border value extends outwards."""
    h, w = offset.shape[:2]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    return cv2.remap(image, x + offset[..., 0], y + offset[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def inside(offset: np.ndarray) -> np.ndarray:
    """(H, W) bool: p + offset[p] lies in the image."""
    h, w = offset.shape[:2]
    x, y = np.arange(w) + offset[..., 0], np.arange(h)[:, None] + offset[..., 1]
    return (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
