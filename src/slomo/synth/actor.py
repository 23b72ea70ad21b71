"""Who is filmed in a rendered clip: an animal or a person, its motion with key points, and its body."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slomo.skeleton import load_skeleton
from slomo.synth import figure
from slomo.synth.acts import FOLD
from slomo.synth.animal import ANIMALS, BONES, FEET, KEYPOINTS, proportions
from slomo.synth.body import build_body
from slomo.synth.creature import create
from slomo.synth.gait import MOVES, animate

Array = np.ndarray

PERSON = "person"
ACTORS = (*ANIMALS, PERSON)
HEIGHT = 1.55, 1.9  # m, of people


def moves(actor: str) -> tuple[str, ...]:
    """What it can do."""
    if actor == PERSON:
        return figure.MOVES
    return tuple(m for m in MOVES if actor != "horse" or m not in FOLD)


@dataclass(frozen=True)
class Skin:
    """A body's surface: triangles (F, 3), colors (V, 3) sRGB, and its vertices (V, 3) m at a frame."""

    triangles: Array
    colors: Array
    at: Callable[[int], Array]


@dataclass(frozen=True)
class Actor:
    """An animal or a person over T frames.

    Attributes:
        kind: of its skeleton.  names, feet, bones: of its key points.
        keypoints: (T, N, 3) m, world, z up, ground at 0.  contact: (T, feet) bool.
        target: (T, 3) m, its middle.  length: m that fill three fifths of the picture's width.
        body_length: m, as scores are given.  size: m, what the place around it is scaled by.
        contact_height, contact_speed: m and m/s, thresholds for a contact detector.
        skin: makes its surface.
    """

    kind: str
    names: tuple[str, ...]
    feet: tuple[str, ...]
    bones: tuple[tuple[str, str], ...]
    keypoints: Array
    contact: Array
    target: Array
    length: float
    body_length: float
    size: float
    contact_height: float
    contact_speed: float
    skin: Callable[[], Skin]


def act(actor: str, move: str, t: Array, *, speed: float | None, turn: float, seed: int) -> Actor:
    """Of `ACTORS`, doing one of its `moves` at times t (T,) s, at speed m/s (None: the usual one), turning at rad/s.

    Raises:
        ValueError: it cannot move as asked.
    """
    make = _person if actor == PERSON else _animal
    return make(actor, move, t, speed, turn, seed)


def _animal(name: str, gait: str, t: Array, speed: float | None, turn: float, seed: int) -> Actor:
    p = proportions(name, seed)
    motion = animate(p, gait, t, speed=speed, turn=turn, seed=seed)
    k = motion.keypoints
    nose, tail, withers, rump = (k[:, KEYPOINTS.index(n)] for n in ("nose", "tail_tip", "withers", "tail_base"))
    high = gait == "rear"  # and the picture has to hold it
    target = (nose + tail) / 2
    target[:, 2] = (0.9 if high else 0.55) * p.height
    length = float(np.linalg.norm(withers - rump, axis=1).mean())
    whole = float(np.linalg.norm(nose - tail, axis=1).mean()) * (1.25 if high else 1.0)

    def skin() -> Skin:
        body = build_body(name, p, seed)
        return Skin(body.triangles, body.colors, lambda i: body.skin(k[i], motion.lateral[i]))

    return Actor(
        "quadruped", KEYPOINTS, tuple(f"{f}_paw" for f in FEET), BONES, k, motion.contact, target,
        whole, length, p.height, 0.055 * length, 0.7 * length, skin,
    )  # fmt: skip


def _person(_: str, move: str, t: Array, speed: float | None, turn: float, seed: int) -> Actor:
    skeleton = load_skeleton("human")
    creature = create(skeleton, seed)
    height = float(np.random.default_rng([seed, 1]).uniform(*HEIGHT))
    motion = figure.pose(creature, move, t, height=height, speed=speed, turn=turn, seed=seed)
    k = height * motion.nodes
    high = move in ("stretch", "jump")  # and the picture has to hold the hands
    target = (k.min(1) + k.max(1)) / 2
    target[:, 2] = (0.62 if high else 0.5) * height
    names = skeleton.names

    def skin() -> Skin:
        colors, origin = creature.colors(np.random.default_rng([seed, 2])), motion.nodes[:, : skeleton.link_count]
        return Skin(creature.triangles, colors, lambda i: height * creature.skin(motion.R[i], origin[i]))

    return Actor(
        "human", names, tuple(names[limb.contact] for limb in skeleton.limbs),
        tuple((names[skeleton.link[m]], n) for m, n in enumerate(names) if m), k, motion.contact, target,
        (1.8 if high else 1.4) * height, height, 0.6 * height, 0.012 * height, 0.15 * height, skin,
    )  # fmt: skip
