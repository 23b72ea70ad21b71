"""Silhouettes agreed on over time: what a network says of a point is carried along the point's own track."""

from collections.abc import Iterator, Mapping
from functools import lru_cache

import cv2
import numpy as np

from slomo.reconstruct.colour import to_lab
from slomo.reconstruct.flow import Flow, sample
from slomo.reconstruct.segment import Report
from slomo.threads import cores, in_order

REACH = 6  # frames either way from which a vote is taken at least
_SPREAD = 3.0  # frames in which a vote loses its weight
_SHADE = 15.0  # of Lab (0 to 255): what has another colour is another point


def vote_over_time(
    layers: Mapping[int, np.ndarray], frames: np.ndarray, flow: Flow, progress: Report
) -> Iterator[np.ndarray]:
    """Probability (H, W) float32 of each frame in turn, from those (H, W) of the frames in `layers`.

    Each pixel is followed both ways for as long as the flow leads there and home again. What the network said of the
    same point in those frames counts the less the further they are and the more its colour has changed. So a tail or a
    paw that is missed in some frames and found in others is found, and a limb that flow loses is left to its own frame.
    Computed on the flow's grid.

    Args:
        frames: (T, H, W, 3) uint8 RGB.
    """
    T, (height, width) = len(frames), flow.forward.shape[1:3]
    # Frames between layers that lie further apart, or beyond the first or last one, still need one in reach.
    at = sorted(layers)
    reach = max(REACH, int(np.diff(at).max(initial=0)), *([at[0], T - 1 - at[-1]] if at else []))
    to_cells = np.array([width / flow.size[0], height / flow.size[1]], np.float32)

    def small(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)

    @lru_cache(2 * reach + 2 + cores())
    def seen(k: int) -> tuple[np.ndarray | None, np.ndarray]:
        return small(layers[k]) if k in layers else None, small(to_lab(frames[k]))

    @lru_cache(2 * reach + 2 + cores())
    def step(k: int, ahead: bool) -> tuple[np.ndarray, np.ndarray]:
        """Cells from frame k to the next (or from k + 1 back), and where that leads home again."""
        there = (flow.forward if ahead else flow.backward)[k].astype(np.float32) * to_cells
        home = flow.consistent[k].astype(np.float32)
        return there, home if ahead else sample(home, there)

    def voted(t: int) -> np.ndarray:
        own, shade = seen(t)
        total = np.zeros((height, width), np.float32) if own is None else own.copy()
        weight = np.full((height, width), 1e-9 if own is None else 1.0, np.float32)
        for direction in (1, -1):
            offset, lasting = np.zeros((height, width, 2), np.float32), np.ones((height, width), np.float32)
            for n in range(1, reach + 1):
                k = t + direction * n
                if not 0 <= k < T:
                    break
                there, home = step(k - 1, True) if direction > 0 else step(k, False)
                lasting *= sample(home, offset) > 0.5
                offset += sample(there, offset)
                said, colour = seen(k)
                if said is None:
                    continue
                change = ((sample(colour, offset) - shade) ** 2).sum(-1)
                w = lasting * np.exp(-0.5 * ((n / _SPREAD) ** 2 + change / _SHADE**2), dtype=np.float32)
                # A frame that the network has not seen is filled from its neighbours even where flow is in doubt.
                w = np.maximum(w, 1e-3 * np.exp(-n / _SPREAD)) if own is None else w
                total += w * sample(said, offset)
                weight += w
        return cv2.resize(total / weight, flow.size, interpolation=cv2.INTER_LINEAR)

    for t, probability in enumerate(in_order(voted, range(T))):
        yield probability
        progress((t + 1) / T)
