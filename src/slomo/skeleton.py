"""Kinematic skeletons as data: B links, N spherical joints, read from TOML.

A skeleton is a tree of nodes. The root and the joints carry a link (a frame) each; points are fixed to a link. Every
node is a key point of the same name. Lengths are fractions of the body length; at rest every link's frame has x
forward, y left and z up. Capsules give the links their volume. Entries whose name contains "left" are mirrored.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import InvalidData, UsageError

Array = np.ndarray

AUTO, USUAL = "auto", "quadruped"  # stands for the skeleton that the clip shows; the one where nothing tells


@dataclass(frozen=True)
class Limb:
    """A leg as gait hypotheses need it: contact node, the joint that swings it, (joint, rad of y at mid-swing)."""

    name: str
    contact: int
    swing: int
    lift: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Gait:
    """Footfall pattern: stride fraction at which each limb lands, fraction it stays down, range of Froude numbers."""

    name: str
    land: tuple[float, ...]
    duty: float
    froude: tuple[float, float]


@dataclass(frozen=True)
class Posture:
    """An alternative to the rest pose: (link, (x, y, z) rad) of the joints that differ."""

    name: str
    joints: tuple[tuple[int, tuple[float, float, float]], ...]


@dataclass(frozen=True)
class Skeleton:
    """A skeleton at rest. Links are numbered root first, parents before children; nodes as in `names`.

    Attributes:
        typical_length, lengths: m, of a middling body, and of the smallest and the largest that it stands for.
        names: M node names, links first (node j < B is the origin of link j), then points.
        link: (M,) link to which the node is fixed; for a joint the parent's link; -1 for the root.
        offset: (M, 3) of the node in that link's frame, body lengths.
        group: (M,) index into `group_names`, -1 for the root; `group_spread`: s.d. of the log length of each group.
        mirror: (M,) index of the node on the other side, itself for the median plane.
        lower, upper, sigma: (B, 3) rad about x, y, z; the root's row is free.
        capsule_names, capsule_link (C,), capsule_nodes (C, 2), capsule_shift (C, 2, 3), capsule_radii (C, 2),
            capsule_mirror (C,): the body's volume, rounded cones between two nodes of a link, body lengths.
        part_names, capsule_part (C,): what a picture of the body is segmented into, and the part of each capsule.
        postures: sets of alternatives; of each set the rest or one may hold.
        sole: height of a contact node above the ground in stance, body lengths.
    """

    name: str
    kind: str
    typical_length: float
    lengths: tuple[float, float]
    length_between: tuple[str, ...]
    names: tuple[str, ...]
    link_count: int
    link: Array
    offset: Array
    group: Array
    group_names: tuple[str, ...]
    group_spread: Array
    mirror: Array
    lower: Array
    upper: Array
    sigma: Array
    capsule_names: tuple[str, ...]
    capsule_link: Array
    capsule_nodes: Array
    capsule_shift: Array
    capsule_radii: Array
    capsule_mirror: Array
    part_names: tuple[str, ...]
    capsule_part: Array
    limbs: tuple[Limb, ...]
    gaits: tuple[Gait, ...]
    sole: float
    postures: tuple[tuple[Posture, ...], ...]

    def index(self, name: str) -> int:
        """Number of a node. Raises `InvalidData` listing the names there are."""
        if name not in self.names:
            raise InvalidData(f"no node {name!r}", where=f"skeleton {self.name}", valid=self.names)
        return self.names.index(name)

    @property
    def contacts(self) -> tuple[int, ...]:
        return tuple(limb.contact for limb in self.limbs)

    def rest(self) -> Array:
        """(M, 3) node positions at rest, body lengths, relative to the root."""
        p = np.zeros_like(self.offset)
        for m in range(1, len(self.names)):
            p[m] = p[self.link[m]] + self.offset[m]
        return p

    @property
    def root_height(self) -> float:
        """Height of the root above the ground when the rest pose stands, body lengths."""
        return float(self.sole - min(self.rest()[c, 2] for c in self.contacts))


def list_skeletons() -> list[str]:
    """Names of the skeletons that come with slomo."""
    folder = resources.files("slomo") / "skeletons"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load_skeleton(name_or_path: str | Path) -> Skeleton:
    """Read a skeleton by its name or from a TOML file.

    Raises:
        UsageError: no such skeleton. InvalidData: the file does not describe one; says which entry.
    """
    name = str(name_or_path)
    if not name.endswith(".toml"):
        if name not in list_skeletons():
            todo = "give one of these or the path of a .toml file"
            raise UsageError(f"unknown skeleton {name!r}", where="--skeleton", valid=list_skeletons(), todo=todo)
        return parse_skeleton((resources.files("slomo") / "skeletons" / f"{name}.toml").read_text(), where=name)
    try:
        text = Path(name).read_text()
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"cannot read the skeleton ({e})", where=name) from e
    return parse_skeleton(text, where=name)


def parse_skeleton(text: str, *, where: str) -> Skeleton:
    """Skeleton from TOML text; `where` is the file's name for error messages. Raises `InvalidData`."""
    try:
        return _build(tomllib.loads(text), where)
    except tomllib.TOMLDecodeError as e:
        raise InvalidData(f"is not TOML ({e})", where=where) from e
    except KeyError as e:
        raise InvalidData(f"lacks the entry {e}", where=where) from e
    except (TypeError, ValueError, AttributeError) as e:
        raise InvalidData(f"has a wrong value ({e})", where=where) from e


