"""What a network takes in of the furniture around a subject is given back by its colours."""

from collections.abc import Container
from functools import partial

import cv2
import numpy as np

from slomo.reconstruct.colour import ColourModel, cut, learn_colours, to_lab
from slomo.reconstruct.flow import Flow, inside, sample
from slomo.reconstruct.instances import components
from slomo.reconstruct.instances_motion import SharedMotion
from slomo.reconstruct.segment import grown
from slomo.threads import in_order

_FOREIGN = 0.17  # part of a mask in patches of the surroundings' colours, from which on it is cut anew
_COLOUR = -0.75  # mean log ratio of a patch that is of the surroundings
_LEAST = 0.02  # of the mask, a patch that is worth looking at
_FAINT = 0.6  # outline of a patch against its own edge to the body: furniture goes on beyond the mask
_APART = (10, 20, 30, 45)  # frames before and after in which a patch is looked for
_RARELY = 0.5  # of those frames: a patch that is seen less often does not belong to the body
_ALONG = 0.5  # of the body's motion, from which on a patch moves along with it
_NEARLY = 0.2  # of the patch may not: flow carries the rim of a plain wall along with what is before it


def give_back_surroundings(frames: np.ndarray, layers: dict[int, np.ndarray], flow: Flow, motion: SharedMotion) -> int:
    """Take out of `layers`, in place, what the network added of furniture and the like. Returns the frames concerned.

    Colours are learned from the quarter of the masks that are smallest (though no slivers), against their
    surroundings. A mask a good part of which is patches of the colours of those surroundings, and does not move along
    with the body (its flank, where those masks show it from the front), is cut anew with them; what then is left
    without most of the usual area says nothing and is dropped, for the frames next to it to fill.
    """
    bodies = {k: p > 0.5 for k, p in layers.items()}
    area = {k: int(b.sum()) for k, b in bodies.items() if b.any()}
    usual = np.median(list(area.values())) if area else 0.0
    whole = sorted((k for k in area if area[k] > 0.3 * usual), key=lambda k: area[k])
    trusted = whole[: max(2, len(whole) // 4)]
    if len(trusted) < 2:
        return 0
    model = learn_colours(frames, {k: bodies[k] for k in trusted}, reach=2.0)
    colour = lambda k: cv2.GaussianBlur(model(to_lab(frames[k])), (0, 0), 1.5)  # noqa: E731
    own: dict[int, np.ndarray] = {}  # patches of the masks that are cut anew which move along
    for k in area:
        if (patches := _foreign(bodies[k], colour(k))).sum() > _FOREIGN * area[k]:
            staying = _staying(patches, k, bodies, flow, motion)
            if staying.sum() > _FOREIGN * area[k]:
                own[k] = patches & ~staying
    for k, patches in own.items():
        # The network has shown here that it does not know, so colour outweighs it.
        logit = 2.0 * (np.clip(colour(k), -2.0, 2.0) - 0.5) + layers[k] - 0.5
        probability = np.where(grown(bodies[k], 0.1), 1.0 / (1.0 + np.exp(-logit)), 0.0)
        layers[k] = (cut(frames[k], probability) | patches).astype(np.float16)
    if own:
        left = {k: float((p > 0.5).sum()) for k, p in layers.items()}
        trusted_area = np.median([area[k] for k in trusted])
        for k in own:
            if left[k] < 0.5 * trusted_area and len(layers) > len(left) // 3:
                del layers[k]
    return len(own)


def give_back_patches(frames: np.ndarray, layers: dict[int, np.ndarray], flow: Flow, motion: SharedMotion) -> int:
    """Take out of `layers`, in place, pieces of furniture that are less than half of what the function above looks for.

    A piece that a cut by colour (learned over the whole clip) would take away goes if it is of the colours of the
    surroundings and one of two things shows that it is theirs: the mask ends in the middle of it, with no edge there
    that is like the one between it and the body; or most frames around do not take the same place, followed along the
    flow, for the body. A head of the background's colour has an edge all round and is always there. A piece that moves
    along with the body stays. Twice over, because colours are known better once some is gone. Returns the frames
    concerned.
    """
    bodies = {k: p > 0.5 for k, p in layers.items()}
    changed: set[int] = set()
    for _ in range(2):
        there = {k: b for k, b in bodies.items() if b.any()}
        if len(there) < 2:
            break
        model = learn_colours(frames, there, reach=2.0)
        find = partial(_patches, frames, bodies=bodies, model=model, flow=flow)
        taken = {k: gone for k, gone in zip(there, in_order(find, there), strict=True) if gone.any()}
        taken = {k: left for k, gone in taken.items() if (left := _staying(gone, k, bodies, flow, motion)).any()}
        if not taken:
            break
        changed |= taken.keys()
        for k, gone in taken.items():
            bodies[k] &= ~gone
            layers[k] = np.where(grown(gone, 0.1) & ~bodies[k], 0, layers[k]).astype(np.float16)
    return len(changed)


def _patches(
    frames: np.ndarray, k: int, *, bodies: dict[int, np.ndarray], model: ColourModel, flow: Flow
) -> np.ndarray:
    """(H, W) bool: the pieces of body k that are of the surroundings."""
    frame = frames[k]
    body, lab = bodies[k], to_lab(frame)
    area, gone = float(body.sum()), np.zeros_like(body)
    colour = cv2.GaussianBlur(model(lab), (0, 0), 1.5)
    radius = max(1, round(0.03 * np.sqrt(area)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = lambda m: cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_OPEN, disc)  # noqa: E731
    if opened(body & (colour < -0.5)).sum() < _LEAST * area:
        return gone
    probability = 1 / (1 + np.exp(-1.5 * np.clip(colour, -2, 2) - np.where(body, 1.0, -1.0)))
    probability = np.where(body, probability, np.where(grown(body, 0.05), np.minimum(probability, 0.5), 0.0))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened(body & ~cut(frame, probability)), connectivity=8)
    edge = _edges(lab)
    for i in range(1, count):
        piece = labels == i
        if stats[i, cv2.CC_STAT_AREA] < _LEAST * area or colour[piece].mean() > _COLOUR:
            continue
        beside = cv2.dilate(piece.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        end, seam = _outlined(edge, body, piece), _outlined(edge, body & ~piece, beside)
        if end < _FAINT * seam or _lasting(piece, k, bodies, flow) < _RARELY:
            gone |= piece
    return gone


def _staying(gone: np.ndarray, k: int, bodies: dict[int, np.ndarray], flow: Flow, motion: SharedMotion) -> np.ndarray:
    """(H, W) bool: what of `gone` in frame k does not share the body's motion there, or, where the body is at rest
    then, in the nearest of the frames around in which it is not."""
    left, along = gone.copy(), _along(k, bodies, flow, motion)
    for piece in components(gone, 1):
        if along[piece].mean() > 1 - _NEARLY:
            left &= ~piece
    return left


def _along(k: int, bodies: dict[int, np.ndarray], flow: Flow, motion: SharedMotion) -> np.ndarray:
    """(H, W) bool: what moves along with the body in frame k or, where the body is at rest then, in the nearest of the
    frames around in which it is not; nothing where it rests in all of them."""
    for other in (k, *frames_around(k, bodies)):
        share = motion.share(other, motion.velocity(other, bodies[other]))
        if share is not None:
            there = sample(share, flow.chain(k, other)) if other != k else share
            return np.nan_to_num(there) > _ALONG
    return np.zeros_like(bodies[k])


def _edges(lab: np.ndarray) -> np.ndarray:
    """(H, W) the strongest change of colour next to each pixel."""
    smooth = cv2.GaussianBlur(lab.astype(np.float32), (0, 0), 1.0)
    change = sum((cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3) ** 2).sum(-1) for d in ((1, 0), (0, 1)))
    return cv2.dilate(np.sqrt(change), np.ones((3, 3), np.uint8))


def _outlined(edge: np.ndarray, body: np.ndarray, where: np.ndarray) -> float:
    """Mean edge along the outline of a body where that is; infinite where there is none."""
    outline = body & (cv2.erode(body.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0) & where
    return float(edge[outline].mean()) if outline.any() else np.inf


def frames_around(k: int, known: Container[int]) -> list[int]:
    """The frames a third of a second to one and a half before and after frame k that are `known`, the nearest first."""
    return [other for gap in _APART for other in (k + gap, k - gap) if other in known]


def _lasting(piece: np.ndarray, k: int, bodies: dict[int, np.ndarray], flow: Flow) -> float:
    """Part of a piece of frame k that the frames around it take for the body, too; 1 where it is not seen elsewhere."""
    parts = []
    for other in frames_around(k, bodies):
        if bodies[other].any():
            offset = flow.chain(k, other)
            seen = piece & inside(offset)
            if seen.sum() > 0.5 * piece.sum():
                parts.append(float(sample(bodies[other].astype(np.float32), offset)[seen].mean()))
    return float(np.mean(parts)) if parts else 1.0


def _foreign(body: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """(H, W) bool, what of a mask is whole patches of the surroundings' colours; speckles of a coat do not count."""
    radius = max(1, round(0.06 * np.sqrt(body.sum())))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.morphologyEx((body & (colour < -0.5)).astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
