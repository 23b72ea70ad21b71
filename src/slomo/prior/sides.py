"""Left and right of each pair of limbs, decided for the clip.

A network that sees one picture at a time confuses the legs of a pair, most of all far from the trunk and where one
hides the other. Over a clip each leg stays what it is, and so does each joint along a leg. For every pair of limbs and
every frame there is a state for each joint: as the network says, or the other way round; the best states of the whole
clip are found by Viterbi over all of their combinations. What a frame says of a joint: which way heat maps and parts
prefer, whether the joints lie to the sides where the clip's view has them, whether the far limb is called the visible
one. What it says of a limb: its joints hang together. What two frames say: what the flow carries onto each other is
the same.
"""

from dataclasses import dataclass

import numpy as np

from slomo.prior.clip import CENTRES
from slomo.prior.inference import mass_at, peaks
from slomo.prior.labels import Labels, rotation_of
from slomo.skeleton import Skeleton

Array = np.ndarray

NATS = 2.0  # most that one joint of one frame can say
_FLOOR = 0.02  # probability that a heat map or part gives to anything
_TWO = 4.0  # how much likelier two limbs are apart than one upon the other, where maps of both have two peaks
_RESOLVED = 0.1  # mass of a second limb beyond the cells of the first
_LATERAL = 0.05, 0.03  # body lengths that a limb's first joint moves sideways, and each further one more
_SWING = 0.15  # body lengths that each further joint swings along the body
_SAME = 0.04  # of the box's side: two places that the flow carries as close to each other are the same
_CARRIED = 3.0  # nats that a joint says which is carried onto itself
_FAR_APART = 0.1  # s: beyond a frame's distance flow loses the legs within about this time


@dataclass(frozen=True)
class Pair:
    """A left and a right limb.

    Attributes:
        name: of its first joint, without the side.
        left, right: (n,) key points, from the trunk outwards.
        parent: (n,) which of the n each hangs on, -1 for the first.
        left_parts, right_parts: (m,) labels of parts.
    """

    name: str
    left: Array
    right: Array
    parent: Array
    left_parts: Array
    right_parts: Array


def limb_pairs(skeleton: Skeleton, labels: Labels) -> list[Pair]:
    """The skeleton's pairs of limbs: what hangs together of the nodes whose names have a side."""
    sided = labels.mirror_keypoint != np.arange(len(labels.keypoints))

    def first(m: int) -> int:
        while skeleton.link[m] >= 0 and sided[skeleton.link[m]]:
            m = skeleton.link[m]
        return m

    members: dict[int, list[int]] = {}
    for m in np.flatnonzero(sided):
        if "left" in labels.keypoints[m]:
            members.setdefault(first(int(m)), []).append(int(m))
    parts: dict[int, list[int]] = {m: [] for m in members}
    for part in range(1, len(labels.mirror_part)):
        links = skeleton.capsule_link[labels.capsule_part == part]
        if labels.mirror_part[part] != part and sided[links].any() and first(int(links[sided[links]][0])) in parts:
            parts[first(int(links[sided[links]][0]))].append(part)
    return [
        Pair(
            name=labels.keypoints[m].replace("left", "").strip("_").replace("__", "_"),
            left=np.array(nodes),
            right=labels.mirror_keypoint[nodes],
            parent=np.array([nodes.index(skeleton.link[k]) if skeleton.link[k] in nodes else -1 for k in nodes]),
            left_parts=np.array(parts[m], int),
            right_parts=labels.mirror_part[np.array(parts[m], int)],
        )
        for m, nodes in members.items()
    ]


