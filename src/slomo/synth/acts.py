"""What an animal does on the spot: how trunk, head and paws leave where they are while it stands.

Lengths are heights of the withers (`Proportions`), angles rad. Every act begins with a standing animal, and comes back
to it if there is time.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slomo.synth.animal import Proportions, rest_joints

Array = np.ndarray

_SIT, _LIE = 0.5, 0.15  # by which the withers of who sits or lies are higher than the pelvis
_PELVIS, _HOCK = 0.26, 0.06  # over the ground, of who sits or lies
_FLAT = 1.0  # by which a foot's last bone leans further back than it does standing, when it lies on the ground
_NOSE = 0.10  # over the ground, of who grazes
_STEP = 0.04  # over the ground, of a paw that is set elsewhere


@dataclass(frozen=True)
class Act:
    """What is laid over an animal that stands, at T times.

    Attributes:
        pitch: (T,) of the trunk, positive nose down.  shift: (T, 3) of its middle: forward, to the left, up.
        look: (T,) of neck and head against the trunk, positive nose down.
        paws: (T, 4, 3) from where they stand, in order of `animal.FEET`.  lean: (T, 4) by which the last bones of legs
            lean back.  contact: (T, 4) bool, whether a paw stands still on the ground.
    """

    pitch: Array
    shift: Array
    look: Array
    paws: Array
    lean: Array
    contact: Array


def _smooth(x: Array) -> Array:
    x = np.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


def _there_and_back(t: Array, begin: float, way: float, stay: float, pause: float) -> Array:
    """(T,) from 0 to 1 in `way` s, `stay` s there, back in as long, and again after `pause` s; linear."""
    u = np.where(t < begin, 0.0, (t - begin) % (2 * way + stay + pause))
    return np.clip(np.minimum(u, 2 * way + stay - u) / way, 0, 1)


def _nothing(t: Array) -> Act:
    T = len(t)
    return Act(np.zeros(T), np.zeros((T, 3)), np.zeros(T), np.zeros((T, 4, 3)), np.zeros((T, 4)), np.ones((T, 4), bool))


def _set_elsewhere(a: Act, done: Array, foot: int, when: float, to: float) -> None:
    """A paw that steps `to` ahead, in place: from `when` on in two fifths of what is `done` (T,)."""
    w = np.clip((done - when) / 0.4, 0, 1)
    a.paws[:, foot, 0] = _smooth(w) * to
    a.paws[:, foot, 2] = _STEP * np.sin(np.pi * w) ** 2
    a.contact[:, foot] = (w == 0) | (w == 1)


def _down(p: Proportions, t: Array, rng: np.random.Generator, *, rise: float, front: float, flat: bool) -> Act:
    """Hind legs folded under a trunk whose pelvis is near the ground, with the withers higher by `rise`; front paws go
    `front` ahead, and lie on the ground to the elbows if they are to be `flat`."""
    done = _there_and_back(t, rng.uniform(0.3, 0.7), rng.uniform(0.8, 1.2), rng.uniform(2.5, 3.5), 1.0)
    w, a, half, pitch = _smooth(done), _nothing(t), p.trunk / 2, float(np.arcsin(min(rise / p.trunk, 0.6)))
    ahead = 0.12 if not flat else 0.0  # of the pelvis
    rest = {k: v / p.height for k, v in rest_joints(p).items()}
    a.pitch[:] = -pitch * w
    a.shift[:, 0] = w * (ahead + half * (np.cos(pitch) - 1))
    a.shift[:, 2] = w * (_PELVIS + half * np.sin(pitch) - rest["spine_mid"][2])
    a.look[:] = 0.8 * pitch * w
    first = rng.permutation(2)
    thigh, shank, foot = (
        float(np.linalg.norm(rest[f"hind_left_{upper}"] - rest[f"hind_left_{lower}"]))
        for upper, lower in (("hip", "knee"), ("knee", "hock"), ("hock", "paw"))
    )
    # The hock lies under the hip, or behind it where thigh and shank do not fold as far as that.
    high = _PELVIS + rest["hind_left_hip"][2] - rest["pelvis"][2] - _HOCK
    behind = np.sqrt(max((1.15 * abs(thigh - shank)) ** 2 - high**2, 0.03**2))
    hind = ahead + rest["hind_left_hip"][0] - behind + foot - rest["hind_left_paw"][0]
    for k in range(2):
        _set_elsewhere(a, done, k, 0.1 + 0.3 * float(first[k]), front)
        _set_elsewhere(a, done, k + 2, 0.1 + 0.4 * float(first[1 - k]), hind)
        a.lean[:, k + 2] = _FLAT * w
        a.lean[:, k] = _FLAT * w * flat
    return a


def _sit(p: Proportions, t: Array, rng: np.random.Generator) -> Act:
    return _down(p, t, rng, rise=_SIT, front=0.06, flat=False)


def _lie(p: Proportions, t: Array, rng: np.random.Generator) -> Act:
    """On the belly, forearms on the ground."""
    return _down(p, t, rng, rise=_LIE, front=0.40, flat=True)


def _reach(p: Proportions, t: Array, rng: np.random.Generator) -> Act:
    """A front paw raised, again and again."""
    foot, a = int(rng.integers(2)), _nothing(t)
    w = _smooth(
        _there_and_back(t, rng.uniform(0.3, 0.6), rng.uniform(0.35, 0.6), rng.uniform(0.2, 0.8), rng.uniform(0.4, 0.8))
    )
    a.paws[:, foot] = w[:, None] * [rng.uniform(0.12, 0.25), 0, rng.uniform(0.25, 0.4)]
    a.lean[:, foot] = -rng.uniform(0, 0.5) * w
    a.contact[:, foot] = w == 0
    a.shift[:, 1] = (0.04 if foot else -0.04) * w
    return a


def _graze(p: Proportions, t: Array, rng: np.random.Generator) -> Act:
    """The nose to the ground, as far as neck and head are long."""
    w = _smooth(_there_and_back(t, rng.uniform(0.2, 0.5), rng.uniform(0.7, 1.0), rng.uniform(1, 2), 0.6))
    a = _nothing(t)
    a.pitch[:] = 0.10 * w
    look = np.linspace(0, 1.9, 96)
    rest = rest_joints(p)
    withers, nose = rest["withers"] / p.height, (rest["nose"] - rest["withers"]) / p.height
    low = withers[2] - 0.05 - nose[0] * np.sin(look) + nose[2] * np.cos(look)
    a.look[:] = w * look[int(np.argmax(low < _NOSE)) if (low < _NOSE).any() else -1]
    return a


def _rear(p: Proportions, t: Array, rng: np.random.Generator) -> Act:
    """On the hind legs, with the middle of the trunk about over them, and the front paws before the chest."""
    w = _smooth(
        _there_and_back(t, rng.uniform(0.2, 0.6), rng.uniform(0.6, 0.8), rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.6))
    )
    a, half, pitch = _nothing(t), p.trunk / 2, rng.uniform(0.9, 1.2) * w
    back = -0.8 * half * np.cos(pitch) * w
    a.pitch[:] = -pitch
    a.shift[:, 0] = half * (np.cos(pitch) - 1) + back
    a.shift[:, 2] = half * np.sin(pitch) - 0.06 * w
    a.look[:] = 0.7 * pitch
    chest = p.trunk * np.stack([np.cos(pitch) - 1, np.sin(pitch)], 1) + np.stack([back, -0.06 * w], 1)
    for k in range(2):
        a.paws[:, k, 0] = chest[:, 0] + rng.uniform(0.1, 0.25) * w
        a.paws[:, k, 2] = chest[:, 1] + rng.uniform(0.2, 0.35) * w
        a.lean[:, k] = -rng.uniform(0.2, 0.9) * w
        a.contact[:, k] = w == 0
    return a


ACTS: dict[str, Callable[[Proportions, Array, np.random.Generator], Act]] = {
    "reach": _reach, "graze": _graze, "sit": _sit, "lie": _lie, "rear": _rear,
}  # fmt: skip
FOLD = ("sit", "lie")  # not of a horse, which does it otherwise


def perform(name: str, p: Proportions, t: Array, seed: int) -> Act:
    """An act of `ACTS` at times t (T,) s; nothing for other names."""
    return ACTS[name](p, t, np.random.default_rng([seed, 4])) if name in ACTS else _nothing(t)
