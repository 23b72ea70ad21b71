"""The zero level set of the signed distance field as a coloured, skinned triangle mesh."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from warp.geometry import IsoSurfaceMarchingCubes

from slomo import quiet_warp
from slomo.errors import StageFailed
from slomo.reconstruct.fields import networks, skinning
from slomo.reconstruct.fields.canonical import Rest, rest
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.kinematics import Kinematics, Posed

Array = np.ndarray
Tensor = torch.Tensor

CHUNK = 32768  # points evaluated at once


@dataclass(frozen=True)
class BodyMesh:
    """V vertices, F triangles, B links of the skeleton; canonical frame: x forward, y left, z up, root at the origin.

    Attributes:
        vertices: (V, 3) world units. faces: (F, 3), counter-clockwise from outside. colours: (V, 3) sRGB in [0, 1].
        weights: (V, B) of the links, rows sum to 1. q: (B, 3) rad, the joints' angles at rest, see `canonical.apart`.
        capsule_weights: (V, C), what `posed` needs.
    """

    vertices: Array
    faces: Array
    colours: Array
    weights: Array
    q: Array
    capsule_weights: Array


def mesh(
    variables: Mapping[str, Tensor], config: FieldsConfig, kin: Kinematics, shape: dict[str, Tensor], *,
    cell: float = 0.015,
) -> BodyMesh:  # fmt: skip
    """Marching cubes (Lorensen and Cline 1987) over the box of the capsules at rest.

    Args:
        shape: shape variables of one hypothesis. cell: of the grid, body lengths.

    Raises:
        StageFailed: the field has no surface within the box.
    """
    v = dict(variables)
    with torch.no_grad():
        body = rest(kin, shape)
        c = body.capsules
        reach = float(c.radii.max()) + 0.1
        ends = torch.cat([c.a, c.b])
        lower, upper = ends.amin(0) - reach, ends.amax(0) + reach
        count = torch.ceil((upper - lower) / cell).long() + 1
        axes = [float(lower[k]) + cell * torch.arange(int(count[k]), device=lower.device) for k in range(3)]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        sdf = torch.cat([_sdf(v, config, body, x) for x in grid.split(CHUNK)])
        place, triangles = _level(sdf.reshape(*count.tolist()).cpu().numpy(), lower, lower + cell * (count - 1))
        x = torch.as_tensor(place, dtype=torch.float32, device=lower.device)
        colours, weights = [], []
        quadric = skinning.quadric(c)
        for part in x.split(CHUNK):
            _, features = networks.residual(v, part, config.frequencies)
            colours.append(networks.colour(v, part, features))
            still = networks.delta(v, part[None], part.new_zeros(1, 3 * (kin.B - 1)))
            weights.append(skinning.weights(quadric[None], part[None], still)[0])
        of_capsules = torch.cat(weights)
        of_links = of_capsules.new_zeros(len(x), kin.B).index_add(1, kin.c_link, of_capsules)
        L = float(shape["log_length"].exp()[0])
    f = lambda y: y.cpu().numpy().astype(float)  # noqa: E731
    return BodyMesh(place * L, triangles, f(torch.cat(colours)), f(of_links), f(body.q), f(of_capsules))


def posed(
    mesh: BodyMesh, kin: Kinematics, shape: dict[str, Tensor], body: Posed, R_root: Tensor, q: Tensor, at: Tensor
) -> Array:
    """(N, V, 3) vertices in the world, world units, at times `at` (N,) of the posed body of hypothesis 0, by the same
    blend of dual quaternions as the rendering."""
    with torch.no_grad():
        bones = skinning.bones(kin, body, R_root, q, at, rest(kin, shape))
        L = body.length[0]
        x = torch.as_tensor(mesh.vertices, dtype=torch.float32, device=L.device) / L
        w = torch.as_tensor(mesh.capsule_weights, dtype=torch.float32, device=L.device)
        out = [
            skinning.forward(skinning.blend(w, dual), x) * L @ R_root[0, k].T + body.nodes[0, k, 0]
            for dual, k in zip(bones.dual, at.tolist(), strict=True)
        ]
    return torch.stack(out).cpu().numpy().astype(float)


def _sdf(v: networks.Variables, config: FieldsConfig, body: Rest, x: Tensor) -> Tensor:
    return body.capsules.union(x) + networks.residual(v, x, config.frequencies)[0]


def _level(sdf: Array, lower: Tensor, upper: Tensor) -> tuple[Array, Array]:
    """Vertices (V, 3) and faces (F, 3) of the zero level of a grid of distances, its largest connected piece."""
    if not (sdf.min() < 0 < sdf.max()):
        raise StageFailed("the field has no surface to export", where="mesh")
    quiet_warp.init()
    field = wp.array(sdf.astype(np.float32), dtype=float, device="cpu")
    vertices, faces = IsoSurfaceMarchingCubes.extract(
        field,  # pyright: ignore[reportArgumentType]
        0.0,
        lower=wp.vec3(*lower.tolist()),
        upper=wp.vec3(*upper.tolist()),
    )
    return _largest(vertices.numpy().astype(float), faces.numpy().reshape(-1, 3))


def _largest(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Only the piece with the most vertices: a residual may leave crumbs where no ray ever passed."""

    n = len(vertices)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    keep = label == np.bincount(label).argmax()
    number = np.cumsum(keep) - 1
    return vertices[keep], number[faces[keep[faces].all(1)]].astype(np.int32)
