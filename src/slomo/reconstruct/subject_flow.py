"""The optical flow of the subject, from a closer look at it alone.

It is for the fit. Networks see the flow of the whole picture, as smooth as what they have learnt from: given this one,
paws within a fifth of the subject's size fell from .73 to .67 and from .71 to .64 on two rendered clips.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from slomo.reconstruct.flow import consistent_px
from slomo.reconstruct.segment import box_of
from slomo.threads import in_order

Array = np.ndarray

_CLOSE_PX = 360.0  # size (root of the area) of the box around the subject that it is magnified to
_ZOOM = 3.0  # at most
_AROUND = 0.15  # of the box's longer side, around it
_SMALLEST = 12  # px, a box that patches fit into
_CONTRAST = 80.0  # grey levels between the subject and what stands for everything else
_BESIDE = 7  # px, width of the square that the mask is dilated by: there the flow is the subject's own, continued
_OWN, _SURE = 1, 2


def closer(frames: Array, masks: Array, progress=lambda fraction: None) -> dict[str, Array]:
    """Flow t -> t+1 inside the masks, from pictures of the subject alone and magnified.

    A leg is about as wide as the patches that are matched, and most of what these see is the background beside it.

    Args:
        frames: (T, H, W, 3) uint8 RGB. masks: (T, H, W) bool.

    Returns:
        A window of h x w cells of the grid of `Flow` around the subject: subject_at (T-1, 2) int16, row and column of
        its first cell; subject_flow (T-1, h, w, 2) float16 px; subject_known (T-1, h, w) uint8, 0 where it says
        nothing, 2 where forward then backward leads home, 1 elsewhere.
    """
    pairs = range(len(frames) - 1)
    found = []
    for each in in_order(lambda t: _both_ways(frames[t : t + 2], masks[t : t + 2]), pairs):
        found.append(each)
        progress(len(found) / len(pairs))
    h = max((len(known) for _, _, known in found), default=0)
    w = max((known.shape[1] for _, _, known in found), default=0)
    out = dict(
        subject_at=np.zeros((len(found), 2), np.int16), subject_flow=np.zeros((len(found), h, w, 2), np.float16),
        subject_known=np.zeros((len(found), h, w), np.uint8),
    )  # fmt: skip
    for t, (at, flow, known) in enumerate(found):
        out["subject_at"][t] = at
        out["subject_flow"][t, : len(known), : known.shape[1]] = flow
        out["subject_known"][t, : len(known), : known.shape[1]] = known
    return out


def merged(flow: Mapping[str, Array], t: int) -> tuple[Array, Array]:
    """Flow t -> t+1 (h, w, 2) float32 px and whether it leads home (h, w) bool, on the grid of `Flow`.

    It is the subject's own where that is known. `flow`: the arrays of the artifact.
    """
    field = np.array(flow["flow"][t], np.float32)
    home = np.unpackbits(flow["consistent"][t], axis=-1)[:, : field.shape[1]].astype(bool)
    if "subject_at" in flow:
        row, column = (int(n) for n in flow["subject_at"][t])
        known = flow["subject_known"][t][: len(field) - row, : field.shape[1] - column]
        at = slice(row, row + len(known)), slice(column, column + known.shape[1])
        own = known >= _OWN
        field[at][own] = flow["subject_flow"][t][: len(known), : known.shape[1]][own]
        home[at][own] = known[own] == _SURE
    return field, home


def _both_ways(frames: Array, masks: Array) -> tuple[tuple[int, int], Array, Array]:
    """First cell, flow (h, w, 2) and what is known (h, w) of two frames; nothing where there is no subject."""
    nothing = (0, 0), np.zeros((0, 0, 2), np.float16), np.zeros((0, 0), np.uint8)
    if not masks.any((1, 2)).all():
        return nothing
    x0, y0, x1, y1 = (2 * (n // 2) for n in box_of(np.asarray(masks.any(0)), margin=_AROUND))
    if min(x1 - x0, y1 - y0) < _SMALLEST:
        return nothing
    zoom = float(np.clip(_CLOSE_PX / np.sqrt((x1 - x0) * (y1 - y0)), 1.0, _ZOOM))
    grey = [cv2.cvtColor(f[y0:y1, x0:x1], cv2.COLOR_RGB2GRAY) for f in frames]
    own = masks[:, y0:y1, x0:x1].astype(np.float32)
    level = cv2.mean(grey[0], own[0].astype(np.uint8))[0]
    level += _CONTRAST if level < 128 else -_CONTRAST
    a, b = (_alone(*pair, zoom, level) for pair in zip(grey, own, strict=True))
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = dis.calc(a, b, None), dis.calc(b, a, None)  # type: ignore[call-overload]
    home = consistent_px(there, back, zoom).astype(np.float32)
    coarse = lambda x: cv2.resize(x, ((x1 - x0) // 2, (y1 - y0) // 2), interpolation=cv2.INTER_AREA)  # noqa: E731
    known = (coarse(cv2.dilate(own[0], np.ones((_BESIDE, _BESIDE)))) > 0).astype(np.uint8) * _OWN
    known[(known > 0) & (coarse(home) > 0.5)] = _SURE
    return (y0 // 2, x0 // 2), coarse(there / zoom).astype(np.float16), known


def _alone(grey: Array, mask: Array, zoom: float, level: float) -> Array:
    """Picture (h, w) uint8 of the subject `zoom` times as large, everything else at `level`."""
    large = lambda x, how: cv2.resize(x, None, fx=zoom, fy=zoom, interpolation=how).astype(np.float32)  # noqa: E731
    of = large(mask, cv2.INTER_LINEAR)
    return np.clip(of * large(grey, cv2.INTER_CUBIC) + (1 - of) * level, 0, 255).astype(np.uint8)
