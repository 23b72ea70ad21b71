"""What retargeting needs of a creature, the same for animals and people."""

from dataclasses import dataclass, field

import numpy as np

from slomo.retarget.trunk import Trunk

Array = np.ndarray


@dataclass(frozen=True)
class Hands:
    """Hands (T, 2, 3) from their shoulders in the trunk's frame, in units of the straight arm; confidence (T, 2).

    `arm`: m, the straight arm.
    """

    offset: Array
    confidence: Array
    arm: float


@dataclass(frozen=True)
class Subject:
    """A creature in its own size, soles in the order of the robot's.

    Attributes:
        trunk: origin between the roots of the legs.
        feet: (T, S, 3) m.  confidence: (T, S).
        stands: (T, S) probability that the foot stands; NaN where nobody said.
        pointing: (T, S) rad, world, where the toes point; None when there are no toes.
        standing: m, height of the origin over the feet when it stands; None to take it from the motion.
        leg: m, length that the robot's leg replaces; None for `standing`.
        hands: or None.
        fixed: the origin never moves, so only the feet can tell how high and where it is.
        said: decisions for the user's eyes.
    """

    trunk: Trunk
    feet: Array
    confidence: Array
    stands: Array
    pointing: Array | None = None
    standing: float | None = None
    leg: float | None = None
    hands: Hands | None = None
    fixed: bool = False
    said: tuple[str, ...] = field(default=())
