"""How creatures differ: lengths, girths, stance, and what grows on them. Everything is drawn at random within ranges
wider than any one species, so that a network trained on them has met whatever comes."""

from dataclasses import dataclass

import numpy as np

from slomo.prior.labels import labels
from slomo.skeleton import Skeleton
from slomo.synth import person

Array = np.ndarray

# Factor on the length of every bone of a group, drawn evenly in its logarithm: from a dachshund's legs to a camel's.
GROUPS = {
    "quadruped": dict(
        trunk=(0.92, 1.1), shoulder=(0.88, 1.14), neck=(0.5, 1.8), head=(0.65, 1.6), tail=(0.15, 1.7),
    ),
    "human": dict(trunk=(0.88, 1.12), arm=(0.85, 1.12), leg=(0.75, 1.1), head=(0.9, 1.7)),
}  # fmt: skip
# Factor on the radii of parts whose name contains the word; the first that fits.
GIRTHS = {
    "quadruped": {"trunk": (0.72, 1.3), "neck": (0.6, 1.35), "head": (0.75, 1.5), "tail": (0.5, 2.8),
                  "upper": (0.65, 1.25), "lower": (0.6, 1.9)},
    "human": {"trunk": (0.85, 1.45), "head": (0.9, 1.25), "arm": (0.8, 1.7), "thigh": (0.8, 1.6), "shank": (0.8, 1.8)},
}  # fmt: skip
# Joint angles that hold the limbs apart while the skin is made: (word in the joint's name, side's sign on x), rad.
APART = {"quadruped": {"shoulder": 0.25, "hip": 0.22}, "human": {"shoulder": 1.0, "hip": 0.22}}


@dataclass(frozen=True)
class Build:
    """One creature's build, in body lengths.

    Attributes:
        offset: (M, 3) nodes in their links.  radii, shift: (C, 2), (C, 2, 3) of the skeleton's capsules.
        squash: factor on the whole body's width (animals are deeper than wide), of people on their depth.
        fur: body lengths, roughness of the outline.
        bind: (B, 3) rad, the pose in which the skin is made.  stance: (B, 3) rad, how it carries itself at rest.
    """

    offset: Array
    radii: Array
    shift: Array
    squash: float
    fur: float
    bind: Array
    stance: Array


@dataclass(frozen=True)
class Extra:
    """A cone that grows on a link: ends a, b (3,) in its frame, radii, and the label of the part it belongs to."""

    link: int
    a: Array
    b: Array
    radii: tuple[float, float]
    part: int


def _factor(rng: np.random.Generator, low: float, high: float) -> float:
    """Between low and high, the middle of the logarithm more often than its ends."""
    return float(np.exp(rng.triangular(np.log(low), np.log(low * high) / 2, np.log(high))))


def sided(skeleton: Skeleton, x: Array) -> Array:
    """Values (B, ...) with those of a right joint copied from the left one."""
    first = np.minimum(skeleton.mirror[: skeleton.link_count], np.arange(skeleton.link_count))
    return x[first]


