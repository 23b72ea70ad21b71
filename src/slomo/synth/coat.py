"""Coats and clothes: colours of a creature's skin, drawn at random."""

import colorsys

import numpy as np

from slomo.flesh import value_noise
from slomo.skeleton import Skeleton
from slomo.synth.person import dress

Array = np.ndarray


def _colour(rng: np.random.Generator, *, natural: bool) -> Array:
    """sRGB; natural: the browns, greys, blacks and whites of fur."""
    if natural and rng.random() < 0.85:
        return np.array(
            colorsys.hsv_to_rgb(rng.uniform(0.03, 0.12), rng.uniform(0, 0.7) ** 1.3, rng.uniform(0.05, 0.97))
        )
    return np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0, 0.9), rng.uniform(0.08, 0.95)))


def _pattern(x: Array, rng: np.random.Generator) -> Array:
    """(V,) in [0, 1]: patches, spots, stripes or a gradient over points (V, 3) in body lengths."""
    kind, f = rng.integers(4), rng.uniform(2.5, 12)
    n = 0.7 * value_noise(x * f + 9, rng) + 0.3 * value_noise(x * 2.7 * f, rng)
    if kind == 0:
        return np.clip((n - rng.uniform(0.4, 0.6)) / 0.04, 0, 1)
    if kind == 1:
        return np.clip((value_noise(x * 2.5 * f + 5, rng) - 0.62) / 0.05, 0, 1)
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    if kind == 2:
        return np.clip(2.5 * np.sin(rng.uniform(25, 70) * x @ direction + 8 * (n - 0.5)) - 0.4, 0, 1)
    return np.clip((x @ direction - rng.uniform(-0.3, 0.3)) / rng.uniform(0.05, 0.6) + n - 0.5, 0, 1)


def coat(skeleton: Skeleton, link: Array, surface: Array, rng: np.random.Generator) -> Array:
    """(V, 3) sRGB. Args: link: (V,) that carries the vertex.  surface: (V, 3) its canonical coordinates."""
    human = skeleton.kind == "human"
    if human:
        base, cloth = dress(skeleton, link, surface, rng)
    else:
        cloth = np.ones(len(surface), bool)
        base = np.tile(_colour(rng, natural=True), (len(surface), 1))
        names = skeleton.names[: skeleton.link_count]
        for j in range(len(names)):  # socks, a dark tail, a pale face: each on both sides
            if rng.random() < 0.12:
                both = [j, skeleton.mirror[j]]
                base[np.isin(link, both)] = _colour(rng, natural=True)
        if rng.random() < 0.5:
            below = np.clip((-0.12 - surface[:, 2] + 0.2 * rng.standard_normal()) / 0.1, 0, 1)[:, None]
            base = base * (1 - below) + _colour(rng, natural=True) * below
    for _ in range(rng.integers(0, 3)):
        p = (_pattern(surface, rng) * cloth)[:, None] * rng.uniform(0.3, 1.0)
        base = base * (1 - p) + _colour(rng, natural=not human) * p
    base *= (1 + rng.uniform(0, 0.4) * (value_noise(surface * 40, rng) - 0.5))[:, None]
    return np.clip(base, 0.02, 0.97)
