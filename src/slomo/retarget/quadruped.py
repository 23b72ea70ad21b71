"""An animal's key points as a `Subject`."""

import numpy as np

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion
from slomo.retarget.subject import Subject
from slomo.retarget.trunk import Pairs, Trunk, across, frame, middle

LIMBS = ("front_left", "front_right", "hind_left", "hind_right")
_SHOULDERS = ("front_left_shoulder", "front_right_shoulder")
_HIPS = ("hind_left_hip", "hind_right_hip")
# What marks either end of the trunk, the best first.
_FRONT = (_SHOULDERS, ("withers",), ("chest",), ("neck",))
_HIND = (_HIPS, ("pelvis",), ("tail_base",))
PAIRS: Pairs = (_SHOULDERS, _HIPS)


def ends(limb: str) -> tuple[str, ...]:
    """Key points of a limb's end, the first of which is needed."""
    return (f"{limb}_paw",)


def trunk_of(motion: KeypointMotion) -> Trunk:
    """The trunk from hips and shoulders, or from the spine where those are missing.

    Raises:
        InvalidData: no pair of key points spans the trunk; the message names what would do.
    """
    front = middle(motion, _FRONT, "the front end of the trunk")
    hind = middle(motion, _HIND, "the hind end of the trunk")
    length = np.linalg.norm(front - hind, axis=1)
    if np.median(length) == 0:
        raise InvalidData("front and hind end of the trunk coincide", where="key points")
    return Trunk(origin=(front + hind) / 2, rotation=frame(front - hind, across(motion, PAIRS), axis="x"))


def read(motion: KeypointMotion) -> Subject:
    """The animal: soles are its paws, in the order of `LIMBS`."""
    columns = [motion.index(n) for limb in LIMBS for n in ends(limb)]
    stands = np.full((len(motion.t), len(LIMBS)), np.nan)
    for c, limb in enumerate(LIMBS):
        if motion.contact is not None and f"{limb}_paw" in motion.contact_names:
            stands[:, c] = motion.contact[:, motion.contact_names.index(f"{limb}_paw")]
    return Subject(
        trunk=trunk_of(motion),
        feet=motion.positions[:, columns],
        confidence=motion.confidence[:, columns],
        stands=stands,
    )
