"""Colours of a moving mesh from the pixels of the clip that see it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from slomo.mesh import SkinnedMesh
from slomo.raycast import Light, Part, Scene

Array = np.ndarray

FRAMES = 24  # of the clip, from which colours are taken
EDGE = 2  # px of the picture inside the mask's edge that are not used: they are mixed with what is behind
ENOUGH = 0.2  # of the median weight of what is seen: vertices below it are as good as unseen


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
    for k in np.unique(np.linspace(0, len(mesh.t) - 1, min(FRAMES, len(mesh.t))).astype(int)):
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
    if not seen.any():
        return mesh
    known = seen > ENOUGH * np.median(seen[seen > 0])
    colours = total / np.maximum(seen, 1e-9)[:, None]
    return replace(mesh, colours=_filled(mesh, colours, known))


def _eroded(mask: Array) -> Array:
    out = mask.copy()
    for _ in range(EDGE):
        near = np.pad(out, 1)
        out &= near[:-2, 1:-1] & near[2:, 1:-1] & near[1:-1, :-2] & near[1:-1, 2:]
    return out


def _filled(mesh: SkinnedMesh, colours: Array, known: Array) -> Array:
    """(V, 3): unknown colours (known (V,) bool) from the nearest vertex of the mirror image, then from neighbours."""
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
