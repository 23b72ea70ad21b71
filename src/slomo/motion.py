"""What flows between the stages: key points, the optimised reference, the roll-out.

Frozen records of plain NumPy arrays: seconds, metres, radians, newtons, world frame with z up. They check
themselves when they are made and raise `InvalidData` naming the array and the first offending index.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Self

import numpy as np

from slomo.errors import InvalidData

Array = np.ndarray


def _finite(name: str, x: Array) -> None:
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        raise InvalidData(f"not a finite number at index {tuple(int(i) for i in bad[0])}", where=name)


def _shape(name: str, x: Array, shape: tuple[int | None, ...]) -> None:
    if x.ndim != len(shape) or any(want is not None and want != got for want, got in zip(shape, x.shape, strict=True)):
        raise InvalidData(f"has shape {x.shape}, expected {tuple('*' if s is None else s for s in shape)}", where=name)


def _times(t: Array) -> None:
    _shape("t", t, (None,))
    _finite("t", t)
    if len(t) < 2 or np.any(np.diff(t) <= 0):
        raise InvalidData("needs at least two strictly increasing times", where="t")


def _unique(name: str, names: tuple[str, ...]) -> None:
    if len(set(names)) != len(names):
        raise InvalidData(f"names repeat: {sorted({n for n in names if names.count(n) > 1})}", where=name)


@dataclass(frozen=True)
class KeypointMotion:
    """Key points over time.

    Attributes:
        t: (T,) s, from the first video frame, strictly increasing.
        positions: (T, N, 3) m, world frame, z up.
        names: N unique names.
        confidence: (T, N) in [0, 1]; 0 means missing, and only there may positions be arbitrary (still finite).
        contact: (T, F) probability in [0, 1] that the named key point stands on the ground, or None.
        contact_names: F names, a subset of `names`.
    """

    t: Array
    positions: Array
    names: tuple[str, ...]
    confidence: Array
    contact: Array | None = None
    contact_names: tuple[str, ...] = ()

    def __post_init__(self):
        T, N = len(self.t), len(self.names)
        _times(self.t)
        _shape("keypoints", self.positions, (T, N, 3))
        _finite("keypoints", self.positions)
        _shape("confidence", self.confidence, (T, N))
        _finite("confidence", self.confidence)
        _unique("keypoint_names", self.names)
        if self.contact is not None:
            _shape("contact", self.contact, (T, len(self.contact_names)))
            _finite("contact", self.contact)
        for n in self.contact_names:
            self.index(n)

    def index(self, name: str) -> int:
        """Column of a key point. Raises `InvalidData` listing the names there are."""
        if name not in self.names:
            raise InvalidData(f"no key point {name!r} (it has: {', '.join(self.names)})", where="keypoint_names")
        return self.names.index(name)

    def __getitem__(self, name: str) -> Array:
        """(T, 3) m, the path of one key point."""
        return self.positions[:, self.index(name)]

    def to_arrays(self) -> dict[str, Array]:
        """The arrays of `keypoints.npz`, by the names promised to other programs."""
        out = dict(t=self.t, keypoints=self.positions, keypoint_names=np.array(self.names), confidence=self.confidence)
        if self.contact is not None:
            out |= dict(contact=self.contact, contact_names=np.array(self.contact_names))
        return out

    @classmethod
    def from_arrays(cls, z: Mapping[str, Array]) -> Self:
        """Inverse of `to_arrays`; `confidence` and `contact` are optional."""
        needed = ("t", "keypoints", "keypoint_names")
        if missing := [name for name in needed if name not in z]:
            raise InvalidData(
                f"has no array {missing[0]!r} (it has: {', '.join(z) or 'none'}; needed: {', '.join(needed)})",
                where="keypoints.npz",
            )
        positions = np.asarray(z["keypoints"], float)
        return cls(
            t=np.asarray(z["t"], float),
            positions=positions,
            names=tuple(map(str, z["keypoint_names"])),
            confidence=np.asarray(z.get("confidence", np.ones(positions.shape[:2])), float),
            contact=np.asarray(z["contact"], float) if "contact" in z else None,
            contact_names=tuple(map(str, z.get("contact_names", ()))),
        )


class _Arrays:
    """`to_arrays` / `from_arrays` for records whose fields are all arrays, name tuples or strings."""

    def to_arrays(self) -> dict[str, Array]:
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_arrays(cls, z: Mapping[str, Array]) -> Self:
        out: dict[str, Any] = {}
        for f in fields(cls):  # type: ignore[arg-type]
            if f.name not in z:
                if f.default_factory is not MISSING:
                    continue
                raise InvalidData(f"has no array {f.name!r} (it has: {', '.join(z) or 'none'})", where=cls.__name__)
            x = z[f.name]
            out[f.name] = str(x) if f.type in (str, "str") else tuple(map(str, x)) if f.name.endswith("names") else x
        return cls(**out)


@dataclass(frozen=True)
class Reference(_Arrays):
    """A motion of the point-foot model that satisfies its dynamics and contact.

    Attributes:
        t: (T,) s.  h: (T-1,) s, step lengths.
        q: (T, 7 + 3 C): body position (3) m, body orientation quat_xyzw (4), contact points (C x 3) m, world.
        v: (T, 6 + 3 C): body velocity (3) m/s world, angular velocity (3) rad/s in the body frame, points (C x 3) m/s.
        u: (T-1, 3 C) N, world: force that each contact point exerts on the body.
        lam: (T-1, C, 3) N, world: contact force of the ground on each point (normal is z on flat ground).
        point_names: C names, the robot's foot (and hand) frames.
        robot_digest: digest of the robot for which it was made.
        cycle: (4,) m, m, m, rad where the motion repeats for ever: the end is the start turned about z by the last and
            then moved by the others; else (0,).
    """

    t: Array
    h: Array
    q: Array
    v: Array
    u: Array
    lam: Array
    point_names: tuple[str, ...]
    robot_digest: str
    cycle: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self):
        T, C = len(self.t), len(self.point_names)
        _times(self.t)
        _shape("cycle", self.cycle, (4,) if len(self.cycle) else (0,))
        _finite("cycle", self.cycle)
        shapes = dict(h=(T - 1,), q=(T, 7 + 3 * C), v=(T, 6 + 3 * C), u=(T - 1, 3 * C), lam=(T - 1, C, 3))
        for name, shape in shapes.items():
            _shape(name, getattr(self, name), shape)
            _finite(name, getattr(self, name))

    @property
    def points(self) -> Array:
        """(T, C, 3) m, contact points in the world."""
        return self.q[:, 7:].reshape(len(self.t), -1, 3)


@dataclass(frozen=True)
class Rollout(_Arrays):
    """What the robot (or its simulation) did.

    Attributes:
        t: (T,) s, one row a joint-control tick.
        q: (T, nq) Pinocchio configuration (free-flyer quat_xyzw first).  v: (T, nv), in the base frame.
        q_des: (T, nj) rad, joint targets.  tau: (T, nj) N m, applied joint torques.
        body: (T, 7) m and quat_xyzw, base pose.  points: (T, C, 3) m, feet.  lam: (T, C, 3) N, measured contact forces.
        body_ref, points_ref: the reference at the same times, shapes as above.
        mpc_t: (K,) s.  mpc_ms: (K,) wall time of each solve.  mpc_status: (K,) 0 = solved, 1 = previous plan kept.
        point_names, joint_names: names.  reference_digest: what was tracked.
        body_est: (T, 7) base pose as the controller had it.  contact_est: (T, C) probability of contact, likewise.
    """

    t: Array
    q: Array
    v: Array
    q_des: Array
    tau: Array
    body: Array
    points: Array
    lam: Array
    body_ref: Array
    points_ref: Array
    mpc_t: Array
    mpc_ms: Array
    mpc_status: Array
    point_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    reference_digest: str = field(default="")
    body_est: Array = field(default_factory=lambda: np.zeros((0, 7)))
    contact_est: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True)
class WholeBody(_Arrays):
    """A motion of the whole robot that satisfies the dynamics of its URDF and contact.

    Attributes:
        t: (T,) s.  h: (T-1,) s, step lengths.
        q: (T, 7 + nj) Pinocchio configuration (free-flyer quat_xyzw first, joints in rad).
        v: (T, 6 + nj): root velocity (3) m/s world, angular velocity (3) rad/s in the root frame, joints (nj) rad/s.
        tau: (T-1, nj) N m.
        lam: (T-1, C, 3) N, world: contact force of the ground on each point.
        point_names: C names.  joint_names: nj names.  robot_digest: digest of the robot for which it was made.
        cycle: as of a `Reference`.
    """

    t: Array
    h: Array
    q: Array
    v: Array
    tau: Array
    lam: Array
    point_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    robot_digest: str
    cycle: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self):
        T, C, nj = len(self.t), len(self.point_names), len(self.joint_names)
        _times(self.t)
        _shape("cycle", self.cycle, (4,) if len(self.cycle) else (0,))
        _finite("cycle", self.cycle)
        shapes = dict(h=(T - 1,), q=(T, 7 + nj), v=(T, 6 + nj), tau=(T - 1, nj), lam=(T - 1, C, 3))
        for name, shape in shapes.items():
            _shape(name, getattr(self, name), shape)
            _finite(name, getattr(self, name))
