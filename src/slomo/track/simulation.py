"""The whole robot in MuJoCo, from the same URDF that Pinocchio reads.

Pinocchio's conventions outside, MuJoCo's inside: joints in the model's order, quat_xyzw, base velocity in the base
frame. Links collide with the ground but not with each other.
"""

from fnmatch import fnmatchcase

import mujoco
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import trimesh

from slomo.errors import InvalidData
from slomo.robot import Robot
from slomo.robot_file import find_mesh
from slomo.terrain import Terrain
from slomo.track.simulated_ground import add_ground
from slomo.track.sole import contact_points

Array = np.ndarray

# (s, damping ratio) of the contact: landing at a walk's speed a foot gives in by 4 mm, as rubber does. Under MuJoCo's
# default of 0.02 s it is 2 cm, the foot's whole radius.
CONTACT = (0.005, 1.0)
SOLE = 0.005  # m, radius of the spheres at the points of a sole
# Of the standing height: how far above the base a payload's middle is, and how long its box's sides are.
PAYLOAD_LIFT, PAYLOAD_SIZE = 0.4, 0.4
GROUND, ROBOT = 1, 2
IMU = "imu"


def build_model(
    robot: Robot,
    terrain: Terrain,
    *,
    friction: float = 0.8,
    timestep: float = 1e-3,
    payload: float = 0.0,
    mass_scale: float = 1.0,
) -> mujoco.MjModel:
    """Free-floating robot on the ground, one torque motor a joint in Pinocchio's joint order.

    Args:
        friction: Coulomb coefficient between any link and the ground.
        timestep: s.
        payload: kg, on the trunk.  mass_scale: times mass and inertia of every link.

    Raises:
        InvalidData: MuJoCo cannot use the URDF.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(robot.urdf))
        _prepare(spec, robot, friction, _inertias(robot, payload, mass_scale))
        add_ground(spec, terrain, friction=friction, contype=GROUND, conaffinity=ROBOT, solref=CONTACT)
        spec.option.timestep = timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        return spec.compile()
    except ValueError as e:
        raise InvalidData(f"MuJoCo cannot use it: {e}", where=robot.urdf) from None


def _inertias(robot: Robot, payload: float, mass_scale: float) -> list[pin.Inertia]:
    """Of each joint of the model: what moves with it, scaled, and on the root a payload's box."""
    scaled = [pin.Inertia(y.mass * mass_scale, y.lever, y.inertia * mass_scale) for y in robot.model.inertias]
    if payload:
        base = robot.model.frames[robot.model.getFrameId(robot.base)].placement
        lift = pin.SE3(np.eye(3), np.array([0.0, 0.0, PAYLOAD_LIFT * robot.standing_height]))
        size = PAYLOAD_SIZE * robot.standing_height
        scaled[1] = scaled[1] + (base * lift).act(pin.Inertia.FromBox(payload, size, size, size))
    return scaled


def _prepare(spec: mujoco.MjSpec, robot: Robot, friction: float, inertias: list[pin.Inertia]) -> None:
    """Root, inertia, collision shapes and motors."""
    spec.compiler.fusestatic = True
    spec.worldbody.first_body().add_freejoint(name="root")
    locked = {j.name for j in spec.joints if any(fnmatchcase(j.name, pattern) for pattern in robot.locked)}
    for equality in list(spec.equalities):  # joints that mimic another one
        if {equality.name1, equality.name2} & locked:
            spec.delete(equality)
    for name in locked:
        spec.delete(spec.joint(name))
    # Each body that moves weighs what Pinocchio's does, in which all that is fixed to it, and the repairs of
    # `load_robot`, are counted already.
    for body in spec.bodies:
        if body.name == "world":
            continue
        body.explicitinertial = True
        body.mass, body.inertia, body.fullinertia = 0.0, [0, 0, 0], [np.nan, 0, 0, 0, 0, 0]
        if body.joints:
            name = body.joints[0].name
            inertia = inertias[1 if name == "root" else robot.model.getJointId(name)]
            Y = inertia.inertia
            body.mass, body.ipos = inertia.mass, inertia.lever
            body.fullinertia = [Y[0, 0], Y[1, 1], Y[2, 2], Y[0, 1], Y[0, 2], Y[1, 2]]

    for mesh in spec.meshes:
        hull = trimesh.load(find_mesh(mesh.file, robot.urdf, robot.package_dirs), force="mesh").convex_hull
        mesh.file, mesh.uservert = "", np.asarray(hull.vertices, float).ravel()
    points = contact_points(robot)
    soles = {robot.limbs[c].link for c in robot.pairs.ravel()}
    for link in {limb.link for limb in robot.limbs}:
        body = spec.body(link)
        for geom in list(body.geoms):
            spec.delete(geom)
        while link in soles and not body.joints:  # the sole may be a link of its own, fixed to the foot
            body = body.parent
            for geom in list(body.geoms):
                spec.delete(geom)
    for c, limb in enumerate(robot.limbs):
        foot, radius = spec.body(limb.link), limb.foot_radius or SOLE
        offsets = [p.offset for p in points if p.limb == c] or [np.zeros(3)]
        for i, offset in enumerate(offsets):
            # The sphere of a point on a sole lies above it.
            centre = np.array(limb.offset) + offset + (radius - limb.foot_radius) * _up(robot, limb.link)
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE
            foot.add_geom(name=f"{limb.foot}:{i}", type=sphere, size=[radius, 0, 0], pos=centre)
        foot.add_site(name=limb.foot, pos=limb.offset)
    spec.worldbody.first_body().add_site(name=IMU)
    spec.add_sensor(name=IMU, type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=IMU)
    for geom in spec.geoms:
        geom.density = 0  # the links' masses are the URDF's; MuJoCo would add the shapes'
        geom.contype, geom.conaffinity = ROBOT, GROUND
        geom.friction[0] = friction
        geom.solref[:] = CONTACT
    for name, effort, inertia in zip(robot.joint_names, robot.effort, robot.rotor_inertia, strict=True):
        joint = spec.joint(name)
        joint.armature = inertia
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrllimited, motor.ctrlrange = True, [-effort, effort]


