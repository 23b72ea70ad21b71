"""What joins a body for a while is given back: a box that it stands before is taken for a part of it, though nothing of
a body is elsewhere before and after."""

import cv2
import numpy as np

from slomo.reconstruct.flow import inside, sample
from slomo.reconstruct.instances import components, distance
from slomo.reconstruct.instances_motion import SharedMotion, wider_than_a_leg
from slomo.reconstruct.segment import grown
from slomo.reconstruct.surroundings import frames_around

_GROWN = 1.15  # of the usual area in the frames around, from which on something may have joined
_RARELY = 0.4  # of those frames in which a place is seen: what is the body's less often is not its own
_MOSTLY = 0.7  # likewise, from which on it surely is
_SEEN = 3  # frames in which a place must be seen again
_BACK = 2.0  # px at the size of shared motion, within which flow there and back again must lead home
_RIM = 0.15  # roots of the body's area, how wide the edges of what passes are at most
_TIMES = 4  # over, at most
_LEAST = 0.04  # of the body, what is worth a look


def give_back_what_passes(layers: dict[int, np.ndarray], motion: SharedMotion) -> int:
    """Take out of `layers`, in place, what most frames around do not take for the body where flow carries it: wider
    than a leg, and only where the body is larger than it is around. Several times over, for what is taken out of one
    frame speaks against it in the next. Returns the frames concerned."""
    bodies = {k: p > 0.5 for k, p in layers.items() if (p > 0.5).any()}
    small = {k: cv2.resize(b.astype(np.float32), motion.size, interpolation=cv2.INTER_AREA) for k, b in bodies.items()}
    gone: dict[int, np.ndarray] = {}
    for _ in range(_TIMES):
        area = {k: float(s.sum()) for k, s in small.items()}
        found = {k: _passing(k, small, area, motion) for k in small}
        found = {k: f for k, f in found.items() if f.any()}
        if not found:
            break
        for k, f in found.items():
            small[k] = np.where(f, 0, small[k])
            gone[k] = gone.get(k, f) | f
    for k, f in gone.items():
        whole = bodies[k] & (cv2.resize(f.astype(np.uint8), bodies[k].shape[::-1]) > 0)
        layers[k] = np.where(grown(whole, 0.1) & ~(bodies[k] & ~whole), 0, layers[k]).astype(np.float16)
    return len(gone)


def _passing(k: int, bodies: dict[int, np.ndarray], area: dict[int, float], motion: SharedMotion) -> np.ndarray:
    """(h, w) bool: what of body k is rarely seen as the body's around."""
    body = bodies[k] > 0.5
    around = frames_around(k, bodies)
    if len(around) < _SEEN or area[k] < _GROWN * np.median([area[o] for o in around]):
        return np.zeros_like(body)
    own, seen = np.zeros(body.shape), np.zeros(body.shape)
    for o in around:
        there = motion.chain(k, o)
        home = np.linalg.norm(there + sample(motion.chain(o, k), there), axis=-1) < _BACK
        known = home & inside(there)
        own += known * (sample(bodies[o], there) > 0.5)
        seen += known
    rarely = body & (seen >= _SEEN) & (own < _RARELY * seen)
    pieces = components(rarely & wider_than_a_leg(rarely, body), _LEAST * area[k])
    if not pieces:
        return np.zeros_like(body)
    # Up to where the body surely is, for flow is unsure at the edges of what passes.
    core = np.logical_or.reduce(pieces)
    sure = body & (seen >= _SEEN) & (own > _MOSTLY * seen)
    near = distance(core)
    return core | (body & ~sure & (near < _RIM * np.sqrt(area[k])) & (near < distance(sure)))
