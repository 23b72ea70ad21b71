"""The fitted body as a mesh: its capsules as one smooth skin, moved by its links and coloured from the clip."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from slomo import flesh
from slomo.mesh import SkinnedMesh, heaviest
from slomo.raycast import Light, Part, Scene
from slomo.reconstruct.kinematics import Kinematics, Posed
from slomo.skeleton import Skeleton

Array = np.ndarray

# In radii of the capsules (their median): cell of the grid, how far surfaces flow into each other, how far a link's
# hold on the skin reaches past its own flesh.
CELL, BLEND, REACH = 0.2, 0.15, 0.25
APART = 0.8  # rad at most by which limbs stand off in the pose of the skin, so that they do not grow together
COLOUR_FRAMES = 24  # frames from which colours are taken
EDGE = 2  # px of the picture inside the mask's edge that are not used: they are mixed with what is behind
MIDDLE, LEFT, RIGHT = (0.72, 0.70, 0.66), (0.90, 0.62, 0.0), (0.34, 0.71, 0.91)  # sRGB where the clip shows nothing


def link_frames(body: Posed, metres_per_unit: float) -> Array:
    """(T, B, 4, 4) m, link to world, of the first hypothesis."""
    R = body.R[0].detach().numpy().astype(float)
    T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
    T[..., :3, :3] = R
    T[..., :3, 3] = body.nodes[0, :, : R.shape[1]].detach().numpy() * metres_per_unit
    return T


def apart(skeleton: Skeleton) -> Array:
    """(B, 3) rad: the rest pose with each limb swung outwards by half its range, `APART` at most."""
    q = np.zeros((skeleton.link_count, 3))
    for j in range(1, skeleton.link_count):
        parent = skeleton.link[j]
        if skeleton.mirror[j] != j and skeleton.mirror[parent] == parent:
            side = np.sign(skeleton.offset[j, 1])
            reach = skeleton.upper[j, 0] if side > 0 else -skeleton.lower[j, 0]
            q[j, 0] = side * min(APART, reach / 2)
    return q


def body_mesh(
    kin: Kinematics, shape: Mapping[str, torch.Tensor], body: Posed, t: Array, *, metres_per_unit: float
) -> SkinnedMesh:
    """The skin of the capsules: their smooth union by marching cubes in a pose with the limbs apart; at most four links
    move a vertex. Coloured by side (left orange, right blue).

    Args:
        shape: variables of the first hypothesis, as of `Kinematics.pose`.  body: posed at the times t (T,) s.
    """
    skeleton = kin.skeleton
    with torch.no_grad():
        q = torch.as_tensor(apart(skeleton), dtype=torch.float32)[None, None]
        one = {k: v[:1] for k, v in shape.items()}
        bind = kin.pose(one, torch.zeros(1, 1, 3), torch.eye(3).expand(1, 1, 3, 3), q)
    a, b, radii = (x.numpy().astype(float) * metres_per_unit for x in (bind.a[0, 0], bind.b[0, 0], bind.radii[0]))
    cones = [flesh.Cone(int(k), *ends) for k, *ends in zip(skeleton.capsule_link, a, b, *radii.T, strict=True)]
    radius = float(np.median(radii))
    vertices, faces = flesh.mesh(cones, cell=CELL * radius, blend=BLEND * radius)
    near = np.full((len(vertices), kin.B), np.inf)
    for c in cones:
        near[:, c.bone] = np.minimum(near[:, c.bone], c.distance(vertices))
    links, w = heaviest(np.exp(-(near - near.min(1, keepdims=True)) / (REACH * radius)), 4)
    weights = np.zeros_like(near)
    np.add.at(weights, (np.arange(len(vertices))[:, None], links), w)
    names = skeleton.names[: kin.B]
    by_side = np.array([LEFT if "left" in n else RIGHT if "right" in n else MIDDLE for n in names])
    return SkinnedMesh(
        vertices=vertices, faces=faces.astype(np.int32), colours=weights @ by_side, weights=weights, link_names=names,
        link_parents=skeleton.link[: kin.B], rest=link_frames(bind, metres_per_unit)[0],
        T_world_link=link_frames(body, metres_per_unit), t=np.asarray(t, float),
    )  # fmt: skip


def coloured_by_clip(
    mesh: SkinnedMesh, picture: Callable[[int], Array], mask: Callable[[int], Array], K: Array, T_world_cam: Array
) -> SkinnedMesh:
    """The mesh in the colours that the clip shows: the mean over frames of the pixels that see a vertex, those that see
    it squarely counting most. What is never seen has the colours of its mirror image, else of what is around it.

    Args:
        picture: (H, W, 3) uint8 RGB of the frame at `mesh.t[k]`.  mask: (H, W) bool, the subject there.
        K: (3, 3) px.  T_world_cam: (T, 4, 4) m.
    """
    total, seen = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    scene = Scene({"body": Part(mesh.vertices, mesh.faces, np.ones(3))}, Light(ground="none"))
    for k in np.unique(np.linspace(0, len(mesh.t) - 1, min(COLOUR_FRAMES, len(mesh.t))).astype(int)):
        inside = _eroded(mask(int(k)))
        if not inside.any():
            continue
        v, u = (slice(x.min(), x.max() + 1) for x in np.nonzero(inside))
        inside, rgb = inside[v, u], picture(int(k))[v, u]
        posed = mesh.posed(int(k))
        scene.move({"body": posed})
        image = scene.render(K - [[0, 0, u.start], [0, 0, v.start], [0, 0, 0]], T_world_cam[k], inside.shape[::-1])
        use = inside & (image.ids[..., 0] > 0)
        corners = mesh.faces[image.faces[..., 0][use]]
        p, q, r = (posed[corners[:, n]] for n in range(3))
        n, ray = np.cross(q - p, r - p), image.points[..., 0, :][use] - T_world_cam[k, :3, 3]
        square = np.einsum("ij,ij->i", n, ray) ** 2 / np.maximum((n**2).sum(1) * (ray**2).sum(1), 1e-20)
        w = image.weights[..., 0, :][use] * square[:, None]
        seen += np.bincount(corners.ravel(), w.ravel(), len(seen))
        for c in range(3):
            total[:, c] += np.bincount(corners.ravel(), (w * rgb[use][:, c : c + 1] / 255).ravel(), len(seen))
    known = seen > 0.2 * np.median(seen[seen > 0]) if seen.any() else seen > 0
    if not known.any():
        return mesh
    colours = total / np.maximum(seen, 1e-9)[:, None]
    return replace(mesh, colours=_filled(mesh, colours, known))


def _eroded(mask: Array) -> Array:
    out = mask.copy()
    for _ in range(EDGE):
        grown = ~np.pad(out, 1)
        out &= ~(grown[:-2, 1:-1] | grown[2:, 1:-1] | grown[1:-1, :-2] | grown[1:-1, 2:])
    return out


def _filled(mesh: SkinnedMesh, colours: Array, known: Array) -> Array:
    """(V, 3): unknown colours (known (V,) bool) from the nearest vertex of the mirror image, then from neighbours."""
    from scipy.spatial import KDTree

    x = mesh.vertices
    reach = 3 * float(np.median(np.linalg.norm(x[mesh.faces[:, 0]] - x[mesh.faces[:, 1]], axis=1)))
    near, mirrored = KDTree(x).query(x * [1, -1, 1])
    take = ~known & known[mirrored] & (near < reach)
    out = np.where(take[:, None], colours[mirrored], colours)
    known = known | take
    a, b = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    while not known.all():
        give = known[a] & ~known[b]
        if not give.any():  # pieces of which nothing is seen
            return np.where(known[:, None], out, mesh.colours)
        count = np.bincount(b[give], minlength=len(x))
        mean = np.stack([np.bincount(b[give], out[a[give], c], len(x)) for c in range(3)], 1)
        new = count > 0
        out[new] = mean[new] / count[new, None]
        known = known | new
    return out
