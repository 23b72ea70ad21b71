"""The point-foot model: one rigid body and C point masses that touch the ground.

    m  dv_b = sum_c u_c + m g                     body (base origin = its centre of mass), world frame
    I  dw   = R^T sum_c (f_c - p) x u_c - w x I w   body frame
    m_c df_c'' = -u_c + m_c g + lam_c               each contact point, world frame

`u_c` is the force that point c exerts on the body (through its leg), `lam_c` the force of the ground on it. A
quadruped has 18 degrees of freedom and 12 inputs. q, v, u and lam are laid out as in `motion.Reference`.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from slomo.errors import InvalidData
from slomo.gravity import GRAVITY
from slomo.robot import Robot
from slomo.robot_file import key_point_names
from slomo.robot_workspace import directions

Array = np.ndarray


@dataclass(frozen=True)
class PointFootModel:
    """Constants of the model.

    Attributes:
        mass: kg, of the body: the robot without its feet.
        inertia: (3, 3) kg m^2, of the body about its origin, body frame.
        hips: (C, 3) m, attachment of each leg in the body frame, where key points have it.
        leg_min, leg_max: (C,) m, limits of the distance from `leg_roots` to foot.
        foot_mass: (C,) kg.
        u_max: (C, 3) N, largest |u| along each world axis.
        mu: friction coefficient.  g: m/s^2.
        names: C limb names.
        pairs: (P, 2) int, columns of points on one rigid foot (toe, heel), which stay `pair_length` apart.
        pair_length: (P,) m.
        clearance: (C,) m, least distance of a point below the body's origin along the body's z axis; -inf where
            the point is free (a hand).
        workspace: (C, K) m, offsets of the half-spaces of `robot_workspace` that hold the points in the body frame; inf
            where there is none.
        leg_roots: (C, 3) m, body frame: where leg lengths are measured from; the hips unless given.
    """

    mass: float
    inertia: Array
    hips: Array
    leg_min: Array
    leg_max: Array
    foot_mass: Array
    u_max: Array
    names: tuple[str, ...]
    mu: float = 0.6
    g: float = GRAVITY
    pairs: Array = field(default_factory=lambda: np.zeros((0, 2), int))
    pair_length: Array = field(default_factory=lambda: np.zeros(0))
    clearance: Array = field(default_factory=lambda: np.array(-np.inf))  # one number counts for every point
    workspace: Array = field(default_factory=lambda: np.array(np.inf))
    leg_roots: Array = field(default_factory=lambda: np.zeros((0, 3)))  # none: the hips

    def __post_init__(self):
        C = len(self.names)
        if np.size(self.leg_roots) == 0:
            object.__setattr__(self, "leg_roots", self.hips)
        for name, shape in dict(
            inertia=(3, 3), hips=(C, 3), leg_min=(C,), leg_max=(C,), foot_mass=(C,), u_max=(C, 3), leg_roots=(C, 3)
        ).items():
            x = np.asarray(getattr(self, name), float)
            if x.shape != shape or not np.all(np.isfinite(x)):
                raise InvalidData(f"needs finite numbers of shape {shape}, got shape {x.shape}", where=f"model {name}")
            object.__setattr__(self, name, np.ascontiguousarray(x))
        if not np.allclose(self.inertia, self.inertia.T) or np.linalg.eigvalsh(self.inertia)[0] <= 0:
            raise InvalidData("needs a symmetric positive definite matrix", where="model inertia")
        if not (self.mass > 0 and self.mu > 0 and np.all(self.foot_mass > 0) and np.all(self.u_max > 0)):
            raise InvalidData("mass, foot_mass, u_max and mu need positive numbers", where="model")
        if not np.all((self.leg_min >= 0) & (self.leg_min < self.leg_max)):
            raise InvalidData("needs 0 <= leg_min < leg_max", where="model legs")
        self._check_pairs(C)
        clearance = np.asarray(self.clearance, float)
        if clearance.shape not in ((), (C,)) or not np.all(clearance < np.inf):
            raise InvalidData(f"needs {C} numbers below infinity", where="model clearance")
        object.__setattr__(self, "clearance", np.full(C, clearance))
        K = len(directions())
        room = np.asarray(self.workspace, float)
        if room.shape not in ((), (C, K)) or np.any(np.isnan(room)):
            raise InvalidData(f"needs numbers of shape {(C, K)}", where="model workspace")
        object.__setattr__(self, "workspace", np.ascontiguousarray(np.broadcast_to(room, (C, K))))

    def _check_pairs(self, C: int) -> None:
        pairs = np.ascontiguousarray(np.reshape(self.pairs, (-1, 2)), dtype=np.int64)
        length = np.ascontiguousarray(self.pair_length, float)
        if np.any((pairs < 0) | (pairs >= C)) or len(np.unique(pairs)) != pairs.size:
            raise InvalidData(f"needs different columns of 0 to {C - 1}", where="model pairs")
        if length.shape != (len(pairs),) or not np.all((length > 0) & np.isfinite(length)):
            raise InvalidData("needs one length above 0 for each pair", where="model pair_length")
        object.__setattr__(self, "pairs", pairs)
        object.__setattr__(self, "pair_length", length)

    @property
    def C(self) -> int:
        """Number of contact points."""
        return len(self.names)

    @property
    def is_hand(self) -> Array:
        """(C,) bool: points that do not stand on the ground."""
        return np.array([name.endswith("_hand") for name in self.names])

    @property
    def key_points(self) -> tuple[str, ...]:
        """Names of the points in key-point motions (see `robot_file.key_point_names`)."""
        return key_point_names(self.names)

    @property
    def total_mass(self) -> float:
        """kg, body and feet."""
        return float(self.mass + self.foot_mass.sum())

    @classmethod
    def from_robot(cls, robot: Robot, *, mu: float = 0.6) -> Self:
        """The model of a robot, all of it from its URDF (see `Robot`). `mu` is the friction coefficient to plan with.

        Leg lengths are the joints' reach, tightened to stay away from straight and folded legs. `u_max` is what the
        joint efforts allow along one axis at the nominal pose.
        """
        return cls(
            mass=robot.body.mass,
            inertia=robot.body.inertia,
            hips=robot.nominal_hips,
            leg_min=1.1 * robot.root_reach[:, 0],
            leg_max=0.97 * robot.root_reach[:, 1],
            foot_mass=robot.foot_mass,
            u_max=robot.force_limits,
            names=robot.limb_names,
            mu=mu,
            pairs=robot.pairs,
            pair_length=robot.pair_length,
            clearance=robot.clearance,
            workspace=robot.workspace,
            leg_roots=robot.leg_roots,
        )
