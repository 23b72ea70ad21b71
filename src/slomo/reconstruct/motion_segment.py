"""Segmenter without any network: what moves against the background, closed off from the picture's border.

The background's motion between two frames is taken as a homography (RANSAC); what the flow has beyond it is the
residual. The score of a pixel is the least total change of that residual along any path to the border (the geodesic
distance of Wang, Shen and Porikli, CVPR 2015). A static post has the ground's motion at its foot, so a path runs up
the post at little cost however large its parallax is at the top; a body that moves is closed off all around.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from slomo.reconstruct.background import Overlay
from slomo.reconstruct.colour import ColourModel, cut, learn_colours, to_lab
from slomo.reconstruct.flow import Flow
from slomo.reconstruct.instances import Choice, follow
from slomo.reconstruct.segment import Masks, Report, blend_over_time, component_at, grown, no_subject
from slomo.reconstruct.tracks import background_tracks

_SIDE = 256  # px, longer side at which motion is looked at
_REACH = 40  # frames, how far frames may lie apart to be laid over each other


@dataclass(frozen=True)
class MotionSegmenter:
    """Motion, then colour.

    Attributes:
        choice: whom the user means.
        every: motion and colour are looked at in every n-th frame; flow fills the frames between.
        gap: frames over which motion is taken, either way.
        least_motion: px (at 256), score that the subject must reach in some frames.
        rounds: times that the colours are learned again from the silhouettes.
    """

    choice: Choice = field(default_factory=Choice)
    every: int = 2
    gap: int = 4
    least_motion: float = 1.5
    rounds: int = 3
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
        moving = np.stack([*blend_over_time(layers, small, lambda f: progress(0.3 + 0.1 * f), neighbours=3)])

        tracks = background_tracks(frames, np.zeros(frames.shape[:3], bool))
        overlay = Overlay.of(frames, tracks, size)
        whole = lambda small: cv2.resize(small, (W, H), interpolation=cv2.INTER_LINEAR)  # noqa: E731
        # At first whatever may be the subject is kept out of the background, later what is thought to be.
        covered = {k: moving[k] > 0.3 for k in keys}
        body = follow({k: whole(moving[k]) > 0.5 for k in keys}, flow, self.choice)
        for turn in range(self.rounds):
            last = turn == self.rounds - 1
            differs = {}
            for k in keys:
                others = [u for u in keys if 5 < abs(u - k) <= _REACH][:: max(1, 4 // self.every)]
                differs[k] = overlay.evidence(k, covered, others)
            progress(0.4 + 0.5 * (turn + 0.4) / self.rounds)
            model = learn_colours(frames, body) if turn else None
            for k in keys:
                body[k] = _refine(frames[k], whole(moving[k]), whole(differs[k]), body[k], model, last=last)
                small_body = cv2.resize(body[k].astype(np.float32), size, interpolation=cv2.INTER_AREA)
                covered[k] = cv2.dilate((small_body > 0.1).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            progress(0.4 + 0.5 * (turn + 1) / self.rounds)
        # One neighbour on either side: flow carries the body far, but not legs.
        probability = blend_over_time(body, flow, lambda f: progress(0.9 + 0.1 * f), neighbours=1)
        masks = np.empty(frames.shape[:3], bool)
        for t, p in enumerate(probability):
            masks[t] = component_at(p > 0.45, reach=round(0.06 * np.sqrt((p > 0.5).sum())))
        if not masks.any():
            raise no_subject("what moves has no colours of its own")
        return Masks(masks, None, {"motion_px": strength, "motion_gap_frames": self.gap})


def shrink_flow(flow: Flow, size: tuple[int, int]) -> Flow:
    """The flow at `size` (width, height) px, in px of that size."""
    factor = size[0] / flow.size[0]

    def smaller(fields: np.ndarray) -> np.ndarray:
        shape = (len(fields), size[1], size[0], 2)
        out = np.empty(shape, np.float16)
        for t, whole in enumerate(fields):
            out[t] = factor * cv2.resize(whole.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return out

    consistent = [cv2.resize(c.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) for c in flow.consistent]
    return Flow(smaller(flow.forward), smaller(flow.backward), np.array(consistent, bool), size)


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


def _refine(frame, prior, differs, body, model: ColourModel | None, *, last: bool) -> np.ndarray:
    """Silhouette from motion (`prior` in [0, 1]), difference from the background (log odds) and colour, near to where
    it was thought to be; only the `last` one is cut out along edges."""
    # Limbs that stand have the ground's motion: near the body, motion is asked for no more than this.
    near = grown(body, 0.35)
    logit = 10.0 * (np.where(near, np.maximum(prior, 0.25), prior) - 0.42) + 1.2 * differs
    if model is not None:
        logit += np.clip(cv2.GaussianBlur(model(to_lab(frame)), (0, 0), 1.0), -2.5, 2.5)
    probability = 1.0 / (1.0 + np.exp(-logit))
    probability[~near & (prior < 0.12)] = 0.0
    return component_at(
        cut(frame, probability) if last else probability > 0.5, body, reach=round(0.06 * np.sqrt(body.sum()))
    )
