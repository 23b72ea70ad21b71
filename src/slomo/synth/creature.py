"""Creatures for the prior's training: any skeleton, with random proportions, flesh and coat, as a skinned mesh.

Lengths are body lengths of the skeleton. The mesh is built in a pose with the limbs apart, so that they do not grow
together, and is labelled with parts and canonical surface coordinates as `slomo.prior.labels` defines them.
"""

from dataclasses import dataclass

import numpy as np

from slomo.flesh import Cone, mesh, value_noise
from slomo.mesh import vertex_normals
from slomo.prior.labels import labels
from slomo.skeleton import Skeleton
from slomo.synth.coat import coat
from slomo.synth.variety import Build, build, extras

Array = np.ndarray


def joint_rotation(q: Array) -> Array:
    """(..., 3, 3) of angles (..., 3) rad about x, y, z, as the skeleton's joints turn: Ry Rx Rz."""
    (cx, cy, cz), (sx, sy, sz) = (np.moveaxis(f(q), -1, 0) for f in (np.cos, np.sin))
    rows = [
        [cy * cz + sy * sx * sz, sy * sx * cz - cy * sz, sy * cx],
        [cx * sz, cx * cz, -sx],
        [cy * sx * sz - sy * cz, sy * sz + cy * sx * cz, cy * cx],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def forward(skeleton: Skeleton, offset: Array, q: Array) -> tuple[Array, Array]:
    """Link rotations (..., B, 3, 3) and node positions (..., M, 3) in the root's frame.

    Args:
        offset: (M, 3) of the nodes in their links.  q: (..., B, 3) rad; the root's row is not used.
    """
    local = joint_rotation(q)
    R = np.empty((*q.shape[:-1], 3, 3))
    p = np.zeros((*q.shape[:-2], len(offset), 3))
    R[..., 0, :, :] = np.eye(3)
    for m in range(1, len(offset)):
        k = skeleton.link[m]
        p[..., m, :] = p[..., k, :] + R[..., k, :, :] @ offset[m]
        if m < skeleton.link_count:
            R[..., m, :, :] = R[..., k, :, :] @ local[..., m, :, :]
    return R, p


@dataclass(frozen=True)
class Creature:
    """A skinned, labelled, coloured body.

    Attributes:
        offset: (M, 3) its nodes in their links, body lengths.  build: what was drawn for it.
        vertices: (V, 3) in its bind pose.  triangles: (F, 3).  weights: (V, B), rows sum to 1.
        part: (V,) label.  surface: (V, 3) canonical coordinates.  link: (V,) that carries the vertex most.
        bind_R, bind_p: (B, 3, 3), (B, 3) of the links in the bind pose.
    """

    skeleton: Skeleton
    build: Build
    offset: Array
    vertices: Array
    triangles: Array
    weights: Array
    part: Array
    surface: Array
    link: Array
    bind_R: Array
    bind_p: Array

    def skin(self, R: Array, p: Array) -> Array:
        """(V, 3) the mesh with links at rotations R (B, 3, 3) and places p (B, 3)."""
        turn = R @ np.swapaxes(self.bind_R, 1, 2)
        shift = p - (turn @ self.bind_p[:, :, None])[:, :, 0]
        M = np.concatenate([turn, shift[:, :, None]], 2).reshape(len(R), 12)
        T = (self.weights @ M).reshape(-1, 3, 4)
        return (T[:, :, :3] @ self.vertices[:, :, None])[:, :, 0] + T[:, :, 3]

    def colors(self, rng: np.random.Generator) -> Array:
        """(V, 3) sRGB, a new coat or new clothes at every call."""
        return coat(self.skeleton, self.link, self.surface, rng)


def _roughened(vertices: Array, triangles: Array, amount: float, rng: np.random.Generator) -> Array:
    """Vertices pushed along their normals by noise of up to `amount`."""
    noise = 2 * value_noise(vertices * 25, rng) - 1
    return vertices + amount * noise[:, None] * vertex_normals(vertices, triangles)


def create(skeleton: Skeleton, seed: int) -> Creature:
    """A member, by seed, of the family that the skeleton stands for."""
    rng = np.random.default_rng([seed, 11])
    what = build(skeleton, rng)
    known = labels(skeleton)
    R, p = forward(skeleton, what.offset, what.bind)
    more = extras(skeleton, what, rng)
    link = np.concatenate([skeleton.capsule_link, [e.link for e in more]]).astype(int)
    own = skeleton.capsule_nodes == skeleton.capsule_link[:, None]
    ends = np.where(own[..., None], 0.0, what.offset[skeleton.capsule_nodes]) + what.shift
    ends = np.concatenate([ends, np.array([[e.a, e.b] for e in more]).reshape(-1, 2, 3)])
    radii = np.concatenate([what.radii, np.array([e.radii for e in more]).reshape(-1, 2)])
    ends = p[link][:, None] + (R[link][:, None] @ ends[..., None])[..., 0]
    # Round cones in a space that is stretched sideways make a body that is deeper than wide.
    stretch = np.ones(3)
    stretch[0 if skeleton.kind == "human" else 1] = 1 / what.squash
    ends = ends * stretch
    cones = [Cone(int(k), a, b + 1e-6, *r) for k, (a, b), r in zip(link, ends, radii, strict=True)]
    vertices, triangles = mesh(cones, cell=0.38 * float(np.median(skeleton.capsule_radii)), blend=0.012)
    distance = np.stack([c.distance(vertices) for c in cones], 1)
    near = np.full((len(vertices), skeleton.link_count), np.inf)
    for c, d in zip(cones, distance.T, strict=True):
        near[:, c.bone] = np.minimum(near[:, c.bone], d)
    weights = np.exp(-(near - near.min(1, keepdims=True)) / 0.02)
    weights[weights < 0.02] = 0
    # A vertex of an extra (an ear, a hump) belongs to the part that carries it, and lies on that part's own capsule.
    C = len(known.capsule_part)
    part_of = np.concatenate([known.capsule_part, [e.part for e in more]]).astype(int)
    part = part_of[distance.argmin(1)]
    capsule = np.where(known.capsule_part == part[:, None], distance[:, :C], np.inf).argmin(1)
    s, n = np.zeros(len(vertices)), np.zeros((len(vertices), 3))
    for c in np.unique(capsule):
        mine = capsule == c
        cone = cones[c]
        s[mine] = cone.along(vertices[mine])
        away = vertices[mine] - cone.a - s[mine, None] * (cone.b - cone.a)
        n[mine] = (away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)) @ R[cone.bone]
    vertices = _roughened(vertices, triangles, what.fur, rng) / stretch
    return Creature(
        skeleton, what, what.offset, vertices, triangles, weights / weights.sum(1, keepdims=True), part,
        known.canonical(capsule, s, n), near.argmin(1), R, p[: skeleton.link_count],
    )  # fmt: skip
