"""Several animals in one picture: whom the user means, and who is who from one frame to the next."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from slomo.errors import UsageError
from slomo.reconstruct.colour import to_lab
from slomo.reconstruct.flow import Flow, sample
from slomo.reconstruct.segment import component_at, no_subject

_APART = 0.35  # roots of the subject's area: what is further from it than that is no part of it that a post cut off
_NEW = 0.2  # the same of what nobody has seen before
_LIMB = 0.1  # part of the subject's area, below which a piece close to it may be a limb that flow has lost
_BINS = (8, 16, 16)  # of L, a, b: light changes, hue less


@dataclass(frozen=True)
class Choice:
    """Whom the user means, in pixels of the decoded frames; without point and box, the largest.

    Attributes:
        frame: at which the point or box is given.
        point: (u, v) px.  box: (u0, v0, u1, v1) px.
    """

    frame: int = 0
    point: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None

    @property
    def how(self) -> str:
        """For the report."""
        return "at" if self.point else "box" if self.box else "largest"


def choose(at: tuple[float, ...], box: tuple[float, ...], video: Mapping[str, Any], frames: int) -> Choice:
    """From what the user gave, in (square) pixels of the upright clip: `at` (u, v[, s]) or `box` (u0, v0, u1, v1[, s]).

    Args:
        video: `video.json` of the decoded clip; without it pixels of the clip are those of the frames.
        frames: how many are decoded.

    Raises:
        UsageError: both are given, or one with the wrong count of numbers, outside the picture or of the time.
    """
    if at and box:
        raise UsageError("a point and a box are given", where="--subject-at, --subject-box", todo="give one of them")
    if not at and not box:
        return Choice()
    where, count = ("--subject-at", 2) if at else ("--subject-box", 4)
    given = np.array(at or box, float)
    if len(given) not in (count, count + 1):
        valid = ["U,V or U,V,SECONDS"] if at else ["U0,V0,U1,V1 or U0,V0,U1,V1,SECONDS"]
        raise UsageError(f"has {len(given)} numbers", where=where, valid=valid)
    xy = given[:count].reshape(-1, 2)
    if video:
        size = np.array([video["source_width"] * video["pixel_aspect"], video["source_height"]])  # as players show it
        size = size[::-1] if round(video["rotation"] / 90) % 2 else size
        if (xy < 0).any() or (xy > size).any():
            raise UsageError(
                f"lies outside the picture: {given}", where=where, valid=[f"0,0 to {size[0]:g},{size[1]:g}"]
            )
        xy = xy * [video["width"], video["height"]] / size
    start, fps = (float(video["start_s"]), float(video["fps"])) if video else (0.0, 30.0)
    frame = round((given[count] - start) * fps) if len(given) > count else 0
    if not 0 <= frame < frames:
        valid = [f"{start:g} to {start + (frames - 1) / fps:.2f} s, the part of the clip that is used"]
        raise UsageError(f"time {given[count]:g} s is not used", where=where, valid=valid)
    if at:
        return Choice(frame, point=(float(xy[0, 0]), float(xy[0, 1])))
    (u0, v0), (u1, v1) = xy.min(0), xy.max(0)
    if min(u1 - u0, v1 - v0) < 4:
        raise UsageError("is less than 4 px wide or high", where=where, todo="draw it around the animal")
    return Choice(frame, box=(float(u0), float(v0), float(u1), float(v1)))


def components(mask: np.ndarray, least: float) -> list[np.ndarray]:
    """Connected components (H, W) bool of `least` px and more, the largest first."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    order = sorted((i for i in range(1, count) if area[i] >= least), key=lambda i: -area[i])
    return [labels == i for i in order]


def standing_out(probability: np.ndarray) -> list[np.ndarray]:
    """What stands out in a picture and is more than a fifth of the largest of it."""
    pieces = components(probability > 0.5, 0.002 * probability.size)
    return [c for c in pieces if c.sum() > 0.2 * pieces[0].sum()]


def clarity_of(probability: np.ndarray, mask: np.ndarray) -> float:
    """How clearly one whole object, `mask`, stands out: confident, alone, away from the border."""
    share = mask.mean()
    if not 0.002 < share < 0.7:
        return 0.0
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    confident = probability[mask].mean() * mask.sum() / max(1, (probability > 0.5).sum())
    return float(confident * max(0.0, 1.0 - 4.0 * border) * min(1.0, share / 0.02))


def distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) px to the nearest pixel of `mask`; very far where it is empty."""
    if not mask.any():
        return np.full(mask.shape, 1e6, np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)


def tell_apart(
    found: np.ndarray,
    subject: np.ndarray,
    others: np.ndarray,
    alike: Callable[[np.ndarray], bool],
    share: np.ndarray | None = None,
    usual: float = 0.0,
    own: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whose is what is found in a frame, from where flow has carried the subject and the others.

    A piece near the subject that was part of it is still; one that has come away from it further than a post is wide,
    with nothing between them that was its own of late, and one that comes from elsewhere, is another's. What two have
    merged into goes to whom it was, and what nobody was to whose motion it has, or else to the nearer.

    Args:
        found: (H, W) bool.  subject, others: (H, W) bool, carried to this frame.
        alike: says of a piece nobody has seen before whether it looks like the subject.
        share: (H, W) how much of the subject's motion each pixel has, where that is known.
        usual: px, area of the subject when nothing hides it.
        own: (H, W) bool, what was the subject's of late: feet still hang from it by legs that are not seen for a while.

    Returns:
        (H, W) bool of the subject, of the others, and of what is surely the others': not merely nearer to them.
    """
    mine, theirs, sure = (np.zeros_like(found) for _ in range(3))
    usual = max(usual, float(subject.sum()))
    others = _released(others, share)
    size = np.sqrt(usual)
    pieces = components(found, max(12.0, 0.004 * subject.sum()))
    shared = [((c & subject).sum(), (c & others).sum(), c.sum()) for c in pieces]
    main = max(range(len(pieces)), key=lambda i: shared[i][0], default=-1)
    if main < 0 or shared[main][0] == 0:
        return mine, found, found
    to_main = distance(pieces[main])
    hangs = pieces[main] if own is None else component_at(found | own, pieces[main])
    nearer = None
    for i, piece in enumerate(pieces):
        s, o, area = shared[i]
        if o > 0.1 * area and s > 0.1 * area:
            if nearer is None:
                nearer = distance(subject & ~others) <= distance(others)
                if share is not None:
                    nearer = np.where(subject | others, nearer, nearer & (share > 0) | (share > 0.5))
            mine |= piece & nearer
            theirs |= piece & ~nearer
            sure |= piece & ~nearer & others
        elif o > s:
            theirs |= piece
            sure |= piece
        else:
            moves_along = share is not None and np.median(share[piece]) > 0.5
            known = s > 0.3 * area
            gap = to_main[piece].min()
            close = gap < (_APART if known or moves_along else _NEW) * size or (known and (hangs & piece).any())
            same = i == main or (close and (known or area < _LIMB * usual or alike(piece)))
            (mine if same else theirs)[piece] = True
            if not same and area > _LIMB * usual:
                sure |= piece
    return mine, theirs, sure


def _released(others: np.ndarray, share: np.ndarray | None) -> np.ndarray:
    """The others (H, W) bool without what flow has wrongly carried along with them: of one that does not share the
    subject's motion the pixels that do."""
    if share is None or not others.any():
        return others
    kept = np.zeros_like(others)
    for one in components(others, 1):
        if np.median(np.nan_to_num(share[one], nan=0.0)) < 0.4:
            one &= ~(share > 0.6)
        kept |= one
    return kept


def follow(found: Mapping[int, np.ndarray], flow: Flow, choice: Choice) -> dict[int, np.ndarray]:
    """Of what is found in some frames, frame -> (H, W) bool, one thing: the component that the user means, or the
    largest of all, and in the frames before and after it whichever shares most with where flow carries it.

    Where none does, nothing, until something is found where it was last seen.

    Raises:
        InvalidData: nothing is found where the user points.
    """
    keys = sorted(found)
    if choice.how == "largest":
        biggest = {k: max((c.sum() for c in components(found[k], 1)), default=0) for k in keys}
        seed = max(keys, key=lambda k: biggest[k])
        body = component_at(found[seed])
    else:
        seed = min(keys, key=lambda k: abs(k - choice.frame))
        hint = np.zeros(found[seed].shape, bool)
        u0, v0, u1, v1 = choice.box or (*(choice.point or (0, 0)), *(choice.point or (0, 0)))
        hint[max(0, int(v0)) : int(v1) + 1, max(0, int(u0)) : int(u1) + 1] = True
        if choice.point:
            hint = distance(hint) < 0.02 * max(hint.shape)
        body = component_at(found[seed], hint)
        if not body.any():
            raise no_subject(f"nothing moves where --subject-{choice.how} points")
    out = {seed: body}
    for order in (keys[keys.index(seed) :], keys[: keys.index(seed) + 1][::-1]):
        carried = body
        for previous, k in pairwise(order):
            carried = sample(carried.astype(np.float32), flow.chain(k, previous)) > 0.5
            out[k] = component_at(found[k], carried) if carried.any() else np.zeros_like(carried)
            carried = out[k] if out[k].any() else carried
    return out


class Look:
    """What the subject looks like: its colours, as a histogram over the frames in which it was seen."""

    def __init__(self) -> None:
        self._total = np.zeros(_BINS)
        self._seen: list[float] = []

    def learn(self, frame: np.ndarray, mask: np.ndarray) -> None:
        """Add what (H, W) bool shows of (H, W, 3) uint8 RGB."""
        histogram = _histogram(frame, mask)
        if self._total.any():
            self._seen.append(_overlap(histogram, self._total))
        self._total += histogram

    def likeness(self, frame: np.ndarray, mask: np.ndarray) -> float:
        """In [0, 1] and more: the Bhattacharyya coefficient with the subject's colours, 1 as like as itself usually."""
        usual = float(np.median(self._seen)) if self._seen else 0.9
        return _overlap(_histogram(frame, mask), self._total) / max(usual, 0.5)


def _histogram(frame: np.ndarray, mask: np.ndarray) -> np.ndarray:
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    lab = to_lab(frame)[core if core.sum() > 20 else mask].astype(int)
    counts, _ = np.histogramdd(lab, _BINS, [(0, 256)] * 3)
    for axis in range(3):
        counts = counts + 0.5 * (np.roll(counts, 1, axis) + np.roll(counts, -1, axis))
    return counts / max(counts.sum(), 1e-9)


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(a * b / max(b.sum(), 1e-9)).sum())
