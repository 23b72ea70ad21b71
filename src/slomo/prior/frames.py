"""Which frames the networks see, and places carried from one frame to another along the optical flow."""

import numpy as np

Array = np.ndarray

_AROUND = np.stack(np.meshgrid([-1, -0.5, 0, 0.5, 1], [-1, -0.5, 0, 0.5, 1]), -1).reshape(-1, 2)


def every(t: Array, fps: float) -> int:
    """Take each n-th of the frames at t (T,) s: at most `fps` a second, but three frames at least."""
    rate = (len(t) - 1) / max(float(t[-1] - t[0]), 1e-9)
    step = max(1, round(rate / fps))
    return 1 if step > len(t) // 3 else step


class Motion:
    """The subject's motion in the picture.

    Args:
        flow: (T-1, H, W, 2) px, frame t -> t+1. masks: (T, H, W) bool.
    """

    def __init__(self, flow: Array, masks: Array):
        self._flow, self._masks = flow, masks

    def at(self, frame: int) -> Array | None:
        """(H, W, 2) float32 px from the frame to the next; of the last one, what came before; None for a lone frame."""
        if not len(self._flow):
            return None
        return np.asarray(self._flow[min(frame, len(self._flow) - 1)], np.float32)

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
        moved = np.asarray(self._flow[index][v, u], float) * weight[..., None]
        return moved.sum(1) / weight.sum(1)[:, None]