def build(skeleton: Skeleton, rng: np.random.Generator) -> Build:
    """Draw one creature."""
    kind = skeleton.kind if skeleton.kind in GROUPS else "quadruped"
    M, B = len(skeleton.names), skeleton.link_count
    ranges = GROUPS[kind]
    group = np.array([_factor(rng, *ranges.get(g, (0.85, 1.15))) for g in skeleton.group_names])
    if kind == "quadruped":
        # Front and hind legs go together, and a long-legged animal needs a neck that reaches the grass.
        both = _factor(rng, 0.55, 1.7)
        front, hind = skeleton.group_names.index("front_leg"), skeleton.group_names.index("hind_leg")
        group[front], group[hind] = both * _factor(rng, 0.88, 1.14), both * _factor(rng, 0.88, 1.14)
        group[skeleton.group_names.index("neck")] *= both**0.6
    first = np.minimum(skeleton.mirror, np.arange(M))
    own = np.exp(0.12 * rng.standard_normal(M))[first]
    jitter = 0.02 * rng.standard_normal((M, 3))[first] * np.where(skeleton.offset == 0, 0.4, 1.0)
    jitter[:, 1] *= np.where(skeleton.mirror == np.arange(M), 0.0, np.where(first < np.arange(M), -1, 1))
    scale = np.where(skeleton.group < 0, 1.0, group[np.maximum(skeleton.group, 0)])
    offset = skeleton.offset * (scale * own)[:, None] + jitter
    width = _factor(rng, *((0.75, 1.3) if kind == "human" else (0.7, 1.9)))
    offset[:, 1] *= width
    if kind == "quadruped":  # some are broad in front, some behind
        hips = np.array(["hip" in n for n in skeleton.names])
        offset[hips, 1] *= _factor(rng, 0.75, 1.5)
    offset[0] = 0
    girth, known = np.ones(len(skeleton.capsule_link)), labels(skeleton)
    drawn = {p: _factor(rng, *next((r for w, r in GIRTHS[kind].items() if w in p), (0.8, 1.25)))
             for p in (n.replace("right", "left") for n in known.parts)}  # fmt: skip
    whole = _factor(rng, 0.85, 1.2)
    c_first = np.minimum(skeleton.capsule_mirror, np.arange(len(girth)))
    noise = np.exp(0.12 * rng.standard_normal((len(girth), 2)))[c_first]
    for c, label in enumerate(known.capsule_part):
        girth[c] = whole * drawn[known.parts[label - 1].replace("right", "left")]
    radii = skeleton.capsule_radii * girth[:, None] * noise
    bind = np.zeros((B, 3))
    for j, name in enumerate(skeleton.names[:B]):
        angle = next((a for word, a in APART[kind].items() if word in name), 0.0)
        bind[j, 0] = angle * (1 if "left" in name else -1)
    spread = 0.35 if kind == "quadruped" else 0.15
    stance = sided(skeleton, spread * skeleton.sigma[:B] * rng.standard_normal((B, 3)) * [0.3, 1.0, 0.0])
    stance[0] = 0
    squash, fur = (
        rng.uniform(0.7, 1.08),
        (0.0 if rng.random() < 0.5 else rng.uniform(0, 0.25) * float(np.median(radii))),
    )
    return Build(offset, radii, skeleton.capsule_shift * np.array([1, width, 1]), squash, fur, bind, stance)


