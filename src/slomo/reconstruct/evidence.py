"""What the networks and the user say about the clip, arranged for the fit: at its frames, in its working pixels.

Everything is probabilities with confidences: the terms of `evidence_terms` weigh it, none of it is taken for true.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.prior.labels import BINS, Labels, labels
from slomo.reconstruct.observations import Observations
from slomo.skeleton import Skeleton, list_skeletons, load_skeleton

Array = np.ndarray
Tensor = torch.Tensor

GROUPS = dict(view="view_weight", keypoints="confidence", parts="parts_weight", surface="sure")
POINTS = 40  # canonical surface points of a fit frame
SCALE = 0.10  # body lengths: an embedding that is this unsure of the place on the surface counts half
SEED = 5
MIRRORS = (("back to front", (-1.0, np.pi)), ("head to tail", (-1.0, 0.0)), ("turned around", (1.0, np.pi)))
MODE = np.radians(25.0)  # half width within which a distribution's mass belongs to a mode
RIVAL = 0.15  # mass of a mode that is worth a hypothesis
APART = np.radians(40.0)  # modes closer than this are one


@dataclass(frozen=True)
class Evidence:
    """At F fit frames; a frame or a group that nothing is said about has weight 0.

    Attributes:
        unit: (F,) working px, a tenth of the subject's size (root of its area): the unit of distances.
        view: (F, 36) probabilities of the azimuth. up: (F, 3) unit, body's up in the view frame.
        view_weight: (F,). path: (F,) rad, azimuth decided over the whole clip; NaN without a view.
        trunk: nodes whose middle is what the camera is turned to.
        node: (N,) the node each key point column speaks of. uv: (F, N, 2) px. confidence: (F, N) in [0, 1]. alone:
            columns that mean what they say; pairs: (2, M) columns of left and right that may be exchanged in any frame,
            and pair_side: (M,) the probability that they are not.
        box: (F, 3) left and top edge and side px of the grid of parts. part: (F, S, S, 2) the two likeliest parts, and
            chance: (F, S, S, 2) their probabilities. parts_weight: (F,). part_capsules: (P, k) capsules of each part,
            those of a part with fewer than k repeated.
        seen: (F, M, 2) px that see the surface points on capsule (F, M) at (F, M) along its axis in the direction
            normal (F, M, 3) of its link. sure: (F, M) in [0, 1].
    """

    unit: Tensor
    view: Tensor
    up: Tensor
    view_weight: Tensor
    path: Array
    trunk: Tensor
    node: Tensor
    uv: Tensor
    confidence: Tensor
    alone: Tensor
    pairs: Tensor
    pair_side: Tensor
    box: Tensor
    part: Tensor
    chance: Tensor
    parts_weight: Tensor
    part_capsules: Tensor
    seen: Tensor
    capsule: Tensor
    along: Tensor
    normal: Tensor
    sure: Tensor

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of what there is anything of: of view, keypoints, parts, surface."""
        return tuple(name for name, weight in GROUPS.items() if bool((getattr(self, weight) > 0).any()))

    def without(self, groups: Sequence[str]) -> "Evidence":
        """The same with some groups silenced."""
        return replace(self, **{GROUPS[g]: torch.zeros_like(getattr(self, GROUPS[g])) for g in groups})

    def paths(self) -> list[tuple[str, Array]]:
        """Azimuths (F,) rad of the whole clip worth a hypothesis: the decided one, and each of its mirror images that
        the frames give some probability and that differs. Empty without a view."""
        if "view" not in self.groups:
            return []
        out = [("decided", self.path)]
        known = (self.view_weight > 0).numpy()
        centres = 2 * np.pi * np.arange(BINS) / BINS
        for name, (sign, shift) in MIRRORS:
            path = sign * self.path + shift
            near = np.abs(_wrap(centres - path[:, None])) < MODE
            mass = float((self.view.numpy() * near).sum(1)[known].mean())
            apart = [np.median(np.abs(_wrap(path - other))) for _, other in out]
            if mass > RIVAL and min(apart) > APART:
                out.append((name, path))
        return out


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def gather(arrays: Mapping[str, Array], obs: Observations, skeleton: Skeleton) -> Evidence:
    """Evidence from the arrays of evidence.npz, any group of which may be absent or have no frames.

    Each fit frame takes the nearest frame of the evidence within half a step of the fit. Key points and parts that the
    skeleton does not have are left out.
    """
    f = lambda x: torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)  # noqa: E731
    known, at = labels(skeleton), obs.at.numpy()
    frame = np.asarray(arrays.get("frame", []), int)
    step = int(at[1] - at[0]) if len(at) > 1 else 1
    gap = np.abs(at[:, None] - frame) if len(frame) else np.ones((len(at), 1)) * np.inf
    source = gap.argmin(1)
    there = (gap.min(1) <= step / 2) & ~obs.empty

    def rows(name: str, *, like: tuple[int, ...]) -> tuple[Array, Array]:
        """(F, ...) the array's rows at the fit frames, and (F,) whether there is one; (F, *like) zeros without any."""
        a = np.asarray(arrays[name]) if name in arrays else np.zeros((0, *like))
        if len(a) == 0 or a.size == 0 or len(a) != len(frame):
            return np.zeros((len(at), *like)), np.zeros(len(at), bool)
        return a[source], there

    view, has_view = rows("view", like=(BINS,))
    up, _ = rows("view_up", like=(3,))
    path, has_path = rows("view_path", like=())
    node, uv, confidence, pairing = _keypoints(arrays, rows, skeleton, obs.scale)
    box, _ = rows("box", like=(3,))
    parts, has_parts = rows("parts", like=(len(known.parts) + 1, 1, 1))
    side = float(arrays.get("part_side", 1.0))
    parts = _ordered(parts, arrays, known) if has_parts.any() else parts
    surface, has_surface = rows("surface", like=(3, 1, 1))
    blur, _ = rows("surface_scale", like=surface.shape[2:])
    doubted = side * parts + (1 - side) * parts[:, known.mirror_part] if has_parts.any() else parts
    points = _surface(surface, blur, has_surface, parts if has_parts.any() else None, box, obs, learnt(skeleton))
    # The place on the other limb is as likely as the sides are doubtful: what is left is the difference of the two. A
    # person whose sides are in doubt may as well be seen from behind as from the front, and the trunk with them.
    sided = (known.mirror_part[known.capsule_part] != known.capsule_part) | (known.kind == "human")
    points["sure"] = points["sure"] * f(np.where(sided, 2 * side - 1, 1.0))[points["capsule"]]
    area = obs.mask.sum(1).numpy().astype(float)
    size = np.sqrt(np.maximum(area, 0.25 * np.median(area[area > 0])))
    return Evidence(
        unit=f(0.1 * size), view=f(view), up=f(up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-9)),
        view_weight=f(has_view) * obs.quality, path=_filled(path, has_view & has_path),
        trunk=torch.as_tensor(known.trunk), node=node, uv=f(uv), confidence=f(confidence), **pairing,
        box=f(np.where(has_parts[:, None], box * [*obs.scale, obs.scale.mean()], 1.0)),
        **_likeliest(doubted), parts_weight=f(has_parts) * obs.quality, part_capsules=_capsules(known),
        **points,
    )  # fmt: skip