def _flip(name: str) -> str:
    return name.replace("left", "right") if "left" in name else name.replace("right", "left")


def _mirrored(section: Mapping[str, Any], flip: Any) -> dict[str, Any]:
    """The entries in order, each "left" one followed by its mirror image."""
    out = {}
    for name, entry in section.items():
        out[name] = entry
        if "left" in name:
            out[_flip(name)] = flip(entry)
    return out


def _flip_node(entry: Mapping[str, Any]) -> dict[str, Any]:
    x, y, z = entry["offset"]
    out = dict(entry, parent=_flip(entry["parent"]), offset=[x, -y, z])
    if "lower" in entry:
        (lx, ly, lz), (ux, uy, uz) = entry["lower"], entry["upper"]
        out |= dict(lower=[-ux, ly, -uz], upper=[-lx, uy, -lz])
    return out


def _flip_capsule(entry: Mapping[str, Any]) -> dict[str, Any]:
    shift = [[x, -y, z] for x, y, z in entry.get("shift", [[0, 0, 0], [0, 0, 0]])]
    return dict(entry, link=_flip(entry["link"]), **{k: _flip(entry[k]) for k in ("from", "to")}, shift=shift)


def _flip_part(entry: list[str]) -> list[str]:
    return [_flip(c) for c in entry]


def _flip_limb(entry: Mapping[str, Any]) -> dict[str, Any]:
    return dict(
        contact=_flip(entry["contact"]),
        swing=_flip(entry["swing"]),
        lift=[[_flip(j), degrees] for j, degrees in entry["lift"]],
    )