def _up(robot: Robot, link: str) -> Array:
    """(3,) the world's z axis in a link's frame at the nominal pose."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.q_nominal)
    return data.oMf[robot.model.getFrameId(link)].rotation[2]


class Simulation:
    """The robot's state, one `step` at a time.

    Attributes:
        q: (nq,) and v: (nv,) in Pinocchio's convention.  feet: (C, 3) m, world, foot frames.
    """

    def __init__(
        self,
        robot: Robot,
        terrain: Terrain,
        *,
        friction: float = 0.8,
        timestep: float = 1e-3,
        payload: float = 0.0,
        mass_scale: float = 1.0,
    ):
        self.robot = robot
        self.model = build_model(
            robot, terrain, friction=friction, timestep=timestep, payload=payload, mass_scale=mass_scale
        )
        self.data = mujoco.MjData(self.model)
        ids = [self.model.joint(name).id for name in robot.joint_names]
        self._qpos, self._qvel = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self._sites = np.array([self.model.site(name).id for name in robot.foot_names])
        self._foot_of_geom = np.full(self.model.ngeom, -1)
        for g in range(self.model.ngeom):
            name = self.model.geom(g).name.rpartition(":")[0]
            if name in robot.foot_names:
                self._foot_of_geom[g] = robot.foot_names.index(name)
        self._root_body = int(self.model.jnt_bodyid[self.model.joint("root").id])
        self._push_at = robot.model.frames[robot.model.getFrameId(robot.base)].placement.translation

    @property
    def time(self) -> float:
        """s since `reset`."""
        return self.data.time

    @property
    def q(self) -> Array:
        p = self.data.qpos
        return np.concatenate([p[:3], p[[4, 5, 6, 3]], p[self._qpos]])

    @property
    def v(self) -> Array:
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, self.data.qpos[3:7])
        v = self.data.qvel
        return np.concatenate([R.reshape(3, 3).T @ v[:3], v[3:6], v[self._qvel]])

    @property
    def acceleration(self) -> Array:
        """(3,) m/s^2, specific force at the root link's origin in its frame, in the last step."""
        return self.data.sensordata[:3].copy()

    @property
    def feet(self) -> Array:
        return self.data.site_xpos[self._sites].copy()

    def reset(self, q: Array, v: Array | None = None) -> None:
        """Start from q (nq,) and v (nv,), at rest without one."""
        mujoco.mj_resetData(self.model, self.data)
        p = self.data.qpos
        p[:3], p[3:7], p[self._qpos] = q[:3], q[[6, 3, 4, 5]], q[7:]
        if v is not None:
            R = np.empty(9)
            mujoco.mju_quat2Mat(R, p[3:7])
            self.data.qvel[:3], self.data.qvel[3:6] = R.reshape(3, 3) @ v[:3], v[3:6]
            self.data.qvel[self._qvel] = v[6:]
        mujoco.mj_forward(self.model, self.data)

    def push(self, force: Array) -> None:
        """From now on a force (3,) N, world, acts on the trunk at the base's origin."""
        R = self.data.xmat[self._root_body].reshape(3, 3)
        arm = self.data.xpos[self._root_body] + R @ self._push_at - self.data.xipos[self._root_body]
        self.data.xfrc_applied[self._root_body] = np.concatenate([force, np.cross(arm, force)])

    def step(self, tau: Array) -> None:
        """One time step under joint torques tau (nj,) N m; the motors saturate at their limits."""
        self.data.ctrl[:] = tau
        mujoco.mj_step(self.model, self.data)
        # mj_step leaves positions of the step's start in site_xpos; controllers must see where the feet are now.
        mujoco.mj_kinematics(self.model, self.data)

    def contacts(self) -> tuple[Array, bool]:
        """(C, 3) N, world: ground force on each foot in the last step; and whether the body touches the ground."""
        forces, body_down = np.zeros((len(self._sites), 3)), False
        wrench = np.empty(6)
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            first, second = contact.geom  # the force is what the first exerts on the second
            on_second = self.model.geom_bodyid[first] == 0
            link = second if on_second else first
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            foot = self._foot_of_geom[link]
            if foot >= 0:
                forces[foot] += force if on_second else -force
            body_down |= int(self.model.geom_bodyid[link]) == self._root_body
        return forces, body_down
