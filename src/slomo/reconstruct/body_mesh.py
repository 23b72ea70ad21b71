"""The fitted body as a mesh that its links move: its capsules as one smooth skin, or the surface of the field."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch

from slomo import flesh
from slomo.mesh import SkinnedMesh, heaviest
from slomo.reconstruct.fields.canonical import apart
from slomo.reconstruct.kinematics import Kinematics, Posed

if TYPE_CHECKING:
    from slomo.reconstruct.fields.mesh import BodyMesh

Array = np.ndarray

# In radii of the capsules (their median): cell of the grid, how far surfaces flow into each other, how far a link's
# hold on the skin reaches past its own flesh.
CELL, BLEND, REACH = 0.2, 0.15, 0.25
MIDDLE, LEFT, RIGHT = (0.72, 0.70, 0.66), (0.90, 0.62, 0.0), (0.34, 0.71, 0.91)  # sRGB


def link_frames(body: Posed, metres_per_unit: float) -> Array:
    """(T, B, 4, 4) m, link to world, of the first hypothesis."""
    R = body.R[0].detach().cpu().numpy().astype(float)
    T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
    T[..., :3, :3] = R
    T[..., :3, 3] = body.nodes[0, :, : R.shape[1]].detach().cpu().numpy() * metres_per_unit
    return T


def bind_pose(kin: Kinematics, shape: Mapping[str, torch.Tensor], q: Array) -> Posed:
    """The first hypothesis' body with joint angles q (B, 3) rad, its root at the origin: T = 1."""
    one = {k: v[:1].detach() for k, v in shape.items()}
    like = one["log_length"]
    return kin.pose(
        one, like.new_zeros(1, 1, 3), torch.eye(3).to(like).expand(1, 1, 3, 3), like.new_tensor(q)[None, None]
    )


def body_mesh(
    kin: Kinematics, shape: Mapping[str, torch.Tensor], body: Posed, t: Array, *, metres_per_unit: float
) -> SkinnedMesh:
    """The skin of the capsules: their smooth union by marching cubes in a pose with the limbs apart; at most four links
    move a vertex. Coloured by side (left orange, right blue).

    Args:
        shape: variables of the first hypothesis, as of `Kinematics.pose`.  body: posed at the times t (T,) s.
    """
    skeleton = kin.skeleton
    bind = bind_pose(kin, shape, apart(skeleton))
    ends_and_radii = (bind.a[0, 0], bind.b[0, 0], bind.radii[0])
    a, b, radii = (x.cpu().numpy().astype(float) * metres_per_unit for x in ends_and_radii)
    cones = [flesh.Cone(int(k), *ends) for k, *ends in zip(skeleton.capsule_link, a, b, *radii.T, strict=True)]
    radius = float(np.median(radii))
    vertices, faces = flesh.mesh(cones, cell=CELL * radius, blend=BLEND * radius)
    near = np.full((len(vertices), kin.B), np.inf)
    for c in cones:
        near[:, c.bone] = np.minimum(near[:, c.bone], c.distance(vertices))
    links, w = heaviest(np.exp(-(near - near.min(1, keepdims=True)) / (REACH * radius)), 4)
    weights = np.zeros_like(near)
    np.add.at(weights, (np.arange(len(vertices))[:, None], links), w)
    by_side = np.array([LEFT if "left" in n else RIGHT if "right" in n else MIDDLE for n in skeleton.names[: kin.B]])
    return _moved(kin, bind, body, t, vertices, faces, weights @ by_side, weights, metres_per_unit)


def field_mesh(
    surface: "BodyMesh", kin: Kinematics, shape: Mapping[str, torch.Tensor], body: Posed, t: Array, *,
    metres_per_unit: float,
) -> SkinnedMesh:  # fmt: skip
    """The surface of the field (`fields.mesh.mesh`) in metres, moved by the links at the times t (T,) s of `body`.

    Files know linear blend skinning alone; the field itself is posed by dual quaternions, which keep more of its volume
    where a joint bends far.
    """
    bind = bind_pose(kin, shape, surface.q)
    vertices = surface.vertices * metres_per_unit
    return _moved(kin, bind, body, t, vertices, surface.faces, surface.colours, surface.weights, metres_per_unit)


def _moved(
    kin: Kinematics, bind: Posed, body: Posed, t: Array, vertices: Array, faces: Array, colours: Array, weights: Array,
    metres_per_unit: float,
) -> SkinnedMesh:  # fmt: skip
    skeleton = kin.skeleton
    return SkinnedMesh(
        vertices=vertices, faces=faces.astype(np.int32), colours=np.clip(colours, 0, 1), weights=weights,
        link_names=skeleton.names[: kin.B], link_parents=skeleton.link[: kin.B],
        rest=link_frames(bind, metres_per_unit)[0], T_world_link=link_frames(body, metres_per_unit),
        t=np.asarray(t, float),
    )  # fmt: skip