def _flip_postures(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {_flip(p): {_flip(j): [-x, y, -z] for j, (x, y, z) in joints.items()} for p, joints in entry.items()}


def _build(d: Mapping[str, Any], where: str) -> Skeleton:
    joints = _mirrored(d["joints"], _flip_node)
    points = _mirrored(d["points"], _flip_node)
    capsules = _mirrored(d["capsules"], _flip_capsule)
    limbs = _mirrored(d["limbs"], _flip_limb)
    parts = _mirrored(d.get("parts") or {c: [c] for c in d["capsules"]}, _flip_part)
    links = [d["root"], *joints]
    names = [*links, *points]
    nodes = {**joints, **points}
    groups = list(d["groups"])

    def number(name: str, among: list[str], what: str) -> int:
        if name not in among:
            raise InvalidData(f"{what} names {name!r}, which there is not", where=where, valid=among)
        return among.index(name)

    for i, (name, entry) in enumerate(joints.items()):
        if entry["parent"] not in links[: i + 1]:
            raise InvalidData(f"parent of joint {name!r} must come before it", where=where, valid=links[: i + 1])
    link = np.array([-1] + [number(e["parent"], links, n) for n, e in nodes.items()])
    offset = np.array([[0.0, 0.0, 0.0]] + [e["offset"] for e in nodes.values()], float)
    free = [-math.inf] * 3, [math.inf] * 3
    lower = np.radians([free[0]] + [e["lower"] for e in joints.values()])
    upper = np.radians([free[1]] + [e["upper"] for e in joints.values()])
    if np.any(lower > 0) or np.any(upper < 0):
        raise InvalidData("joint limits must enclose the rest pose (lower <= 0 <= upper)", where=where)
    limb_names = list(limbs)
    node_pairs = [[number(e[k], names, c) for k in ("from", "to")] for c, e in capsules.items()]
    capsule_link = np.array([number(e["link"], links, c) for c, e in capsules.items()])
    for c, pair, own in zip(capsules, node_pairs, capsule_link, strict=True):
        if any(m != own and link[m] != own for m in pair):
            raise InvalidData(f"capsule {c!r}: its ends must be nodes of its link", where=where)

    part_of = {c: n for n, members in enumerate(parts.values()) for c in members}
    for c in (*part_of, *capsules):
        if c not in part_of or c not in capsules:
            raise InvalidData(f"capsule {c!r} must be in [capsules] and in one of [parts]", where=where)

    def mirror_of(items: list[str], name: str) -> int:
        other = _flip(name)
        return items.index(other) if other in items else items.index(name)

    smallest, largest = (float(m) for m in d.get("lengths", [d["typical_length"]] * 2))
    if not 0 < smallest <= largest:
        raise InvalidData(f"lengths is {d['lengths']}, expected the smallest and the largest in m", where=where)
    return Skeleton(
        name=str(d["name"]),
        kind=str(d["kind"]),
        typical_length=float(d["typical_length"]),
        lengths=(smallest, largest),
        length_between=tuple(names[number(n, names, "length_between")] for n in d["length_between"]),
        names=tuple(names),
        link_count=len(links),
        link=link,
        offset=offset,
        group=np.array([-1] + [number(e["group"], groups, n) for n, e in nodes.items()]),
        group_names=tuple(groups),
        group_spread=np.array([float(d["groups"][g]) for g in groups]),
        mirror=np.array([mirror_of(names, n) for n in names]),
        lower=lower,
        upper=upper,
        sigma=np.radians([[90.0] * 3] + [e["sigma"] for e in joints.values()]),
        capsule_names=tuple(capsules),
        capsule_link=capsule_link,
        capsule_nodes=np.array(node_pairs),
        capsule_shift=np.array([e.get("shift", np.zeros((2, 3))) for e in capsules.values()], float),
        capsule_radii=np.array([e["radii"] for e in capsules.values()], float),
        capsule_mirror=np.array([mirror_of(list(capsules), c) for c in capsules]),
        part_names=tuple(parts),
        capsule_part=np.array([part_of[c] for c in capsules]),
        limbs=tuple(
            Limb(
                name,
                contact=number(e["contact"], names, name),
                swing=number(e["swing"], links, name),
                lift=tuple((number(j, links, name), math.radians(a)) for j, a in e["lift"]),
            )
            for name, e in limbs.items()
        ),
        gaits=tuple(
            Gait(n, tuple(float(g["land"][m]) for m in limb_names), float(g["duty"]), (g["froude"][0], g["froude"][1]))
            for n, g in d["gaits"].items()
        ),
        sole=float(d["sole"]),
        postures=tuple(
            tuple(
                Posture(
                    f"{part} {name}",
                    tuple((number(j, links, name), tuple(np.radians(a).tolist())) for j, a in changes.items()),
                )
                for name, changes in alternatives.items()
            )
            for part, alternatives in _mirrored(d.get("postures", {}), _flip_postures).items()
        ),
    )
