"""Which frames the networks see, and places carried from one frame to another along the optical flow."""

import cv2
import numpy as np

Array = np.ndarray

SPAN = 1 / 15  # s between the two pictures whose motion the networks see; less is little more than noise

_AROUND = np.stack(np.meshgrid([-1, -0.5, 0, 0.5, 1], [-1, -0.5, 0, 0.5, 1]), -1).reshape(-1, 2)


def every(t: Array, fps: float) -> int:
    """Take each n-th of the frames at t (T,) s: at most `fps` a second, but three frames at least."""
    rate = (len(t) - 1) / max(float(t[-1] - t[0]), 1e-9)
    step = max(1, round(rate / fps))
    return 1 if step > len(t) // 3 else step


def spread(field: Array, size: tuple[int, int]) -> Array:
    """(H, W, 2) float32: flow (h, w, 2) on a coarser grid of a picture of `size` (W, H) px, at each of its pixels."""
    field = np.asarray(field, np.float32)
    return field if field.shape[1::-1] == size else cv2.resize(field, size, interpolation=cv2.INTER_LINEAR)


class Motion:
    """The subject's motion in the picture.

    Args:
        flow: (T-1, h, w, 2) px of the pictures, frame t -> t+1, on a grid over them. masks: (T, H, W) bool. t: (T,) s.
    """

    def __init__(self, flow: Array, masks: Array, t: Array):
        self._flow, self._masks = flow, masks
        self._apart = every(t, 1 / SPAN)

    def at(self, frame: int) -> Array:
        """(H, W, 2) float32 px from the frame to about `SPAN` later; of the last frames, what came before."""
        first = max(0, min(frame, len(self._flow) - self._apart))
        h, w = self._masks.shape[1:]
        total = spread(self._flow[first], (w, h)).copy()
        x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
        for f in range(first + 1, min(first + self._apart, len(self._flow))):
            step = spread(self._flow[f], (w, h))
            there = x + total[..., 0], y + total[..., 1]
            total += cv2.remap(step, *there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return total

    def carry(self, points: Array, source: int, target: int, reach: float) -> Array:
        """(N, 2) px in frame `target` of the points (N, 2) px of frame `source`, before or after it.

        Args:
            reach: px; the flow is averaged over the subject's pixels within about this distance.
        """
        points = np.array(points, float)
        step = 1 if target > source else -1
        for f in range(source, target, step):
            # Backwards: the flow that led here, read where the point is now.
            points += step * self._mean(f if step > 0 else f - 1, f, points, reach)
        return points

    def _mean(self, index: int, frame: int, points: Array, reach: float) -> Array:
        h, w = self._masks.shape[1:]
        uv = np.rint(points[:, None] + reach * _AROUND).astype(int)
        u, v = np.clip(uv[..., 0], 0, w - 1), np.clip(uv[..., 1], 0, h - 1)
        weight = self._masks[frame][v, u] + 1e-3
        rows, columns = self._flow[index].shape[:2]
        moved = np.asarray(self._flow[index][v * rows // h, u * columns // w], float) * weight[..., None]
        return moved.sum(1) / weight.sum(1)[:, None]
