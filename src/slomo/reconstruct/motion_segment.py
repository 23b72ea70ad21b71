"""Segmenter without any network: what moves against the background, closed off from the picture's border.

The background's motion between two frames is taken as a homography (RANSAC); what the flow has beyond it is the
residual. The score of a pixel is the least total change of that residual along any path to the border (the geodesic
distance of Wang, Shen and Porikli, CVPR 2015). A static post has the ground's motion at its foot, so a path runs up
the post at little cost however large its parallax is at the top; a body that moves is closed off all around.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from slomo.reconstruct.colour import ColourModel, cut, to_lab
from slomo.reconstruct.flow import Flow
from slomo.reconstruct.segment import Masks, Report, blend_over_time, component_at, no_subject

_SIDE = 256  # px, longer side at which motion is looked at


@dataclass(frozen=True)
class MotionSegmenter:
    """Motion, then colour.

    Attributes:
        every: motion and colour are looked at in every n-th frame; flow fills the frames between.
        gap: frames over which motion is taken, either way.
        least_motion: px (at 256), score that the subject must reach in some frames.
        rounds: times that the colours are learned again from the silhouettes.
    """

    every: int = 2
    gap: int = 4
    least_motion: float = 1.5
    rounds: int = 2
    name: str = "motion"

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        T, H, W = frames.shape[:3]
        size = (round(W * _SIDE / max(H, W)), round(H * _SIDE / max(H, W)))
        small = shrink_flow(flow, size)
        keys = sorted({*range(0, T, self.every), T - 1})
        score = {}
        for i, k in enumerate(keys):
            score[k] = motion_score(small, k, self.gap)
            progress(0.3 * (i + 1) / len(keys))
        top = {k: float(np.quantile(d, 0.98)) for k, d in score.items()}
        strength = float(np.quantile(list(top.values()), 0.75))
        if strength < self.least_motion:
            raise no_subject(
                f"nothing moves against the background by more than {strength:.1f} px in {self.gap} frames"
            )
        # A moment of rest has a weak score everywhere: it is not stretched to full scale, its neighbours speak for it.
        layers = {k: np.clip(d / max(top[k], 0.5 * strength), 0, 1).astype(np.float32) for k, d in score.items()}
        moving = blend_over_time(layers, small, lambda f: progress(0.3 + 0.1 * f), neighbours=3)

        prior = {k: cv2.resize(moving[k], (W, H), interpolation=cv2.INTER_LINEAR) for k in keys}
        body = {k: component_at(prior[k] > 0.5) for k in keys}
        for turn in range(self.rounds):
            model = _colours(frames, body, prior)
            for i, k in enumerate(keys):
                body[k] = _refine(frames[k], prior[k], body[k], model)
                progress(0.4 + 0.5 * (turn + (i + 1) / len(keys)) / self.rounds)
        probability = blend_over_time(
            {k: m.astype(np.float32) for k, m in body.items()}, flow, lambda f: progress(0.9 + 0.1 * f)
        )
        masks = np.stack([component_at(p > 0.5) for p in probability])
        if not masks.any():
            raise no_subject("what moves has no colours of its own")
        return Masks(masks, {"motion_px": strength, "motion_gap_frames": self.gap})


def shrink_flow(flow: Flow, size: tuple[int, int]) -> Flow:
    """The flow at `size` (width, height) px, in px of that size."""
    factor = size[0] / flow.forward.shape[2]

    def smaller(fields: np.ndarray) -> np.ndarray:
        shape = (len(fields), size[1], size[0], 2)
        out = np.empty(shape, np.float32)
        for t, field in enumerate(fields):
            out[t] = factor * cv2.resize(field.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return out

    consistent = [cv2.resize(c.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) for c in flow.consistent]
    return Flow(smaller(flow.forward), smaller(flow.backward), np.array(consistent, bool))


def motion_score(flow: Flow, t: int, gap: int) -> np.ndarray:
    """(H, W) px: how far the motion of each pixel of frame t is closed off from that of the border, by the lesser of
    the answers for `gap` frames ahead and back: flow errs on one side only of what covers and uncovers background."""
    last = len(flow.forward)
    targets = {max(0, t - gap), min(last, t + gap)} - {t}
    near = {u for u in targets if abs(u - t) == min(gap, last)} or {max(targets, key=lambda u: abs(u - t))}
    scores = [border_distance(residual_motion(flow.chain(t, u)) * gap / abs(u - t)) for u in sorted(near)]
    return np.minimum.reduce(scores)


def residual_motion(field: np.ndarray) -> np.ndarray:
    """(H, W, 2) px: a flow field less the homography that most of it follows."""
    h, w = field.shape[:2]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    p = np.stack([x, y], -1)
    pick = np.s_[4::6, 4::6]
    cv2.setRNGSeed(0)
    model, _ = cv2.findHomography(p[pick].reshape(-1, 2), (p + field)[pick].reshape(-1, 2), cv2.RANSAC, 0.7)
    if model is None:
        return field - np.median(field, axis=(0, 1))
    return p + field - cv2.perspectiveTransform(p.reshape(-1, 1, 2), model).reshape(h, w, 2)


def border_distance(field: np.ndarray, *, step_cost: float = 0.002) -> np.ndarray:
    """(H, W) px: least sum of |change of `field`| along a path to the picture's border.

    Border pixels that themselves stick out of the border's usual residual start with what they stick out, so that a
    subject cut by the border stays apart. `step_cost` (px) breaks ties towards short paths.
    """
    h, w = field.shape[:2]
    index = np.arange(h * w).reshape(h, w)
    links = [
        (index[:, :-1], index[:, 1:]),
        (index[:-1], index[1:]),
        (index[:-1, :-1], index[1:, 1:]),
        (index[:-1, 1:], index[1:, :-1]),
    ]
    a, b = (np.concatenate([link[side].ravel() for link in links]) for side in (0, 1))
    values = field.reshape(-1, 2)
    cost = np.linalg.norm(values[a] - values[b], axis=-1) + step_cost
    border = np.concatenate([index[0], index[-1], index[1:-1, 0], index[1:-1, -1]])
    size = np.linalg.norm(values[border], axis=-1)
    start = np.where(size > 4 * np.quantile(size, 0.75) + 0.5, size, 0.0) + 1e-6
    root = h * w
    rows, cols = np.concatenate([a, np.full(len(border), root)]), np.concatenate([b, border])
    graph = csr_matrix((np.concatenate([cost, start]), (rows, cols)), shape=(root + 1, root + 1))
    return dijkstra(graph, directed=False, indices=root)[:root].reshape(h, w)


def _colours(frames: np.ndarray, body: dict[int, np.ndarray], prior: dict[int, np.ndarray]) -> ColourModel:
    """Colours inside the silhouettes against those in a wide ring around them, over the clip."""
    lab, inside, outside = [], [], []
    for k, mask in body.items():
        reach = max(9, round(0.5 * np.sqrt(max(mask.sum(), 1))) | 1)
        ring = (cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0) & ~mask
        core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        take = (core | ring)[::2, ::2]
        lab.append(to_lab(frames[k])[::2, ::2][take])
        inside.append(core[::2, ::2][take])
        outside.append((ring & (prior[k] < 0.4))[::2, ::2][take])
    return ColourModel.learn(*(np.concatenate(x) for x in (lab, inside, outside)))


def _refine(frame: np.ndarray, prior: np.ndarray, body: np.ndarray, model: ColourModel) -> np.ndarray:
    """Silhouette from motion (`prior` in [0, 1]) and colour, near to where it was thought to be."""
    colour = np.clip(cv2.GaussianBlur(model(to_lab(frame)), (0, 0), 1.0), -4.0, 4.0)
    logit = 10.0 * (prior - 0.42) + colour
    probability = 1.0 / (1.0 + np.exp(-logit))
    probability[prior < 0.12] = 0.0
    return component_at(cut(frame, probability), body)
