"""People: what grows on them, what they wear, and its colours. Front and back differ as they do on real ones: face and
hair, chest and seat, collars, zips and prints, toes and heels. None of it is always there.

Lengths are body lengths; x forward, y left, z up in every link at rest.
"""

import colorsys
from collections.abc import Callable
from typing import Any

import numpy as np

from slomo.skeleton import Skeleton

Array = np.ndarray

# Palest skin, and by what power of its darkness each channel falls.
_SKIN, _TAN = np.array([0.95, 0.78, 0.66]), np.array([0.8, 1.0, 1.2])


def grow(
    add: Callable[..., None], rng: np.random.Generator, offset: Array, skull: float, number: dict[str, int]
) -> None:
    """Cones of a person and of their clothes.

    Args:
        add: takes a link's name, ends a and b (3,) in its frame, their radii and the part's name.
        offset: (M, 3) of the nodes in their links.  skull: its radius.  number: of each node's name.
    """
    u = rng.uniform

    def chance(p: float) -> bool:
        return rng.random() < p

    top = offset[number["head_top"]]
    nose = np.array([0.005 + skull, 0, u(0.05, 0.2) * top[2]])
    add("head", nose, nose + [u(0.0, 0.014), 0, -0.005], u(0.01, 0.014), u(0.008, 0.012), "head")
    if chance(0.6):  # a chin
        add("head", [0.02, 0, -0.03], [u(0.03, 0.045), 0, -u(0.03, 0.045)], 0.022, 0.016, "head")
    if chance(0.6):  # hair
        r = u(0.045, 0.062)
        add("head", 0.25 * top + [-u(0.01, 0.025), 0, 0], 0.6 * top + [-0.01, 0, 0], r, r, "head")
        if chance(0.5):  # long
            add("head", [-0.03, 0, 0.02], [-0.05, 0, -u(0.03, 0.16)], u(0.03, 0.05), u(0.02, 0.045), "head")
    if chance(0.2):  # a hat, often with a peak
        add("head", 0.7 * top, u(0.9, 1.15) * top, u(0.048, 0.065), u(0.03, 0.05), "head")
        if chance(0.6):
            peak = skull + u(0.03, 0.065)
            for y in (-0.02, 0.02):
                add("head", 0.6 * top + [0.04, y, 0], 0.55 * top + [peak, 0.7 * y, 0], 0.012, 0.008, "head")
    if chance(0.6):  # breasts, or pectorals
        r, ahead, low = u(0.03, 0.05), u(0.02, 0.05), u(-0.03, 0.02)
        for y in (0.04, -0.04):
            add("chest", [0.02, y, low + 0.02], [ahead, y, low], r, r, "trunk")
    if chance(0.3):  # a belly
        add("spine_mid", [0.0, 0, -0.02], [u(0.02, 0.06), 0, u(-0.03, 0.03)], u(0.06, 0.085), u(0.05, 0.08), "trunk")
    if chance(0.7):  # a seat
        r, back = u(0.045, 0.06), -u(0.015, 0.045)
        for y in (0.04, -0.04):
            add("pelvis", [0, y, 0], [back, y, -u(0.0, 0.03)], r, r, "trunk")
    if chance(0.25):  # a coat, a skirt
        r, low = u(0.06, 0.085), u(0.05, 0.2)
        for y in (0.05, -0.05):
            add("pelvis", [0, y, 0.02], [0, 1.3 * y, -low], r, r * u(0.9, 1.2), "trunk")
    if chance(0.15):  # a bag on the back
        add("chest", [-0.1, 0, -0.1], [-0.1, 0, 0.03], u(0.05, 0.09), u(0.05, 0.08), "trunk")
    if chance(0.3):  # a bulky jacket
        add("spine_mid", [0, 0.03, 0], [0, 0.04, 0.12], u(0.07, 0.1), u(0.06, 0.09), "trunk")
        add("spine_mid", [0, -0.03, 0], [0, -0.04, 0.12], u(0.07, 0.1), u(0.06, 0.09), "trunk")
    shoe, trousers, wide, heel = u(0.02, 0.035), chance(0.4), u(0.035, 0.065), u(0.015, 0.04)
    calf, bare = u(0.0, 0.018), chance(0.5)
    for side in ("left", "right"):
        toe, shank = offset[number[f"{side}_toe"]], offset[number[f"{side}_ankle"]]
        add(f"{side}_ankle", [-heel, 0, -0.015], toe + [u(0.0, 0.03), 0, 0.01], shoe, 0.9 * shoe, f"{side}_shank")
        if bare:
            add(f"{side}_knee", 0.2 * shank + [-calf, 0, 0], 0.45 * shank + [-calf, 0, 0], 0.03, 0.026, f"{side}_shank")
        if trousers:
            add(f"{side}_knee", 0.1 * shank, 0.95 * shank, wide, wide, f"{side}_shank")


def _any_colour(rng: np.random.Generator) -> Array:
    """sRGB of a dye; grey, black and white more often than the rest."""
    saturation = rng.uniform(0, 0.25) if rng.random() < 0.45 else rng.uniform(0.2, 0.9)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.06, 0.95)))


def _hair_colour(rng: np.random.Generator) -> Array:
    value = rng.uniform(0.05, 0.3) if rng.random() < 0.7 else rng.uniform(0.3, 0.9)
    return np.array(colorsys.hsv_to_rgb(rng.uniform(0.03, 0.12), rng.uniform(0, 0.7), value))


