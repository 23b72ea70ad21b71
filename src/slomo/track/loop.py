"""The controller and the simulated robot, each at its rate."""

from dataclasses import dataclass, replace

import numpy as np

from slomo.motion import Reference, Rollout
from slomo.robot import Robot
from slomo.stage import Progress
from slomo.terrain import Terrain
from slomo.track.actuators import Motors
from slomo.track.config import JOINT_HZ, Config
from slomo.track.controller import Controller
from slomo.track.disturbance import Disturbance
from slomo.track.joint_space import JointSpace
from slomo.track.plan import PlanPoint
from slomo.track.posture import standing_pose
from slomo.track.recording import Recording, reference_at
from slomo.track.sensors import SensorSample, SimulatedSensors
from slomo.track.simulation import Simulation

Array = np.ndarray

MOTOR_HZ = 1000
# s, standing before the controller begins: until the robot is still, and then, while the estimator is at work already.
STAND, REST = 0.5, 0.5
LARGEST_TILT = 60.0  # degrees
BEYOND = 30.0  # degrees over the tilt that the reference has, where it rears or bends that far itself
LOWEST = 0.5  # of the height that the body should have


@dataclass(frozen=True)
class Outcome:
    """How it went.

    Attributes:
        rollout, reference: what happened, and what was to happen, with the lead-in.
        fall: None or what happened.
        torque_ratio: (T,) largest |torque asked for| / limit at each tick.
        compile_seconds: s, before the first tick.
    """

    rollout: Rollout
    reference: Reference
    fall: str | None
    torque_ratio: Array
    compile_seconds: float