def learnt(skeleton: Skeleton) -> Labels:
    """The labels whose canonical surface a network speaks of: those of the built-in skeleton of that kind, which it was
    trained with, as long as the given one has the same capsules, of whatever lengths; else the given one's own."""
    own = load_skeleton(skeleton.kind) if skeleton.kind in list_skeletons() else skeleton
    return labels(own if own.capsule_names == skeleton.capsule_names else skeleton)


def _filled(path: Array, known: Array) -> Array:
    """Angles (F,) rad with those not known interpolated, continuous; NaN when none is."""
    if not known.any():
        return np.full(len(path), np.nan)
    k = np.flatnonzero(known)
    return np.interp(np.arange(len(path)), k, np.unwrap(np.asarray(path, float)[k]))


def _keypoints(
    arrays: Mapping[str, Array], rows, skeleton: Skeleton, scale: Array
) -> tuple[Tensor, Array, Array, dict[str, Tensor]]:
    names = [str(n) for n in arrays.get("keypoint_names", ())]
    uv, there = rows("keypoints", like=(len(names), 2))
    confidence, _ = rows("keypoint_confidence", like=(len(names),))
    own = [i for i, n in enumerate(names) if n in skeleton.names]
    node = torch.tensor([skeleton.names.index(names[i]) for i in own], dtype=torch.long)
    uv, confidence = np.asarray(uv, float)[:, own], np.asarray(confidence, float)[:, own]
    confidence = np.where(np.isfinite(uv).all(-1) & there[:, None], np.nan_to_num(confidence).clip(0, 1), 0.0)
    side = np.asarray(arrays.get("keypoint_side", np.ones(len(names))), float)[own]
    return node, (np.nan_to_num(uv) + 0.5) * scale - 0.5, confidence, _paired(node.tolist(), side, skeleton)


def _paired(node: list[int], side: Array, skeleton: Skeleton) -> dict[str, Tensor]:
    """Columns whose side is in doubt, with those of the other limb: the nearest with the same doubt, of one source."""
    pairs: list[tuple[int, int]] = []
    for i, m in enumerate(node):
        other = int(skeleton.mirror[m])
        found = [j for j, n in enumerate(node) if n == other and side[j] == side[i]]
        if side[i] < 1 and m < other and found:
            pairs.append((i, min(found, key=lambda j: abs(j - i))))
    taken = {c for p in pairs for c in p}
    return dict(
        alone=torch.tensor([i for i in range(len(node)) if i not in taken], dtype=torch.long),
        pairs=torch.tensor(pairs, dtype=torch.long).reshape(-1, 2).T,
        pair_side=torch.tensor([side[i] for i, _ in pairs], dtype=torch.float32),
    )


