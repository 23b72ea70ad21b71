"""The controller and the simulated robot, each at its rate."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from slomo.motion import Reference, Rollout
from slomo.robot import Robot
from slomo.stage import Progress
from slomo.terrain import Terrain
from slomo.track.config import JOINT_HZ, Config
from slomo.track.controller import Controller
from slomo.track.disturbance import Disturbance
from slomo.track.simulation import Simulation

Array = np.ndarray

MOTOR_HZ = 1000
LARGEST_TILT = 60.0  # degrees
LOWEST = 0.5  # of the height that the body should have


@dataclass(frozen=True)
class Outcome:
    """rollout; `fall`: None or what happened; `torque_ratio`: (T,) largest |torque asked for| / limit at each tick."""

    rollout: Rollout
    fall: str | None
    torque_ratio: Array
    compile_seconds: float = 0.0


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

    The simulation starts at rest in the reference's first pose. Poses and feet in the roll-out are in the reference's
    world, whose ground is the plane of the feet's centres: `foot_radius` below those of the roll-out's q.

    Args:
        reference: without a lead-in.
        terrain: as it was planned; `world`: as it is, by default the same. The disturbance comes on top.
    """
    controller = Controller(robot, reference, terrain=terrain, config=config)
    simulation = Simulation(robot, world or terrain, friction=config.friction, timestep=1 / MOTOR_HZ)
    progress.update(0, "compiling the controller")
    compiling = controller.warm_up()
    reference = controller.reference
    simulation.reset(controller.first_pose)
    t0, t1 = float(reference.t[0]), float(reference.t[-1])
    rows: dict[str, list] = {k: [] for k in ("t", "q", "v", "q_des", "tau", "body", "points", "lam")}
    solves: dict[str, list] = {k: [] for k in ("mpc_t", "mpc_ms", "mpc_status")}
    fall, ratios = None, []
    for k in range(round((t1 - t0) * MOTOR_HZ)):
        t = t0 + k / MOTOR_HZ
        q, v = simulation.q, simulation.v
        controller.observe(q, v)
        tick = k % (MOTOR_HZ // JOINT_HZ) == 0
        if tick:
            before = controller.plan
            command = controller.command(t)
            plan = controller.plan
            if plan is not before and plan is not None:
                for name, x in zip(solves, (t, 1e3 * plan.seconds, plan.status), strict=True):
                    solves[name].append(x)
        asked = command.kp * (command.q - q[7:]) + command.kd * (command.v - v[6:]) + command.tau
        tau = np.clip(asked, -robot.effort, robot.effort)
        if tick:
            q_point, _ = controller.joints.state(q, v)
            forces, body_down = simulation.contacts()
            row = (t, q, v, command.q, tau, q_point[:7], q_point[7:].reshape(-1, 3), forces)
            for name, x in zip(rows, row, strict=True):
                rows[name].append(x)
            ratios.append(np.max(np.abs(asked) / robot.effort))
            fall = _fallen(q_point, _height(reference, terrain, t), terrain, robot.standing_height, body_down)
            if fall:
                fall = f"{fall} at {t:.2f} s"
                break
        simulation.step(tau)
        if k % 50 == 0:
            progress.update((t - t0) / (t1 - t0), f"{t:.1f} of {t1:.1f} s")
    wanted = _at(reference, np.array(rows["t"]))
    rollout = Rollout(
        **{name: np.array(x) for name, x in (rows | solves).items()},
        body_ref=wanted[:, :7],
        points_ref=wanted[:, 7:].reshape(len(wanted), -1, 3),
        point_names=robot.foot_names,
        joint_names=robot.joint_names,
        reference_digest=reference_digest,
    )
    return Outcome(rollout, fall, np.array(ratios), compiling)


def _at(reference: Reference, t: Array) -> Array:
    """(T, 7 + 3 C) configurations at times t (T,): linear between the knots, rotations along arcs, the ends held."""
    x = np.stack([np.interp(t, reference.t, column) for column in reference.q.T], axis=-1)
    turns = Slerp(reference.t, Rotation.from_quat(reference.q[:, 3:7]))
    x[:, 3:7] = turns(np.clip(t, reference.t[0], reference.t[-1])).as_quat()
    return x


def _height(reference: Reference, terrain: Terrain, t: float) -> float:
    """m, of the reference's body over the ground at a time."""
    p = np.array([np.interp(t, reference.t, reference.q[:, i]) for i in range(3)])
    return float(p[2] - terrain.height(p))


def _fallen(q: Array, wanted: float, terrain: Terrain, standing_height: float, body_down: bool) -> str | None:
    """Why this point-foot pose is a fall, if it is one. A reference that lies low (wanted, m) may be followed there."""
    height = float(q[2] - terrain.height(q[:3]))
    tilt = np.degrees(np.arccos(np.clip(1 - 2 * (q[3] ** 2 + q[4] ** 2), -1, 1)))
    if body_down:
        return "the body touches the ground"
    if height < LOWEST * min(standing_height, wanted):
        return f"the body is {height:.2f} m high"
    if tilt > LARGEST_TILT:
        return f"the body tilts by {tilt:.0f} degrees"
    return None