def extras(skeleton: Skeleton, what: Build, rng: np.random.Generator) -> list[Extra]:
    """Ears, manes, humps, bellies and hooves; people's are in `slomo.synth.person`."""
    known = labels(skeleton)
    out: list[Extra] = []
    number = {n: i for i, n in enumerate(skeleton.names)}
    part = {p: i + 1 for i, p in enumerate(known.parts)}

    def add(link: str, a, b, ra: float, rb: float, of: str) -> None:
        if link in number and of in part:
            out.append(Extra(number[link], np.asarray(a, float), np.asarray(b, float), (ra, rb), part[of]))

    def chance(p: float) -> bool:
        return rng.random() < p

    u = rng.uniform
    if skeleton.kind == "human":
        skull = float(what.radii[list(skeleton.capsule_names).index("skull")].max())
        person.grow(add, rng, what.offset, skull, number)
        return out
    nose = what.offset[number["nose"]]
    skull = float(what.radii[list(skeleton.capsule_names).index("skull")].max())
    ear, up, out_, back = u(0.04, 0.22) * (2.0 if chance(0.1) else 1.0), u(-0.6, 1.0), u(0.1, 0.9), u(-0.4, 0.2)
    along, thick = u(-0.05, 0.25), u(0.018, 0.05)
    for y in (1, -1):
        root = along * nose + np.array([0, 0.7 * y * skull, 0.6 * skull])
        add("head", root, root + ear * np.array([back, out_ * y, up]), thick, 0.4 * thick, "head")
    if chance(0.08):  # horns
        horn = u(0.08, 0.35) * np.array([u(-0.8, 0.5), u(0.1, 0.7), u(0.4, 1.0)])
        for y in (1, -1):
            root = np.array([0.02, 0.4 * y * skull, 0.8 * skull])
            add("head", root, root + horn * [1, y, 1], 0.02, 0.008, "head")
    if chance(0.5):  # a muzzle
        add("head", 0.4 * nose, nose * u(0.85, 1.05), u(0.05, 0.09), u(0.03, 0.06), "head")
    neck = what.offset[number["head"]]
    if chance(0.35):  # a mane, a ruff, a wattle
        drop = np.array([u(-0.08, 0.02), 0, u(-0.08, 0.08)])
        add("neck", drop, neck + drop, u(0.07, 0.15), u(0.06, 0.13), "neck")
        add("withers", drop, what.offset[number["neck"]] + drop, u(0.08, 0.17), u(0.07, 0.15), "neck")
    spine = what.offset[number["withers"]]
    if chance(0.15):  # one hump or two
        for x in [(0.1,), (-0.25, 0.35)][int(chance(0.5))]:
            add("spine_mid", [x, 0, 0.04], [x + 0.03, 0, u(0.1, 0.22)], u(0.1, 0.16), u(0.05, 0.09), "trunk")
    if chance(0.5):  # a belly, or a deep chest
        z = u(-0.22, -0.08)
        add("spine_mid", [-0.15, 0, z], [spine[0] * 0.6, 0, z + u(-0.05, 0.03)], u(0.1, 0.17), u(0.1, 0.18), "trunk")
    if chance(0.4):  # rump
        add("pelvis", [-0.08, 0, u(-0.08, 0.03)], [0.1, 0, u(-0.06, 0.03)], u(0.1, 0.17), u(0.1, 0.17), "trunk")
    if chance(0.3):  # fur that hangs from the trunk
        z, r = u(-0.28, -0.15), u(0.07, 0.12)
        for y in (1, -1):
            add("spine_mid", [-0.3, 0.08 * y, z], [spine[0], 0.08 * y, z], r, r, "trunk")
    upper = {n: float(what.radii[list(skeleton.capsule_names).index(n)].max()) for n in
             ("front_left_upper_arm", "hind_left_thigh")}  # fmt: skip
    for side in ("left", "right"):  # limbs hang together with the trunk, however wide and thin it is
        limb = what.offset[number[f"front_{side}_shoulder"]]
        r = 0.8 * upper["front_left_upper_arm"]
        add("spine_mid", [0.8 * limb[0], 0, 0.3 * limb[2]], limb * [1, 0.8, 1], r, r, "trunk")
        limb = what.offset[number[f"hind_{side}_hip"]]
        r = 0.7 * upper["hind_left_thigh"]
        add("pelvis", [0, 0, -0.04], limb * [1, 0.8, 1], r, r, "trunk")
    bush = u(0.5, 1.0) * (u(1.0, 2.2) if chance(0.3) else 1.0) * 0.05
    if chance(0.5):
        add("tail_mid", [0, 0, 0], what.offset[number["tail_tip"]], bush, 0.6 * bush, "tail")
    hoof, toe, feather = u(0.025, 0.055), u(-0.02, 0.06), u(0.03, 0.075)
    furry = chance(0.3)
    for side in ("left", "right"):
        for joint, leg in ((f"front_{side}_wrist", f"front_{side}"), (f"hind_{side}_hock", f"hind_{side}")):
            paw = what.offset[number[f"{leg}_paw"]]
            add(joint, paw + [-0.03, 0, 0], paw + [toe, 0, 0], hoof, 0.85 * hoof, f"{leg}_lower")
            if furry:
                add(joint, 0.2 * paw, 0.8 * paw, feather, feather, f"{leg}_lower")
    return out
