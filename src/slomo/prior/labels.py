"""What the networks are asked: key points, parts, canonical surface points and the root view of a skeleton.

Canonical surface: a point on the surface of capsule c lies at a fraction s of its axis and in a direction n of its
link. Its canonical coordinates are those of the same (c, s, n) on the skeleton at rest: body lengths, x forward, y
left, z up, origin at the root. They are the same for every animal of a kind, whatever its proportions and pose.

Root view: the view frame is the camera's, turned so that z points at the subject. Azimuth is the direction to the
camera about the body's up axis, from its forward axis towards its left: 0 = seen from the front, pi/2 = from its left.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slomo.skeleton import Skeleton

Array = np.ndarray

BINS = 36  # of azimuth; bin k is centred at 2 pi k / BINS
SURFACE_UNIT = 40.0  # steps of a stored surface coordinate a body length


@dataclass(frozen=True)
class Labels:
    """What can be said about a picture of one kind of body.

    Attributes:
        keypoints: K names, the skeleton's nodes.  mirror_keypoint: (K,) index of the other side's.
        parts: P names; in label images 0 is the background and part p is p + 1.  mirror_part: (P + 1,) of labels.
        capsule_part: (C,) label of each capsule.
        a, b: (C, 3) ends of the capsules at rest, body lengths.  radii: (C, 2).
        trunk: (N,) key points that move as one rigid trunk.  trunk_rest: (N, 3) at rest.
    """

    kind: str
    keypoints: tuple[str, ...]
    mirror_keypoint: Array
    parts: tuple[str, ...]
    mirror_part: Array
    capsule_part: Array
    a: Array
    b: Array
    radii: Array
    trunk: Array
    trunk_rest: Array

    def canonical(self, capsule: Array, s: Array, n: Array) -> Array:
        """(..., 3) canonical coordinates. Args: capsule (...,); s (...,) in [0, 1]; n (..., 3) unit, link frame."""
        a, b, r = self.a[capsule], self.b[capsule], self.radii[capsule]
        s = s[..., None]
        return a + s * (b - a) + (r[..., :1] + s * (r[..., 1:] - r[..., :1])) * n

    def trunk_rotation(self, keypoints: Array) -> Array:
        """(..., 3, 3) body to world: the rotation that best takes the trunk at rest to key points (..., K, 3)."""
        x = keypoints[..., self.trunk, :]
        x = x - x.mean(-2, keepdims=True)
        rest = self.trunk_rest - self.trunk_rest.mean(0)
        u, _, vt = np.linalg.svd(np.swapaxes(x, -1, -2) @ rest)
        sign = np.ones((*u.shape[:-2], 3))
        sign[..., 2] = np.linalg.det(u @ vt)
        return (u * sign[..., None, :]) @ vt


def mirror_of(names: Sequence[str]) -> Array:
    """(N,) index of the name of the other side, its own where there is none."""
    flip = [n.replace("left", "right") if "left" in n else n.replace("right", "left") for n in names]
    return np.array([names.index(f) for f in flip])


def labels(skeleton: Skeleton) -> Labels:
    """The labels of a skeleton."""
    rest = skeleton.rest()
    own = skeleton.capsule_nodes == skeleton.capsule_link[:, None]
    link_at = rest[skeleton.capsule_link][:, None]
    ends = np.where(own[..., None], link_at, rest[skeleton.capsule_nodes]) + skeleton.capsule_shift
    rigid = [i for i, g in enumerate(skeleton.group_names) if g in ("trunk", "shoulder")]
    trunk = np.flatnonzero(np.isin(skeleton.group, rigid) | (skeleton.group < 0))
    return Labels(
        kind=skeleton.kind,
        keypoints=skeleton.names,
        mirror_keypoint=mirror_of(skeleton.names),
        parts=skeleton.part_names,
        mirror_part=np.concatenate([[0], 1 + mirror_of(skeleton.part_names)]),
        capsule_part=skeleton.capsule_part + 1,
        a=ends[:, 0],
        b=ends[:, 1],
        radii=skeleton.capsule_radii,
        trunk=trunk,
        trunk_rest=rest[trunk],
    )


def toward(x: Array) -> Array:
    """(..., 3, 3) camera to view frame: the least turn that brings the direction x (..., 3) onto the optical axis."""
    z = x / np.linalg.norm(x, axis=-1, keepdims=True)
    # Rotation from z to (0, 0, 1) about their common normal (Rodrigues).
    c = z[..., 2]
    vx, vy = z[..., 1], -z[..., 0]
    k = 1 / (1 + c)
    rows = [[c + vx * vx * k, vx * vy * k, vy], [vx * vy * k, c + vy * vy * k, -vx], [-vy, vx, c]]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def view_of(R_view_body: Array) -> tuple[Array, Array]:
    """Azimuth (...,) rad and the body's up axis (..., 3) in the view frame."""
    to_camera = -R_view_body[..., 2, :]  # (0, 0, -1) of the view frame, in the body's
    return np.arctan2(to_camera[..., 1], to_camera[..., 0]), R_view_body[..., :, 2]


def rotation_of(azimuth: Array, up: Array) -> Array:
    """(..., 3, 3) R_view_body from what `view_of` returns (`up` need not be a unit vector)."""
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    d = np.array([0.0, 0.0, -1.0])
    h = d - (up @ d)[..., None] * up
    h = h / np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-9)
    side = np.cross(up, h)
    c, s = np.cos(azimuth)[..., None], np.sin(azimuth)[..., None]
    x = c * h - s * side
    return np.stack([x, np.cross(up, x), up], -1)
