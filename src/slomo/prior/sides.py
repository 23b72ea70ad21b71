"""Left and right of each pair of limbs, decided for the clip.

A network that sees one picture at a time confuses the legs of a pair, most of all where one hides the other. Over a
clip each leg stays what it is: for every pair a chain of two states (as the network says, or the other way round) is
solved by Viterbi. What each frame says: how much the heat maps prefer the one way, whether the legs lie to the sides
where the clip's view has them, and whether the nearer one is the one that is seen. What two frames say: legs that the
optical flow carries onto each other are the same.
"""

from dataclasses import dataclass

import numpy as np

from slomo.prior.clip import CENTRES
from slomo.prior.labels import Labels, rotation_of
from slomo.skeleton import Skeleton

Array = np.ndarray

_NATS = 2.0  # most that one joint of one frame can say
_SPREAD = 0.08, 0.12  # body lengths that a limb's first joint moves sideways, and each further one more
_SAME = 0.04  # of the box's side: two places that the flow carries as close to each other are the same
_CARRIED = 3.0  # nats that a joint says which is carried onto itself
_FAR_APART = 0.1  # s: beyond a frame's distance flow loses the legs within about this time
_OTHER_WAY = 2.0  # nats by which the parts must contradict the key points of a frame


@dataclass(frozen=True)
class Pair:
    """A left and a right limb.

    Attributes:
        name: of its first joint, without the side.
        left, right: (n,) key points, from the trunk outwards.
        left_parts, right_parts: (m,) labels of parts.
    """

    name: str
    left: Array
    right: Array
    left_parts: Array
    right_parts: Array


def limb_pairs(skeleton: Skeleton, labels: Labels) -> list[Pair]:
    """The skeleton's pairs of limbs: what hangs together of the nodes whose names have a side."""
    sided = labels.mirror_keypoint != np.arange(len(labels.keypoints))

    def first(m: int) -> int:
        while sided[skeleton.link[m]] and skeleton.link[m] >= 0:
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
            labels.keypoints[m].replace("left", "").strip("_").replace("__", "_"),
            np.array(nodes), labels.mirror_keypoint[nodes],
            np.array(parts[m], int), labels.mirror_part[np.array(parts[m], int)],
        )
        for m, nodes in members.items()
    ]  # fmt: skip


def decide(alone: Array, together: Array) -> tuple[Array, float]:
    """The likeliest of two states along a chain (Viterbi).

    Args:
        alone: (F,) nats by which each frame prefers to stay as it is to being swapped.
        together: (F-1,) nats by which a frame and the next prefer the same state to different ones.

    Returns:
        (F,) bool, swapped; and the margin in nats over the same chain with all states the other way round.
    """
    F = len(alone)
    best, came = 0.5 * np.array([alone[0], -alone[0]]), np.zeros((F, 2), int)
    for f in range(1, F):
        total = best[:, None] + 0.5 * together[f - 1] * np.array([[1, -1], [-1, 1]])
        came[f] = total.argmax(0)
        best = total.max(0) + 0.5 * np.array([alone[f], -alone[f]])
    state = np.empty(F, int)
    state[-1] = best.argmax()
    for f in range(F - 1, 0, -1):
        state[f - 1] = came[f, state[f]]
    return state.astype(bool), float((alone * (1 - 2 * state)).sum())


def sideways(view: Array, up: Array) -> Array:
    """(F, 3) expected left axis of the body in the view frame; short where the view is in doubt.

    Args:
        view: (F, 36) probabilities. up: (F, 3).
    """
    up = np.broadcast_to(up[:, None], (*view.shape, 3))
    return np.einsum("fb,fbi->fi", view, rotation_of(np.broadcast_to(CENTRES, view.shape), up)[..., 1])


def from_heat(own_left: Array, own_right: Array, left_at_right: Array, right_at_left: Array) -> Array:
    """(F,) nats: how much the heat maps prefer their own places to each other's. Args: (F, n) probabilities."""
    floor = 1e-3
    ratio = np.log((own_left + floor) * (own_right + floor) / (left_at_right + floor) / (right_at_left + floor))
    return 0.5 * np.clip(ratio, -_NATS, _NATS).sum(1)