def dress(skeleton: Skeleton, link: Array, surface: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Colours of a person, and which of them are cloth.

    Args:
        link: (V,) that carries the vertex.  surface: (V, 3) its canonical coordinates.

    Returns:
        (V, 3) sRGB, (V,) bool.
    """
    u = rng.uniform
    names, rest = list(skeleton.names), skeleton.rest()

    def on(*words: str) -> Array:
        return np.isin(link, [j for j, n in enumerate(names[: skeleton.link_count]) if any(w in n for w in words)])

    def chance(p: float) -> bool:
        return rng.random() < p

    x, y, z = surface.T
    skin = _SKIN * u(0.25, 1.0) ** _TAN
    shirt, trousers, shoes = _any_colour(rng), _any_colour(rng), _any_colour(rng)
    color = np.tile(shirt, (len(surface), 1))
    cloth = np.ones(len(surface), bool)

    def paint(mine: Array, rgb: Any, *, of_cloth: bool) -> None:
        color[mine] = rgb
        cloth[mine] = of_cloth

    waist, ankle = u(-0.02, 0.06), rest[names.index("left_ankle"), 2]
    paint(on("hip", "knee") | (on("pelvis", "spine") & (z < waist)), trousers, of_cloth=True)
    if chance(0.25):  # bare legs
        paint(on("knee") | (on("hip") & (z < u(-0.2, -0.1))), skin, of_cloth=False)
    paint(on("ankle") | (on("knee") & (z < ankle + 0.01)), skin if chance(0.2) else shoes, of_cloth=False)
    elbow, wrist = (rest[names.index(f"left_{n}"), 2] for n in ("elbow", "wrist"))
    end = wrist - 0.005 if chance(0.6) else u(elbow - 0.05, elbow + 0.1)  # of the sleeves
    paint(on("shoulder", "elbow") & (z < end) & (np.abs(y) > 0.08), skin, of_cloth=False)
    front = (x > 0) & on("chest", "spine", "pelvis") & (z > waist)
    if chance(0.3):  # what an open jacket shows
        paint(front & (np.abs(y) < u(0.015, 0.05)), _any_colour(rng), of_cloth=True)
    elif chance(0.4):  # a zip, buttons, a tie
        paint(front & (np.abs(y - u(-0.005, 0.005)) < 0.01), _any_colour(rng), of_cloth=True)
    chest = rest[names.index("chest"), 2]
    if chance(0.25):  # a print
        middle, size = chest + u(-0.06, 0.03), u(0.02, 0.06)
        paint(front & (np.abs(y) < size) & (np.abs(z - middle) < u(0.5, 1.2) * size), _any_colour(rng), of_cloth=True)
    if chance(0.1):  # one on the back
        paint((x < 0) & on("chest") & (np.abs(y) < 0.05) & (z > chest - 0.05), _any_colour(rng), of_cloth=True)
    if chance(0.3):  # a belt
        paint(on("pelvis", "spine", "hip") & (np.abs(z - waist) < 0.01), _any_colour(rng), of_cloth=True)
    paint(on("neck", "head"), skin, of_cloth=False)
    if chance(0.5):  # an open collar
        deep = u(0.02, 0.09)
        paint(on("chest") & (x > 0) & (z > rest[names.index("neck"), 2] - deep + np.abs(y) * 1.3), skin, of_cloth=False)
    _face(on("head"), surface - rest[names.index("head")], color, skin, rng)
    return color, cloth


def _face(head: Array, at: Array, color: Array, skin: Array, rng: np.random.Generator) -> None:
    """Paint the vertices `head` (V,) of `color` (V, 3); `at` (V, 3) are their coordinates about the head's joint."""
    u = rng.uniform
    x, y, z = at.T
    hair, ahead = _hair_colour(rng), head & (x > 0.02)

    def spot(y0: float, z0: float, ry: float, rz: float, rgb: Any) -> None:
        color[ahead & (((np.abs(y) - y0) / ry) ** 2 + ((z - z0) / rz) ** 2 < 1)] = rgb

    color[ahead & (np.abs(y) < 0.012) & (np.abs(z - 0.01) < 0.015)] = np.clip(skin * u(0.9, 1.12), 0, 1)  # the nose
    spot(0.0, -0.015, 0.016, 0.008, skin * np.array([0.85, 0.5, 0.5]) * u(0.6, 1.0))
    beard = rng.random()
    if beard < 0.2:
        color[ahead & (z < u(-0.012, 0.0))] = hair * u(0.7, 1.2)
    elif beard < 0.27:  # a mask
        color[ahead & (z < 0.018)] = _any_colour(rng)
    eye = skin * u(0.1, 0.5)
    spot(0.019, 0.03, u(0.009, 0.013), u(0.007, 0.011), eye)
    if rng.random() < 0.5:  # brows
        spot(0.02, 0.046, 0.013, 0.007, hair)
    if rng.random() < 0.12:  # glasses
        spot(0.02, 0.03, 0.018, 0.013, u(0.02, 0.2))
    if rng.random() < 0.9:  # the others are bald
        line, fringe, temple = u(-0.02, 0.02), u(0.045, 0.075), u(-0.06, 0.03)
        color[head & ((x < line) & (z > temple) | (z > fringe) | (x < line - 0.02) & (z > temple - 0.05))] = hair
    if rng.random() < 0.15:  # a hat
        color[head & (z > u(0.05, 0.065))] = _any_colour(rng)