def _ordered(parts: Array, arrays: Mapping[str, Array], known: Labels) -> Array:
    """(F, P + 1, S, S) in the skeleton's order of parts, background first; zeros for parts that nothing is said of."""
    names = [str(n) for n in arrays["part_names"]]
    out = np.zeros((len(parts), len(known.parts) + 1, *parts.shape[2:]), np.uint8)
    out[:, 0] = parts[:, 0]
    for n, name in enumerate(known.parts):
        if name in names:
            out[:, n + 1] = parts[:, names.index(name) + 1]
    return out


def _likeliest(parts: Array) -> dict[str, Tensor]:
    """The two likeliest parts of each cell, from probabilities * 255 (F, P + 1, S, S): left and right, mostly."""
    chance, part = torch.as_tensor(np.ascontiguousarray(parts[:, 1:].transpose(0, 2, 3, 1))).topk(2, -1)
    return dict(part=part, chance=chance.float() / 255)


def _capsules(known: Labels) -> Tensor:
    each = [np.flatnonzero(known.capsule_part == p + 1) for p in range(len(known.parts))]
    return torch.as_tensor(np.stack([np.resize(c, max(map(len, each))) for c in each]))


def _surface(
    surface: Array, blur: Array, there: Array, parts: Array | None, box: Array, obs: Observations, known: Labels
) -> dict[str, Tensor]:
    """Random cells of the grid inside the mask, and the places on the body at rest that they are said to see."""
    F, K = len(surface), obs.K
    rng = np.random.default_rng(SEED)
    uv, sure = np.zeros((F, POINTS, 2)), np.zeros((F, POINTS))
    X, part = np.zeros((F, POINTS, 3)), np.zeros((F, POINTS), int)
    size = surface.shape[-1]
    y, x = np.mgrid[:size, :size].reshape(2, -1)
    for k in np.flatnonzero(there):
        at = (np.stack([x, y], -1) + 0.5) * (box[k, 2] / size) + box[k, :2]
        at = at * obs.scale - 0.5
        near = np.round(at).astype(int)
        inside = ((near >= 0) & (near < [K.width, K.height])).all(1)
        flat = (near[:, 1] * K.width + near[:, 0]).clip(0, K.width * K.height - 1)
        label = parts[k].reshape(len(parts[k]), -1).argmax(0) if parts is not None else np.zeros(len(x), int)
        inside &= obs.mask[k].numpy()[flat] & (label > 0 if parts is not None else True)
        cells = np.flatnonzero(inside)
        if not len(cells):
            continue
        cells = rng.choice(cells, POINTS, replace=len(cells) < POINTS)
        uv[k], part[k] = at[cells], label[cells]
        X[k] = surface[k].reshape(3, -1)[:, cells].T
        b = blur[k].reshape(-1)[cells].astype(float)
        sure[k] = 1 / (1 + (b / SCALE) ** 2) * float(obs.quality[k])
    capsule, along, normal = nearest(X, part, known)
    f = lambda a: torch.as_tensor(a, dtype=torch.float32)  # noqa: E731
    return dict(seen=f(uv), capsule=torch.as_tensor(capsule), along=f(along), normal=f(normal), sure=f(sure))


def nearest(X: Array, part: Array, known: Labels) -> tuple[Array, Array, Array]:
    """Capsule (...,) of the given part (0: any) whose surface at rest is nearest to canonical points X (..., 3), place
    along its axis (...,) and unit direction (..., 3) from there: the inverse of `Labels.canonical`."""
    axis = known.b - known.a
    s = ((X[..., None, :] - known.a) * axis).sum(-1) / np.maximum((axis**2).sum(-1), 1e-12)
    s = s.clip(0, 1)
    out = X[..., None, :] - (known.a + s[..., None] * axis)
    length = np.linalg.norm(out, axis=-1)
    away = np.abs(length - (known.radii[:, 0] + s * (known.radii[:, 1] - known.radii[:, 0])))
    away = np.where((part[..., None] == 0) | (known.capsule_part == part[..., None]), away, np.inf)
    c = away.argmin(-1)[..., None]
    take = lambda a: np.take_along_axis(a, c, -1)[..., 0]  # noqa: E731
    normal = np.take_along_axis(out / np.maximum(length, 1e-9)[..., None], c[..., None], -2)[..., 0, :]
    return c[..., 0], take(s), normal
