"""Forward kinematics of a skeleton in torch, for H hypotheses and T times at once.

Shape variables are unit normals: each is multiplied by the spread of what it changes; the prior is their square.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch

from slomo.skeleton import Limb, Skeleton

Tensor = torch.Tensor

# Animals differ in where their joints lie in the flesh by more than in their outline, so both are free: motion tells
# where a limb turns, the silhouette where its flesh ends.
NODE_SPREAD = 0.16  # s.d. of the log length of one offset, beside its group's
SHIFT_SPREAD = 0.05  # s.d. of the place of a node, body lengths
# How far apart the limbs of a pair are rooted varies by a share of itself: hips that meet are no hips.
ROOT_SPREAD = 0.3  # s.d. of how far aside of the trunk a limb's root lies, times that distance; `SHIFT_SPREAD` at most
RADIUS_SPREAD = 0.18  # s.d. of the log radius of one end of a capsule
FLESH_SPREAD = 0.03  # s.d. of the place of one end of a capsule against its node, body lengths
GIRTH_SPREAD = 0.15  # s.d. of the log of all radii together


@dataclass(frozen=True)
class Posed:
    """The posed body, world frame, world units.

    Attributes:
        nodes: (H, T, M, 3). R: (H, T, B, 3, 3) link to world.
        a, b: (H, T, C, 3) ends of the capsules. radii: (H, C, 2) at a and b.
        length: (H,) body length.
    """

    nodes: Tensor
    R: Tensor
    a: Tensor
    b: Tensor
    radii: Tensor
    length: Tensor


def rot(axis: int, angle: Tensor) -> Tensor:
    """(..., 3, 3) rotation by `angle` (...,) rad about x, y or z (0, 1, 2)."""
    c, s = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    if axis == 0:
        rows = (one, zero, zero, zero, c, -s, zero, s, c)
    elif axis == 1:
        rows = (c, zero, s, zero, one, zero, -s, zero, c)
    else:
        rows = (c, -s, zero, s, c, zero, zero, zero, one)
    return torch.stack(rows, -1).reshape(*angle.shape, 3, 3)


def yaw_pitch_roll(R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(...,) rad each of R (..., 3, 3) = rot(2, yaw) rot(1, pitch) rot(0, roll)."""
    yaw, roll = torch.atan2(R[..., 1, 0], R[..., 0, 0]), torch.atan2(R[..., 2, 1], R[..., 2, 2])
    return yaw, -torch.asin(R[..., 2, 0].clamp(-1, 1)), roll


