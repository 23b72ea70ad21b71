"""A robot: its URDF through Pinocchio, and what robots/<name>/robot.toml says of it.

A new robot is a new folder robots/<name>/ with a robot.toml, never a code change. Everything that the kinematics
can tell (body, hips, feet, reach, masses, forces) is computed, so that the file only names frames.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.errors import InvalidData
from slomo.robot_body import point_foot_body, rigid_groups, swing_masses
from slomo.robot_file import find_robot_file, find_urdf, key_point_names, read_robot_file, robot_folders
from slomo.robot_limbs import Point, force_limits, frame_point, leg_root, reaches, underside
from slomo.robot_model import (
    Limb,
    add_frame,
    build_model,
    joint_limit,
    joint_values,
    make_limb,
    nominal_pose,
    position_limits,
    repair_base_inertia,
)
from slomo.robot_workspace import workspace

Array = np.ndarray

BASE_FRAME = "point_foot_body"
# kg m2 per N m of effort, rotor inertia seen at a joint of which nothing is known: strong motors have heavy rotors or
# high gears. The joints of the Go1 and the G1 have 1.2e-4 to 2.8e-4, but for small wrists.
ROTOR_INERTIA = 1.8e-4
# Of the highest speed, the one up to which a motor gives all of its torque, where nothing is known: that of the Go2's
# hips in their maker's torque-speed curve (13.5 of 30 rad/s).
KNEE = 0.45
# Part of every robot's digest: raised when the same files come to mean another robot.
_MEANING = b"2: the base is the centre of mass of the point-foot model's body"


@dataclass(frozen=True, eq=False)
class Robot:
    """Everything about the robot that any stage needs.

    Attributes:
        name, kind: "quadruped" or "humanoid".
        urdf, package_dirs: the model's file and where its package:// addresses are looked up.
        model: Pinocchio model with a free-flyer root (nq = 7 + nj, nv = 6 + nj).
        base: name of the base frame: at the centre of mass of `body`, oriented as `base_link`. The loader adds it.
        base_link: the link of the URDF that robot.toml names.
        body: the point-foot model's body, base frame: mass (kg), no lever, inertia (kg m2).
        foot_mass: (C,) kg, of the point-foot model's points.
        limbs: C limbs.
        q_nominal: (nq,) standing pose, feet on the ground z = 0, joints in the model's order.
        lower, upper: (nj,) rad.  effort: (nj,) N m.  velocity: (nj,) rad/s.
        rotor_inertia: (nj,) kg m2, as seen at the joint.  knee_speed: (nj,) rad/s, up to which a motor gives its full
            effort; from there it falls to nothing at `velocity`.
        locked: patterns of joints of the URDF that the model lacks, at zero.
        digest: SHA-256 of the file and the URDF.
        notes: what was repaired, for the user's eyes.
    """

    name: str
    kind: str
    urdf: Path
    package_dirs: tuple[Path, ...]
    model: pin.Model
    base: str
    base_link: str
    body: pin.Inertia
    foot_mass: Array
    limbs: tuple[Limb, ...]
    q_nominal: Array
    lower: Array
    upper: Array
    effort: Array
    velocity: Array
    rotor_inertia: Array
    knee_speed: Array
    digest: str
    locked: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def limb_names(self) -> tuple[str, ...]:
        return tuple(limb.name for limb in self.limbs)

    @property
    def foot_names(self) -> tuple[str, ...]:
        """Foot frames in limb order: the `point_names` of references and roll-outs."""
        return tuple(limb.foot for limb in self.limbs)

    @property
    def key_points(self) -> tuple[str, ...]:
        """Names of the limbs' ends in key-point motions (see `robot_file.key_point_names`)."""
        return key_point_names(self.limb_names)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.model.names[2:])

    @property
    def feet(self) -> Array:
        """Columns of the limbs that stand on the ground: all but hands."""
        return np.flatnonzero([not limb.is_hand for limb in self.limbs])

    @property
    def foot_radius(self) -> float:
        """m, height of the foot frames over the ground in stance (mean of the feet's)."""
        return float(np.mean([limb.foot_radius for limb in self.limbs if not limb.is_hand]))

    @property
    def mass(self) -> float:
        """kg, of everything."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    @cached_property
    def nominal_hips(self) -> Array:
        """(C, 3) m, the limbs' attachments at the nominal pose, base frame."""
        return self.frames_in_base(self.q_nominal, tuple(limb.hip for limb in self.limbs))

    @cached_property
    def nominal_feet(self) -> Array:
        """(C, 3) m, foot frames at the nominal pose, base frame."""
        return self.frames_in_base(self.q_nominal, self.foot_names)

    @cached_property
    def standing_height(self) -> float:
        """m, base origin over the feet's frames at the nominal pose (add `foot_radius` for the ground)."""
        return float(-self.nominal_feet[self.feet, 2].mean())

    @cached_property
    def pairs(self) -> Array:
        """(P, 2) int, columns of limbs whose points are on one link: toe and heel."""
        return np.array([g for g in rigid_groups(self.model, self.limbs) if len(g) == 2], int).reshape(-1, 2)

    @cached_property
    def pair_length(self) -> Array:
        """(P,) m, distance of the points of each pair."""
        return np.linalg.norm(np.diff(self.nominal_feet[self.pairs], axis=1)[:, 0], axis=1)

    @cached_property
    def leg_reach(self) -> Array:
        """(C, 2) m, least and greatest distance of hip and foot frames within the joint limits.

        The hip frame moves with the joints above it, so this is the length of the leg proper.
        """
        return self._reach(self._hips)

    @cached_property
    def leg_roots(self) -> Array:
        """(C, 3) m, base frame: points of the trunk from which `root_reach` bounds the feet (see `leg_root`).

        The hip at the nominal pose, or the point nearest to it on the axis that swings it.
        """
        T_root_base = self.model.frames[self.model.getFrameId(self.base)].placement
        return np.array([T_root_base.actInv(point.at) for point in self._roots])

    @cached_property
    def root_reach(self) -> Array:
        """(C, 2) m, least and greatest distance of `leg_roots` and foot frames within the joint limits.

        As `leg_reach` where the root is the hip; exact, whatever the first joint's angle, where it is on its axis.
        """
        on_axis = np.linalg.norm(self.leg_roots - self.nominal_hips, axis=1) > 1e-6
        return self._reach([p if on else h for p, h, on in zip(self._roots, self._hips, on_axis, strict=True)])

    @cached_property
    def force_limits(self) -> Array:
        """(C, 3) N, world axes: what the joints allow at each point at the nominal pose, one axis at a time."""
        data = self.model.createData()
        pin.computeJointJacobians(self.model, data, self.q_nominal)
        pin.updateFramePlacements(self.model, data)
        feet = [self.model.getFrameId(name) for name in self.foot_names]
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = np.array([pin.getFrameJacobian(self.model, data, f, world)[:3, 6:] for f in feet])
        limits = force_limits(J, self.effort)
        if not np.all(np.isfinite(limits)):
            c = int(np.argwhere(~np.isfinite(limits))[0, 0])
            raise InvalidData(f"no joint moves {self.limbs[c].foot!r} along some axis", where=f"robot {self.name}")
        return limits

    @cached_property
    def clearance(self) -> Array:
        """(C,) m, how far a foot's point stays below the base origin along the base's z axis; -inf for hands.

        The trunk's underside is the lowest point of the base link's collision shapes; when it has none, of those of all
        links that are fixed to it; without any, the height of the hips.
        """
        T_base_root = self.model.frames[self.model.getFrameId(self.base)].placement.inverse()
        fixed = [f for f in self.model.frames if f.type == pin.FrameType.BODY and f.parentJoint == 1]
        placements = {f.name: T_base_root * f.placement for f in fixed}
        low = underside(self.urdf, self.package_dirs, {self.base_link: placements[self.base_link]})
        if not np.isfinite(low):
            low = underside(self.urdf, self.package_dirs, placements)
        under = np.full(len(self.limbs), -low) if np.isfinite(low) else -self.nominal_hips[:, 2]
        under = under + [limb.foot_radius for limb in self.limbs]
        return np.where([limb.is_hand for limb in self.limbs], -np.inf, under)

    @cached_property
    def workspace(self) -> Array:
        """(C, K) m, offsets of the half-spaces in the base frame that hold each point (see `robot_workspace`)."""
        return workspace(
            self.model, self.q_nominal, self.base, self.foot_names, lower=self.lower, upper=self.upper,
            below=self.clearance,
        )  # fmt: skip

    @cached_property
    def composite(self) -> pin.Inertia:
        """The whole robot locked at the nominal pose, base frame: mass (kg), lever to the centre of mass (m) and
        inertia about it (kg m2)."""
        data = self.model.createData()
        pin.ccrba(self.model, data, self.q_nominal, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, data)
        T_world_base = data.oMf[self.model.getFrameId(self.base)]
        R = T_world_base.rotation
        com = T_world_base.actInv(data.com[0])
        return pin.Inertia(self.mass, com, R.T @ data.Ig.inertia @ R)

    def frames_in_base(self, q: Array, names: tuple[str, ...]) -> Array:
        """(len(names), 3) m, origins of frames at configuration q (nq,), base frame."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, q)
        T_world_base = data.oMf[self.model.getFrameId(self.base)]
        return np.array([T_world_base.actInv(data.oMf[self.model.getFrameId(n)].translation) for n in names])

    @property
    def _hips(self) -> list[Point]:
        return [frame_point(self.model, limb.hip) for limb in self.limbs]

    @cached_property
    def _roots(self) -> list[Point]:
        q, lower, upper = self.q_nominal, self.lower, self.upper
        return [leg_root(self.model, q, limb.hip, limb.foot, lower=lower, upper=upper) for limb in self.limbs]

    def _reach(self, starts: list[Point]) -> Array:
        """(C, 2) m, least and greatest distance of C points from the foot frames (see `robot_limbs.reaches`)."""
        feet = [frame_point(self.model, name) for name in self.foot_names]
        return reaches(self.model, self.q_nominal, starts, feet, pairs=self.pairs, lower=self.lower, upper=self.upper)


def list_robots() -> list[str]:
    """Names that `load_robot` knows."""
    return sorted(robot_folders())


def load_robot(name_or_path: str) -> Robot:
    """The robot of that name, or of that robot.toml.

    Raises:
        UsageError: unknown name (lists the known ones) or no such file.
        InvalidData: the file, the URDF or a frame that it names cannot be used.
    """
    path = find_robot_file(name_or_path)
    file = read_robot_file(path)
    urdf, package_dirs = find_urdf(file.urdf, path)
    model = build_model(file, urdf, path)
    lower, upper = position_limits(file, model, path)
    effort = joint_limit("effort", file.effort, model.effortLimit[6:], model, path)
    velocity = joint_limit("velocity", file.velocity, model.velocityLimit[6:], model, path)
    rotor_inertia = joint_values("rotor_inertia", file.rotor_inertia, ROTOR_INERTIA * effort, model, path)
    knee_speed = np.minimum(joint_values("knee_speed", file.knee_speed, KNEE * velocity, model, path), velocity)
    note = repair_base_inertia(model)
    limbs = tuple(make_limb(section, model, urdf, path) for section in file.limbs)
    q_nominal = nominal_pose(file, model, limbs, path, lower=lower, upper=upper)
    swing = swing_masses(model, q_nominal, limbs)
    given = [section.foot_mass or file.point_foot.foot_mass for section in file.limbs]
    foot_mass = np.array([m if m is not None else s for m, s in zip(given, swing, strict=True)])
    body = point_foot_body(model, q_nominal, limbs, foot_mass, swing)
    T_root_link = model.frames[model.getFrameId(file.frames.base)].placement
    T_root_base = pin.SE3(T_root_link.rotation, body.lever)
    add_frame(model, BASE_FRAME, file.frames.base, T_root_link.inverse() * T_root_base, path)
    return Robot(
        name=file.name,
        kind=file.kind,
        urdf=urdf,
        package_dirs=package_dirs,
        model=model,
        base=BASE_FRAME,
        base_link=file.frames.base,
        body=T_root_base.inverse().act(body),
        foot_mass=foot_mass,
        limbs=limbs,
        q_nominal=q_nominal,
        lower=lower,
        upper=upper,
        effort=effort,
        velocity=velocity,
        rotor_inertia=rotor_inertia,
        knee_speed=knee_speed,
        digest=hashlib.sha256(_MEANING + path.read_bytes() + urdf.read_bytes()).hexdigest(),
        locked=tuple(file.locked),
        notes=(note,) if note else (),
    )
