"""The body as a mechanical model: links with masses and inertias from the volume of their capsules, and contacts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slomo.flesh import Cone
from slomo.gravity import GRAVITY
from slomo.reconstruct.kinematics import Posed
from slomo.skeleton import Skeleton

Array = np.ndarray

DENSITY = 1000.0  # kg/m^3, flesh
LEAST_MASS = 0.002  # of the whole body's: a link without volume of its own still has this
SAME = 0.08  # body lengths between two places on a link that are one contact point
CELL = 0.01  # body lengths, of the grid of points whose mass is summed


@dataclass(frozen=True)
class Mechanics:
    """How joints and ground behave, without units: of two animals that differ only in size both move alike, a time
    being sqrt(length / g) (Alexander and Jayes 1983).

    Attributes:
        stiffness: of a joint's controller, in weight * body length per rad. damping: in stiffness * sqrt(length / g).
        ke: of the ground, in weight / body length. kd: loss of the contact (Hunt and Crossley 1975: the force is
            ke d (1 - kd v)), in 1 / sqrt(g length).
        mu: Coulomb friction. creep: speed below which it is viscous, in sqrt(g length).
        round: depth over which the contact sets in, in body lengths.
        pull: of the assistance of the root, in weight / body length (and times length^2 / 10 per rad); it is critically
            damped.
    """

    stiffness: float = 2.0
    damping: float = 0.1
    ke: float = 100.0
    kd: float = 2.0
    mu: float = 0.9
    creep: float = 0.002
    round: float = 0.001
    pull: float = 40.0


@dataclass(frozen=True)
class Body:
    """A body of B links (as the skeleton's, root first) with M nodes and C contact points. SI units.

    Attributes:
        parent: (B,), -1 for the root. link: (M,), offset: (M, 3) m of the nodes in their link's frame.
        mass: (B,) kg. com: (B, 3) m and inertia: (B, 3, 3) kg m^2 about the link's origin, in its frame.
        contact_link: (C,) ascending. contact_place: (C, 3) m in the link's frame. contact_radius: (C,) m, height at
            which the point touches the ground. contact_node: (C,) node that it is, -1 for none.
        length: m. mechanics: as given.
    """

    parent: Array
    link: Array
    offset: Array
    mass: Array
    com: Array
    inertia: Array
    contact_link: Array
    contact_place: Array
    contact_radius: Array
    contact_node: Array
    length: float
    mechanics: Mechanics

    @property
    def weight(self) -> float:
        """N on Earth."""
        return float(self.mass.sum()) * GRAVITY


def solid(cones: Sequence[Cone], links: int, *, cell: float) -> tuple[Array, Array, Array]:
    """Volume of the union of cones, each point of it belonging to the link of the cone in which it lies deepest: flesh
    where cones overlap counts once.

    Args:
        cones: `bone` is the link. cell: m, of the grid of points.

    Returns:
        (links,) m^3; (links, 3) m^4, first moments; (links, 3, 3) m^5, second moments sum x x^T.
    """
    reach = max(max(c.ra, c.rb) for c in cones) + cell
    ends = np.stack([e for c in cones for e in (c.a, c.b)])
    lower, upper = ends.min(0) - reach, ends.max(0) + reach
    # About the middle, so that left and right are alike.
    half = np.ceil((upper - lower) / cell / 2)
    axes = [(lower[k] + upper[k]) / 2 + cell * (np.arange(-half[k], half[k]) + 0.5) for k in range(3)]
    best = np.zeros(tuple(map(len, axes)))
    owner = np.full(best.shape, -1)
    for c in cones:
        r = max(c.ra, c.rb)
        low, high = np.minimum(c.a, c.b) - r, np.maximum(c.a, c.b) + r
        box = tuple(slice(*np.searchsorted(axes[k], [low[k], high[k]])) for k in range(3))
        depth = c.distance(np.stack(np.meshgrid(*(axes[k][box[k]] for k in range(3)), indexing="ij"), -1))
        deeper = depth < best[box]
        best[box] = np.where(deeper, depth, best[box])
        owner[box] = np.where(deeper, c.bone, owner[box])
    inside = np.nonzero(owner >= 0)
    x, link = np.stack([axes[k][inside[k]] for k in range(3)], 1), owner[inside]
    total = lambda v: np.bincount(link, v, links) * cell**3  # noqa: E731
    first = np.stack([total(x[:, k]) for k in range(3)], 1)
    second = np.stack([np.stack([total(x[:, k] * x[:, h]) for h in range(3)], 1) for k in range(3)], 1)
    return total(np.ones(len(x))), first, second


def build(skeleton: Skeleton, posed: Posed, *, unit: float, mechanics: Mechanics | None = None) -> Body:
    """The mechanical body of a posed one (its first hypothesis; the pose does not matter). unit: m per unit of it."""
    B, link = skeleton.link_count, skeleton.link
    p, R = (v[0, 0].numpy().astype(float) for v in (posed.nodes, posed.R))
    length, radii = float(posed.length[0]) * unit, posed.radii[0].numpy().astype(float) * unit
    inside = lambda x, i: np.einsum("cba,cb->ca", R[i], x - p[i]) * unit  # noqa: E731
    offset = np.concatenate([np.zeros((1, 3)), inside(p[1:], link[1:])])
    capsules = [v[0, 0].numpy().astype(float) for v in (posed.a, posed.b)]
    ends = np.stack([inside(x, skeleton.capsule_link) for x in capsules], 1)
    rest = np.zeros_like(offset)
    for m in range(1, len(rest)):
        rest[m] = rest[link[m]] + offset[m]
    cones = [
        Cone(int(i), rest[i] + ends[c, 0], rest[i] + ends[c, 1], float(radii[c, 0]), float(radii[c, 1]))
        for c, i in enumerate(skeleton.capsule_link)
    ]
    volume, first, second = solid(cones, B, cell=CELL * length)
    least = LEAST_MASS * volume.sum()
    first /= np.maximum(volume, 1e-12)[:, None]
    com = np.where(volume[:, None] > 0.1 * least, first - rest[:B], 0.0)
    # About the centre of mass; a link without volume is a small ball.
    about = second - volume[:, None, None] * first[:, :, None] * first[:, None, :]
    about = np.eye(3) * np.trace(about, axis1=1, axis2=2)[:, None, None] - about
    about += np.maximum(least - volume, 0)[:, None, None] * 0.4 * (0.03 * length) ** 2 * np.eye(3)
    mass = DENSITY * np.maximum(volume, least)
    square = (com**2).sum(1)[:, None, None] * np.eye(3) - com[:, :, None] * com[:, None, :]
    inertia = DENSITY * about + mass[:, None, None] * square
    points = _contacts(skeleton, offset, rest, ends, radii, length)
    order = np.argsort([i for i, *_ in points], kind="stable")
    at, place, radius, node = (np.array([points[k][n] for k in order]) for n in range(4))
    parent = np.concatenate([[-1], link[1:B]])
    return Body(
        parent, link, offset, mass, com, inertia, at, place, radius, node, length,
        mechanics or Mechanics(),
    )  # fmt: skip


def _contacts(
    skeleton: Skeleton, offset: Array, rest: Array, ends: Array, radii: Array, length: float
) -> list[tuple[int, Array, float, int]]:
    """Link, place, radius and node of every point that can touch the ground: the feet, and the ends of all capsules.

    The feet touch at stance height. Other ends touch with their radius, but not when the body stands at rest, however
    thick the fit made them.
    """
    feet = [(int(skeleton.link[c]), offset[c], skeleton.sole * length, int(c)) for c in skeleton.contacts]
    floor = np.mean([rest[c, 2] for c in skeleton.contacts]) - skeleton.sole * length
    out = list(feet)
    for c, i in enumerate(skeleton.capsule_link):
        for e in range(2):
            if any(i == link and np.linalg.norm(ends[c, e] - x) < SAME * length for link, x, *_ in out):
                continue
            height = rest[i, 2] + ends[c, e, 2] - floor
            out.append((int(i), ends[c, e], float(min(radii[c, e], max(height, 0.0))), -1))
    return out
