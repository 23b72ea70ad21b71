"""The control loop: MPC, inverse kinematics, motor PD and the simulated robot, each at its rate."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from slomo.motion import Reference, Rollout
from slomo.stage import Progress
from slomo.terrain import Terrain
from slomo.track.joint_space import JointSpace
from slomo.track.mpc import Mpc
from slomo.track.simulation import Simulation

Array = np.ndarray

MOTOR_HZ = 1000
JOINT_HZ = 500
LARGEST_TILT = 60.0  # degrees
LOWEST = 0.5  # of the height that the body should have


@dataclass(frozen=True)
class Gains:
    """Motor PD.

    Attributes:
        kp: N m/rad.  kd: N m s/rad.
        lookahead: s, how far ahead of now the joints aim on the plan.
    """

    kp: float
    kd: float
    lookahead: float


@dataclass(frozen=True)
class Outcome:
    """rollout; `fall`: None or what happened; `torque_ratio`: (T,) largest |torque asked for| / limit at each tick."""

    rollout: Rollout
    fall: str | None
    torque_ratio: Array


def run_loop(
    simulation: Simulation,
    mpc: Mpc,
    *,
    terrain: Terrain,
    gains: Gains,
    mpc_hz: int,
    progress: Progress,
    reference_digest: str = "",
) -> Outcome:
    """Follow the MPC's reference from its first time to its last, or until the robot falls.

    The simulation starts at rest in the reference's first pose. Poses and feet in the roll-out are in the reference's
    world, whose ground is the plane of the feet's centres: `foot_radius` below those of the roll-out's q.
    """
    robot = simulation.robot
    joints, reference = JointSpace(robot), mpc.reference
    simulation.reset(joints.pose(reference.q[0]))
    t0, t1 = float(reference.t[0]), float(reference.t[-1])
    rows: dict[str, list] = {k: [] for k in ("t", "q", "v", "q_des", "tau", "body", "points", "lam")}
    solves: dict[str, list] = {k: [] for k in ("mpc_t", "mpc_ms", "mpc_status")}
    fall, ratios = None, []
    for k in range(round((t1 - t0) * MOTOR_HZ)):
        t = t0 + k / MOTOR_HZ
        q, v = simulation.q, simulation.v
        tick = k % (MOTOR_HZ // JOINT_HZ) == 0
        if tick:
            q_point, v_point = joints.state(q, v)
            if k % (MOTOR_HZ // mpc_hz) == 0:
                plan = mpc.step(t, q_point, v_point)
                for name, x in zip(solves, (t, 1e3 * plan.seconds, plan.status), strict=True):
                    solves[name].append(x)
            u = plan.feedback(t, q_point, v_point)
            command = joints.command(plan.at(t + gains.lookahead), u=u, q=q)
        asked = gains.kp * (command.q - q[7:]) + gains.kd * (command.v - v[6:]) + command.tau
        tau = np.clip(asked, -robot.effort, robot.effort)
        if tick:
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
    return Outcome(rollout, fall, np.array(ratios))


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