def assign(left: Array, right: Array, size: int) -> tuple[Array, Array, Array, Array]:
    """Where the joints of both limbs are in each frame by itself, when each map may see both.

    Maps that do not know which is which have a peak at either limb; their maxima may be the same limb. The candidates
    are the maxima of both maps, and the second peak of their sum or the far end of a blob that covers two limbs; the
    likeliest pair of them is taken.

    Args:
        left, right: (F, n, h, w) heat maps. size: px of the crop.

    Returns:
        (F, 2, n, 2) px of the crop, left and right; (F, 2, n) probability that each has there in its own map;
        (F, 2, n) and in the other's; (F, n) bool, whether there are two places, not the ends of one blob.
    """
    both = left + right
    h, w = both.shape[-2:]
    top = both.reshape(*both.shape[:2], -1).argmax(-1)
    v, u = np.mgrid[:h, :w]
    away = np.maximum(np.abs(v - (top // w)[..., None, None]), np.abs(u - (top % w)[..., None, None])) > 2
    candidates = np.stack([peaks(left, size)[0], peaks(right, size)[0], peaks(both * away, size)[0]])
    at_left, at_right = (np.stack([mass_at(m, c, size) for c in candidates]) for m in (left, right))
    gap = np.abs(candidates[:, None] - candidates[None]).max(-1) * (w / size)
    score = np.log(at_left + _FLOOR)[:, None] + np.log(at_right + _FLOOR)[None] + np.log(_TWO) * (gap > 2)
    a, b = np.divmod(score.reshape(9, *top.shape).argmax(0), 3)
    of = lambda x, i: np.take_along_axis(x, i.reshape(1, *i.shape, *[1] * (x.ndim - 3)), 0)[0]  # noqa: E731
    places = np.stack([of(candidates, a), of(candidates, b)], 1)
    own = np.stack([of(at_left, a), of(at_right, b)], 1)
    rest = mass_at(0.5 * both * away, candidates[2], size)
    return places, own, np.stack([of(at_right, a), of(at_left, b)], 1), ((a != 2) & (b != 2)) | (rest > _RESOLVED)


@dataclass(frozen=True)
class Decision:
    """`swapped` (F, n) joints to be exchanged; `sure` (F, n) probability of that state, given the whole clip; `margin`
    in nats over the same states all the other way round."""

    swapped: Array
    sure: Array
    margin: float


def decide(alone: Array, along: Array, together: Array, parent: Array) -> Decision:
    """The likeliest states of n joints over F frames (Viterbi), and how sure each is (forward-backward).

    Args:
        alone: (F, n) nats by which a joint prefers to stay as it is to being swapped.
        along: (F, n) nats by which it prefers the state of its parent to the other.
        together: (F-1, n) nats by which it prefers to keep its state to the next frame.
        parent: (n,), -1 for none.
    """
    F, n = alone.shape
    sign = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)  # (2^n, n)
    hangs = sign * np.where(parent >= 0, sign[:, parent], 0)
    here = 0.5 * (alone @ sign.T + along @ hangs.T)
    moves = [0.5 * (sign * x) @ sign.T for x in together]
    best, came = here[0], np.zeros((F, 2**n), int)
    ahead, back = [here[0]], [np.zeros(2**n)]
    for f in range(1, F):
        total = best[:, None] + moves[f - 1]
        came[f] = total.argmax(0)
        best = total.max(0) + here[f]
        ahead.append(np.logaddexp.reduce(ahead[-1][:, None] + moves[f - 1], 0) + here[f])
    state = np.empty(F, int)
    state[-1] = best.argmax()
    for f in range(F - 1, 0, -1):
        state[f - 1] = came[f, state[f]]
        back.append(np.logaddexp.reduce(moves[f - 1] + (here[f] + back[-1])[None], 1))
    log_p = np.stack(ahead) + np.stack(back[::-1])
    p = np.exp(log_p - log_p.max(1, keepdims=True))
    p /= p.sum(1, keepdims=True)
    chosen = sign[state]  # (F, n)
    return Decision(chosen < 0, 0.5 + 0.5 * chosen * (p @ sign), float((alone * chosen).sum()))


@dataclass(frozen=True)
class Axes:
    """The body's axes as the clip's view expects them: `left` (F, 3) in the view frame, short where the view is in
    doubt; `ahead` (F, 2, 2), the outer product of the forward axis with itself in the picture."""

    left: Array
    ahead: Array


def axes(view: Array, up: Array) -> Axes:
    """Expected axes. Args: view (F, 36) probabilities; up (F, 3)."""
    up = np.broadcast_to(up[:, None], (*view.shape, 3))
    R = rotation_of(np.broadcast_to(CENTRES, view.shape), up)
    ahead = R[..., :2, 0]
    return Axes(np.einsum("fb,fbi->fi", view, R[..., 1]), np.einsum("fb,fbi,fbj->fij", view, ahead, ahead))


def preference(own: Array, other: Array) -> Array:
    """(F, n) nats: how much probabilities (F, 2, n) of the own side outweigh those of the other at the same places."""
    ratio = np.log((own + _FLOOR) / (other + _FLOOR)).sum(1)
    return np.clip(ratio, -NATS, NATS)


def at_places(parts: Array, places: Array, size: int) -> Array:
    """(F, ..., P+1) part probabilities (F, P+1, h, w) at places (F, ..., 2) px of the crop."""
    h, w = parts.shape[-2:]
    cell = np.rint((places + 0.5) * (w / size) - 0.5).astype(int)
    u, v = np.clip(cell[..., 0], 0, w - 1), np.clip(cell[..., 1], 0, h - 1)
    return parts[np.arange(len(parts)).reshape(-1, *[1] * (u.ndim - 1)), :, v, u]


def from_parts(parts: Array, places: Array, pair: Pair, size: int) -> Array:
    """(F, n) nats: how much the parts (F, P+1, h, w) prefer joints at places (F, 2, n, 2) px as they are."""
    if not len(pair.left_parts):
        return np.zeros((len(parts), len(pair.left)))
    here = at_places(parts, places, size)
    left, right = (here[..., p].sum(-1) for p in (pair.left_parts, pair.right_parts))
    both = np.stack([left[:, 0], right[:, 1]], 1), np.stack([right[:, 0], left[:, 1]], 1)
    return preference(*both)


def from_view(apart: Array, axes: Axes, width: Array) -> Array:
    """(F, n) nats: whether joints lie to the sides where the clip's view has them.

    A limb moves along the body by its swing and little sideways, so what counts is how far the joints are apart across
    the body's axis in the picture. Seen from above, that also tells the nearer foot, which is lower.

    Args:
        apart: (F, n, 2) body lengths, left less right. width: (n,) the same sideways at rest.
    """
    joint = np.arange(apart.shape[1])
    spread = (_LATERAL[0] + _LATERAL[1] * joint)[:, None, None] ** 2 * np.eye(2)
    spread = spread + (_SWING * joint)[:, None, None] ** 2 * axes.ahead[:, None]  # (F, n, 2, 2)
    expected = width[:, None] * axes.left[:, None, :2]
    ratio = 2 * (apart * np.linalg.solve(spread, expected[..., None])[..., 0]).sum(-1)
    return np.clip(ratio, -NATS, NATS)


def from_visibility(seen: Array, axes: Axes) -> Array:
    """(F, n) nats, 0 and less: the limb away from the camera is called the visible one. Args: seen (F, 2, n)."""
    odds = np.log((seen + _FLOOR) / (1 + _FLOOR - seen))
    # The camera looks along z: what has less of it is nearer.
    return np.clip((odds[:, 0] - odds[:, 1]) * -axes.left[:, 2:], -NATS, 0)


def hanging_together(apart: Array, bone: Array, parent: Array) -> Array:
    """(F, n) nats: a joint and its parent lie to the same side of the other limb's.

    The squared lengths of the bones between them against those crosswise differ by twice the product.

    Args:
        apart: (F, n, 2) body lengths. bone: (n,) length to the parent. parent: (n,).
    """
    ratio = (apart * apart[:, parent]).sum(-1) / np.maximum(bone, 1e-3) ** 2
    return np.where(parent >= 0, np.clip(ratio, -NATS, NATS), 0)


def from_motion(places: Array, carried: Array, confidence: Array, side: Array, t: Array) -> Array:
    """(F-1, n) nats: whether joints stay what they are from one frame to the next.

    Args:
        places: (F, 2, n, 2) px, left and right. carried: (F-1, 2, n, 2) px, where the flow takes them.
        confidence: (F, 2, n) of there being one of the two. side: (F,) px of the boxes. t: (F,) s.
    """

    def alike(a: int, b: int) -> Array:
        gap = np.linalg.norm(carried[:, a] - places[1:, b], axis=-1) / (_SAME * side[1:, None])
        return confidence[:-1, a] * confidence[1:, b] * np.exp(-0.5 * gap**2)

    gap = np.diff(t)
    fades = np.exp(-np.maximum(0, gap - gap.min(initial=np.inf)) / _FAR_APART)
    return _CARRIED * fades[:, None] * (alike(0, 0) + alike(1, 1) - alike(0, 1) - alike(1, 0))


def identity(decision: Decision, apart: Array, side: Array) -> Array:
    """(F, n) in [0, 1]: how much a side that may be wrong leaves of a key point's confidence; all where both limbs are
    at the same place. Args: apart (F, n, 2) px; side (F,) px of the boxes."""
    gap = np.linalg.norm(apart, axis=-1) / (_SAME * side[:, None])
    return 1 - 2 * (1 - decision.sure) * (1 - np.exp(-0.5 * gap**2))


def exchange(x: Array, swapped: Array) -> None:
    """Exchange left and right of x (F, 2, n, ...) where `swapped` (F, n), in place."""
    f, j = np.nonzero(swapped)
    x[f, 0, j], x[f, 1, j] = x[f, 1, j], x[f, 0, j]


def swap_parts(parts: Array, surface: Array, places: Array, confidence: Array, pair: Pair, size: int) -> None:
    """Exchange parts of a pair, and the side (y) of the surface that they show, where the joints say so; in place.

    Args:
        parts: (F, P+1, h, w) probabilities. surface: (F, 3, h, w).
        places: (F, 2, n, 2) px of the crop, left and right as decided. confidence: (F, 2, n).
    """
    here = at_places(parts, places, size)  # (F, 2, n, P+1)
    for left, right in zip(pair.left_parts, pair.right_parts, strict=True):
        own = np.stack([here[:, 0, :, left], here[:, 1, :, right]], 1)
        other = np.stack([here[:, 0, :, right], here[:, 1, :, left]], 1)
        says = (confidence * np.log((own + _FLOOR) / (other + _FLOOR))).sum((1, 2))
        for f in np.flatnonzero(says < 0):
            on_limb = np.isin(parts[f].argmax(0), (left, right))
            parts[f, [left, right]] = parts[f, [right, left]]
            surface[f, 1] = np.where(on_limb, -surface[f, 1], surface[f, 1])