def joint_rotation(q: Tensor) -> Tensor:
    """(..., 3, 3) of joint angles (..., 3) about x (abduction), y (flexion), z (twist): Ry Rx Rz, written out."""
    (cx, cy, cz), (sx, sy, sz) = torch.cos(q).unbind(-1), torch.sin(q).unbind(-1)
    rows = (
        cy * cz + sy * sx * sz, sy * sx * cz - cy * sz, sy * cx,
        cx * sz, cx * cz, -sx,
        cy * sx * sz - sy * cz, sy * sz + cy * sx * cz, cy * cx,
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


class Kinematics:
    """A skeleton's tables as tensors, its mean `leg` length (hip or shoulder over the foot at rest, body lengths), the
    numbers of the left and right limbs of its `pairs` (P, 2), the shape variables of nodes that hang from its trunk
    (`of_trunk`), the nodes at both ends of what it holds `upright` (a person's trunk, and neck and head; nothing of an
    animal), and its forward kinematics."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self.B = skeleton.link_count
        f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
        i = lambda x: torch.as_tensor(x, dtype=torch.long)  # noqa: E731
        self.link, self.offset, self.mirror = i(skeleton.link), f(skeleton.offset), i(skeleton.mirror)
        self.group, self.group_spread = i(skeleton.group).clamp(min=0), f(skeleton.group_spread)
        self.lower, self.upper, self.sigma = f(skeleton.lower), f(skeleton.upper), f(skeleton.sigma)
        self.c_link, self.c_nodes = i(skeleton.capsule_link), i(skeleton.capsule_nodes)
        self.c_shift, self.c_radii = f(skeleton.capsule_shift), f(skeleton.capsule_radii)
        self.c_tail = torch.tensor(["tail" in n for n in skeleton.capsule_names])
        self.c_own = self.c_nodes == self.c_link[:, None]
        # Left and right share the variable of the first of the two; y is mirrored for the other.
        first = torch.minimum(self.mirror, torch.arange(len(self.mirror)))
        self.node_variable = torch.unique(first, return_inverse=True)[1]
        self.flip = torch.where(first < torch.arange(len(first)), -1.0, 1.0)
        self.median = (self.mirror == torch.arange(len(first))).float()
        one = torch.ones_like(self.flip)
        roots = (self.median == 0) & (self.median[self.link] > 0)
        aside = torch.where(roots, (ROOT_SPREAD * self.offset[:, 1].abs()).clamp(max=SHIFT_SPREAD), SHIFT_SPREAD)
        sideways = aside * self.flip * (1 - self.median)
        self.shift_spread = torch.stack([SHIFT_SPREAD * one, sideways, SHIFT_SPREAD * one], -1)
        self.of_trunk = self.node_variable[(self.median[self.link] > 0) & (torch.arange(len(first)) > 0)].unique()
        self.upright = self._upright() if skeleton.kind == "human" else []
        c_first = torch.minimum(i(skeleton.capsule_mirror), torch.arange(len(self.c_link)))
        self.flesh_variable = torch.unique(c_first, return_inverse=True)[1]
        c_number = torch.arange(len(c_first))
        sideways = torch.where(c_first < c_number, -1.0, 1.0) * (i(skeleton.capsule_mirror) != c_number)
        self.flesh_side = torch.stack([torch.ones_like(sideways), sideways, torch.ones_like(sideways)], -1)[:, None]
        depth = [0]
        for j in range(1, self.B):
            depth.append(depth[int(self.link[j])] + 1)
        # Links level by level, each with its parent's place in the level before; and each link's place among them all.
        by_depth = [[j for j in range(self.B) if depth[j] == d] for d in range(max(depth) + 1)]
        self.levels = [
            (i(own), i([above.index(int(self.link[j])) for j in own])) for above, own in itertools.pairwise(by_depth)
        ]
        self.place = i(list(itertools.chain(*by_depth))).argsort()
        self.contacts = i(list(skeleton.contacts))
        self.of_legs, self.of_arms = self._limbs()
        side, high = skeleton.rest()[:, 1:].T
        self.leg = float(np.mean([high[limb.swing] - high[limb.contact] for limb in skeleton.limbs]))
        number = {foot: n for n, foot in enumerate(skeleton.contacts)}
        other = {n: number.get(skeleton.mirror[foot]) for foot, n in number.items() if side[foot] > 0}
        self.pairs = i([pair for pair in other.items() if pair[1] is not None]).reshape(-1, 2)

    def _limbs(self) -> tuple[Tensor, Tensor]:
        """The nodes at the far ends of the bones of limbs that end in a contact, and of the others. A heel, say, beside
        the contact on the same link, is of neither."""
        legs = set()
        for node in self.contacts.tolist():
            while node > 0:
                legs.add(node)
                node = int(self.link[node])
        bones = ((self.median == 0) & (self.median[self.link] == 0)).nonzero()[:, 0].tolist()
        arms = [m for m in bones if m not in legs and int(self.link[m]) not in legs]
        return torch.tensor([m for m in bones if m in legs]).long(), torch.tensor(arms).long()

    def _upright(self) -> list[tuple[int, int]]:
        """From the root to the last joint before the head, where no pair of limbs hangs any more, and from there on."""
        high = torch.as_tensor(self.skeleton.rest()[:, 2]) * self.median
        chain = [int(high.argmax())]
        while chain[-1] > 0:
            chain.append(int(self.link[chain[-1]]))
        carries = {int(j) for j in self.link[self.median == 0]}
        neck = next((j for j in chain if int(self.link[j]) in carries), chain[0])
        return [(a, b) for a, b in ((0, neck), (neck, chain[0])) if a != b]

    def shape_variables(self, H: int) -> dict[str, Tensor]:
        """Zeros of every shape variable: the skeleton as written, one unit long."""
        n, c = int(self.node_variable.max()) + 1, int(self.flesh_variable.max()) + 1
        skeleton = dict(log_length=(), group=(len(self.group_spread),), node=(n,), shift=(n, 3))
        sizes = skeleton | dict(flesh=(c, 2, 3), radius=(c, 2), girth=())
        return {k: torch.zeros(H, *s) for k, s in sizes.items()}

    def offsets(self, shape: dict[str, Tensor]) -> Tensor:
        """(H, M, 3) node offsets in their links, world units."""
        log = (shape["group"] * self.group_spread)[:, self.group] + NODE_SPREAD * shape["node"][:, self.node_variable]
        offset = self.offset * log.exp()[..., None] + shape["shift"][:, self.node_variable] * self.shift_spread
        offset = torch.cat([torch.zeros_like(offset[:, :1]), offset[:, 1:]], 1)
        return offset * shape["log_length"].exp()[:, None, None]

    def capsule_ends(self, shape: dict[str, Tensor], offset: Tensor) -> Tensor:
        """(H, C, 2, 3) ends of the capsules in their links, world units. offset (H, M, 3): as `offsets` gives them."""
        # Nothing for the link's own node, the offset for a node fixed to it.
        ends = torch.where(self.c_own[None, :, :, None], offset.new_zeros(1), offset[:, self.c_nodes])
        flesh = self.c_shift + FLESH_SPREAD * shape["flesh"][:, self.flesh_variable] * self.flesh_side
        return ends + flesh * shape["log_length"].exp()[:, None, None, None]

    def mirrored(self, q: Tensor) -> Tensor:
        """(..., B, 3) rad, joint angles of the mirror image of the body with angles q."""
        return q[..., self.mirror[: self.B], :] * torch.tensor([-1.0, 1.0, -1.0])

    def pose(self, shape: dict[str, Tensor], position: Tensor, R_root: Tensor, q: Tensor) -> Posed:
        """Forward kinematics. position (H, T, 3), R_root (H, T, 3, 3), q (H, T, B, 3) rad with an unused root row."""
        H = len(position)
        offset = self.offsets(shape)
        local = joint_rotation(q)
        R, p = [R_root[:, :, None]], [position[:, :, None]]
        for own, parent in self.levels:
            Rp = R[-1][:, :, parent]
            p.append(p[-1][:, :, parent] + (Rp @ offset[:, None, own, :, None])[..., 0])
            R.append(Rp @ local[:, :, own])
        Rs, ps = torch.cat(R, 2)[:, :, self.place], torch.cat(p, 2)[:, :, self.place]
        points = self.link[self.B :]
        tips = ps[:, :, points] + (Rs[:, :, points] @ offset[:, None, self.B :, :, None])[..., 0]
        length = shape["log_length"].exp()
        ends = self.capsule_ends(shape, offset)
        Rc, pc = Rs[:, :, self.c_link], ps[:, :, self.c_link]
        ab = pc[:, :, :, None] + (Rc[:, :, :, None] @ ends[:, None, ..., None])[..., 0]
        log_r = GIRTH_SPREAD * shape["girth"][:, None, None] + RADIUS_SPREAD * shape["radius"][:, self.flesh_variable]
        radii = self.c_radii * log_r.exp() * length[:, None, None]
        return Posed(torch.cat([ps, tips], 2), Rs, ab[..., 0, :], ab[..., 1, :], radii, length.expand(H))

    def crossing(self, body: Posed, R_root: Tensor) -> Tensor:
        """(H, T, P) body lengths by which the left one of a pair of legs is to the right of the right one: by where
        their last links begin, across the root (H, T, 3, 3)."""
        left, right = self.pairs.T
        ends = body.nodes[:, :, self.link[self.contacts]]
        apart = ((ends[:, :, left] - ends[:, :, right]) * R_root[:, :, None, :, 1]).sum(-1)
        return (-apart).clamp(min=0) / body.length[:, None, None]


def limb_links(skeleton: Skeleton, limb: Limb) -> list[int]:
    """The limb's links, from the one that its swing joint moves outwards."""
    out = []
    node, trunk = int(skeleton.link[limb.contact]), int(skeleton.link[limb.swing])
    while node != trunk and node > 0:
        out.append(node)
        node = int(skeleton.link[node])
    return out[::-1]