def simulate(
    robot: Robot,
    reference: Reference,
    *,
    terrain: Terrain,
    config: Config,
    disturbance: Disturbance,
    progress: Progress,
    world: Terrain | None = None,
    reference_digest: str = "",
) -> Outcome:
    """Follow the reference in MuJoCo from the lead-in's first time to the end, or until the robot falls.

    The robot stands in the reference's first pose, on the ground as it is, before the controller begins. Poses and feet
    in the roll-out are in the reference's world, whose ground is the plane of the feet's centres: `foot_radius` below
    those of the roll-out's q.

    Args:
        reference: without a lead-in.
        terrain: as it was planned; `world`: as it is, by default the same. The disturbance comes on top.
    """
    controller = Controller(robot, reference, terrain=terrain, config=config)
    ground = disturbance.ground(world or terrain)
    simulation = Simulation(
        robot,
        ground,
        friction=config.friction * disturbance.friction_scale,
        timestep=1 / MOTOR_HZ,
        payload=disturbance.payload,
        mass_scale=disturbance.mass_scale,
    )
    progress.update(0, "compiling the controller")
    compiling = controller.warm_up()
    reference, estimated = controller.reference, config.state == "estimated"
    motors = Motors(robot, delay=config.command_delay + disturbance.latency)
    sensors = SimulatedSensors(len(robot.joint_names), seed=disturbance.seed)
    encoder = sensors.q_bias if estimated else 0.0
    tau = _stand(simulation, controller, ground, sensors if estimated else None)
    t0, t1 = float(reference.t[0]), float(reference.t[-1])
    steps, every = round((t1 - t0) * MOTOR_HZ), MOTOR_HZ // JOINT_HZ
    recording = Recording(robot, reference, ticks=-(-steps // every))
    joints, fall = JointSpace(robot), None
    bodies = reference_at(reference, t0 + np.arange(recording.ticks) / JOINT_HZ)[:, :7]
    wanted, wanted_tilt = bodies[:, 2] - terrain.height(bodies), _tilt(bodies)
    for k in range(steps):
        t = t0 + k / MOTOR_HZ
        q, v = simulation.q, simulation.v
        if not estimated:
            controller.observe(q, v)
        else:
            sample = sensors.read(SensorSample(t, q[7:], v[6:], tau, v[3:6], simulation.acceleration))
            controller.sense(sample)
        tick = k % every == 0
        if tick:
            command = controller.command(t)
            motors.send(t, command)
        asked = motors.asked(t, q[7:] + encoder, v[6:])
        tau = motors.limited(asked, v[6:])
        if tick:
            q_point, _ = joints.state(q, v)
            forces, body_down = simulation.contacts()
            recording.add(
                controller, t=t, q=q, v=v, q_des=command.q, tau=tau, asked=asked, body=q_point[:7],
                points=q_point[7:].reshape(-1, 3), lam=forces,
            )  # fmt: skip
            fall = _fallen(q_point, wanted[k // every], wanted_tilt[k // every], ground, robot, body_down)
            if fall:
                fall = f"{fall} at {t:.2f} s"
                break
        if disturbance.pushes:
            simulation.push(disturbance.force(t))
        simulation.step(tau)
        if k % 50 == 0:
            progress.update((t - t0) / (t1 - t0), f"{t:.1f} of {t1:.1f} s")
    return Outcome(recording.rollout(reference_digest), reference, fall, recording.torque_ratio, compiling)


def _stand(simulation: Simulation, controller: Controller, ground: Terrain, sensors: SimulatedSensors | None) -> Array:
    """Let the robot stand in the reference's first pose under stiff motors; returns their last torques (nj,) N m.

    Where the ground is not as planned, each foot is as much higher, and the body by their mean. With sensors the
    controller is started, and senses on until its reference begins.
    """
    robot, reference, terrain = simulation.robot, controller.reference, controller.terrain
    q = reference.q[0].copy()
    higher = ground.height(reference.points[0]) - terrain.height(reference.points[0])
    q[9::3] += higher
    q[2] += higher[robot.feet].mean()
    # Four times the effort a radian: a few millimetres of sag in any robot. Two ankles that keep a tall one from
    # tipping over have to be stiffer than its weight times its height.
    stiff, damped = (12, 0.25) if robot.kind == "humanoid" else (4, 0.13)
    joints = JointSpace(robot, kp=stiff * robot.effort, kd=damped * robot.effort)
    pose = standing_pose(robot, q)
    zero = np.zeros_like(reference.points[0])
    point = PlanPoint(q[:3], q[3:7], np.zeros(3), np.zeros(3), q[7:].reshape(-1, 3), zero, zero, zero)
    command = joints.command(point, point, u=reference.u[0].reshape(-1, 3), q=pose, v=np.zeros(robot.model.nv))
    command = replace(command, q=pose[7:])
    motors = Motors(robot)
    motors.send(0.0, command)
    simulation.reset(pose)
    tau = command.tau
    first, last = round(STAND * MOTOR_HZ), round((STAND + REST) * MOTOR_HZ)
    for k in range(last):
        q, v = simulation.q[7:], simulation.v
        if sensors and k >= first:
            t = float(reference.t[0]) - (last - k) / MOTOR_HZ
            sample = sensors.read(SensorSample(t, q, v[6:], tau, v[3:6], simulation.acceleration))
            controller.start(sample) if k == first else controller.sense(sample)
        tau = motors.limited(motors.asked(0.0, q, v[6:]), v[6:])
        simulation.step(tau)
    return tau


def _fallen(q: Array, wanted: float, wanted_tilt: float, ground: Terrain, robot: Robot, body_down: bool) -> str | None:
    """Why this point-foot pose is a fall, if it is one. A reference that lies low (wanted, m) or whose body tilts far
    (wanted_tilt, degrees) may be followed there."""
    height, tilt = float(q[2] - ground.height(q[:3])), float(_tilt(q))
    if body_down:
        return "the body touches the ground"
    if height < LOWEST * min(robot.standing_height, wanted):
        return f"the body is {height:.2f} m high"
    if tilt > max(LARGEST_TILT, wanted_tilt + BEYOND):
        return f"the body tilts by {tilt:.0f} degrees"
    return None


def _tilt(q: Array) -> Array:
    """(...,) degrees between the vertical and that of bodies with point-foot configurations q (..., 7 and more)."""
    return np.degrees(np.arccos(np.clip(1 - 2 * (q[..., 3] ** 2 + q[..., 4] ** 2), -1, 1)))
