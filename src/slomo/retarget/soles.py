"""What retargeting needs of a robot, the same for four paws and for two feet and two hands."""

from dataclasses import dataclass

import numpy as np

from slomo.errors import UsageError
from slomo.robot import Robot

Array = np.ndarray


@dataclass(frozen=True)
class RobotBody:
    """Soles (what stands: a paw, or a foot with toe and heel) and hands of a robot, base frame at the nominal pose.

    Attributes:
        soles: S names.  points: for each sole the columns of its limbs, (toe, heel) or the paw alone.
        hands: columns of the hands' limbs.
        pairs: soles that stand in turn, so that the ground shows under each pair.
        roots: (S, 3) m, attachments of the soles' legs.  root: (3,) m, their mean.
        home: (S, 2) m, where a sole stands when nothing else is known.
        leg: m, height of `root` over the soles.
        reach: (S, 2) m, least and greatest distance of root and sole.
        length: m, from heel to toe; 0 for paws.
    """

    soles: tuple[str, ...]
    points: tuple[tuple[int, ...], ...]
    hands: tuple[int, ...]
    pairs: tuple[tuple[int, ...], ...]
    roots: Array
    root: Array
    home: Array
    leg: float
    reach: Array
    length: float

    @classmethod
    def of(cls, robot: Robot) -> "RobotBody":
        """Raises `UsageError` for a robot whose limbs are neither paws nor toes, heels and hands."""
        names = robot.limb_names
        if robot.kind == "quadruped":
            soles, points, hands = names, tuple((c,) for c in range(len(names))), ()
            front = robot.nominal_hips[:, 0] > robot.nominal_hips[:, 0].mean()
            pairs = tuple(np.flatnonzero(front).tolist()), tuple(np.flatnonzero(~front).tolist())
        elif {f"{s}_{p}" for s in ("left", "right") for p in ("toe", "heel", "hand")} == set(names):
            soles = ("left", "right")
            points = tuple((names.index(f"{s}_toe"), names.index(f"{s}_heel")) for s in soles)
            hands = tuple(names.index(f"{s}_hand") for s in soles)
            pairs = ((0, 1),)
        else:
            raise UsageError(f"cannot retarget to the limbs {', '.join(names)}", where=robot.name)
        hips, feet = robot.nominal_hips, robot.nominal_feet
        roots = np.stack([hips[list(p)].mean(axis=0) for p in points])
        under = np.stack([feet[list(p)].mean(axis=0) for p in points])
        length = 0.0 if robot.kind == "quadruped" else float(np.linalg.norm(np.subtract(*feet[list(points[0])])))
        reach = np.stack([robot.leg_reach[list(p)].min(axis=0) for p in points])
        return cls(
            soles=soles, points=points, hands=hands, pairs=pairs, roots=roots, root=roots.mean(axis=0),
            # A paw stands under its hip; a foot reaches further ahead of the ankle than behind.
            home=(roots if length == 0 else under)[:, :2], leg=float((roots - under)[:, 2].mean()), reach=reach,
            length=length,
        )  # fmt: skip