def from_view(left: Array, right: Array, axis: Array, width: Array, length: Array, confidence: Array) -> Array:
    """(F,) nats: whether the limbs lie to the sides where the clip's view has them.

    Args:
        left, right: (F, n, 2) px, trunk first. axis: (F, 3) as of `sideways`.
        width: (n,) body lengths between the joints at rest. length: (F,) px of a body length. confidence: (F, n).
    """
    spread = _SPREAD[0] + _SPREAD[1] * np.arange(left.shape[1])
    apart = (left - right) / length[:, None, None]
    expected = width[:, None] * axis[:, None, :2]
    ratio = 2 * (apart * expected).sum(-1) / spread**2
    return (confidence * np.clip(ratio, -_NATS, _NATS)).sum(1)


def from_visibility(seen_left: Array, seen_right: Array, axis: Array) -> Array:
    """(F,) nats: whether the limb on the camera's side is the one that is seen. Args: (F, n) probabilities; (F, 3)."""
    odds = [np.log((p + 0.02) / (1.02 - p)) for p in (seen_left, seen_right)]
    # The camera looks along z: what has less of it is nearer.
    return np.clip(0.5 * (odds[0] - odds[1]) * -axis[:, 2:], -_NATS / 2, _NATS / 2).sum(1)


def from_motion(places: Array, carried: Array, confidence: Array, side: Array, t: Array) -> Array:
    """(F-1,) nats: whether the limbs stay what they are from one frame to the next.

    Args:
        places: (F, 2, n, 2) px, left and right. carried: (F-1, 2, n, 2) px, where the flow takes them.
        confidence: (F, 2, n). side: (F,) px of the boxes. t: (F,) s.
    """

    def alike(a: int, b: int) -> Array:
        gap = np.linalg.norm(carried[:, a] - places[1:, b], axis=-1) / (_SAME * side[1:, None])
        return (confidence[:-1, a] * confidence[1:, b] * np.exp(-0.5 * gap**2)).sum(-1)

    gap = np.diff(t)
    fades = np.exp(-np.maximum(0, gap - gap.min(initial=np.inf)) / _FAR_APART)
    return _CARRIED * fades * (alike(0, 0) + alike(1, 1) - alike(0, 1) - alike(1, 0))


def swap_keypoints(x: Array, pair: Pair, swapped: Array) -> None:
    """Exchange left and right of x (F, K, ...) in the frames that are `swapped` (F,), in place."""
    f = np.flatnonzero(swapped)[:, None]
    x[f, pair.left], x[f, pair.right] = x[f, pair.right], x[f, pair.left]


def swap_parts(parts: Array, surface: Array, pair: Pair, swapped: Array) -> None:
    """Exchange the parts of a pair and the side (y) of the surface that belongs to them, in place.

    Args:
        parts: (F, P+1, h, w) probabilities. surface: (F, 3, h, w).
    """
    both = np.concatenate([pair.left_parts, pair.right_parts])
    other = np.concatenate([pair.right_parts, pair.left_parts])
    for f in np.flatnonzero(swapped):
        on_limb = np.isin(parts[f].argmax(0), both)
        parts[f, both] = parts[f, other]
        surface[f, 1] = np.where(on_limb, -surface[f, 1], surface[f, 1])


def parts_disagree(parts: Array, places: Array, confidence: Array, pair: Pair) -> Array:
    """(F,) bool: the parts call this pair's limbs the other way round than the key points of the same frame do.

    Args:
        parts: (F, P+1, h, w). places: (F, K, 2) in cells of `parts`. confidence: (F, K).
    """
    if not len(pair.left_parts):
        return np.zeros(len(parts), bool)
    h, w = parts.shape[-2:]
    total = np.zeros(len(parts))
    for nodes, own, other in (
        (pair.left, pair.left_parts, pair.right_parts),
        (pair.right, pair.right_parts, pair.left_parts),
    ):
        cell = np.rint(places[:, nodes]).astype(int)
        u, v = np.clip(cell[..., 0], 0, w - 1), np.clip(cell[..., 1], 0, h - 1)
        here = parts[np.arange(len(parts))[:, None], :, v, u]  # (F, n, P+1)
        ratio = np.log((here[..., own].sum(-1) + 0.02) / (here[..., other].sum(-1) + 0.02))
        total += (confidence[:, nodes] * ratio).sum(1)
    return total < -_OTHER_WAY
