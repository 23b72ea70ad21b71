"""Track: the whole robot follows the reference in simulation, under model-predictive control."""

import hashlib
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from slomo.errors import MissingInput, UsageError
from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.stage import Arrays, Artifact, Inputs, Progress
from slomo.terrain import Terrain
from slomo.track import metrics
from slomo.track.lead_in import with_lead_in
from slomo.track.loop import JOINT_HZ, MOTOR_HZ, Gains, run_loop
from slomo.track.mpc import Mpc, MpcConfig
from slomo.track.simulation import Simulation

VERSION = 1


@dataclass(frozen=True)
class Config(MpcConfig):
    """Parameters of `slomo track --sim`; those of the controller are those of `mpc.MpcConfig`.

    Attributes:
        mpc_hz: 1/s, a divisor of 500.
        kp: N m/rad, stiffness of the motor PD.
        kd: N m s/rad, its damping.
        lookahead: s, how far ahead of now the joints aim on the plan.
        friction: of the simulated ground; the controller plans with its own `mu`.
        settle: s, standing still in the first pose.
        blend: s, gathering the first pose's velocity.
    """

    mpc_hz: int = 100
    kp: float = 20.0
    kd: float = 1.0
    lookahead: float = 0.02
    friction: float = 0.8
    settle: float = 0.3
    blend: float = 0.6


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`rollout.npz` and `metrics.json` from the reference and terrain of `optimize`.

    The roll-out enters the motion from a stand before t = 0 (see `lead_in`); the metrics are of t >= 0. A fall ends it,
    and is the artifact's failure.

    Raises:
        UsageError: a parameter out of range.
        MissingInput: the reference was made for another robot.
    """
    _check(config)
    robot = inputs.robot
    assert robot is not None
    upstream = inputs.artifacts["optimize"]
    reference = Reference.from_arrays(upstream.npz["reference.npz"])
    terrain = Terrain.from_json(upstream.json["terrain.json"])
    _check_robot(reference, robot)
    for note in robot.notes:
        progress.note(f"{robot.name}: {note}")

    model = PointFootModel.from_robot(robot, mu=config.mu)
    whole = with_lead_in(reference, model, terrain=terrain, settle=config.settle, blend=config.blend)
    mpc = Mpc(model, whole, terrain=terrain, config=config)
    progress.update(0, "compiling the controller")
    compiling = mpc.warm_up()
    start = perf_counter()
    outcome = run_loop(
        Simulation(robot, terrain, friction=config.friction, timestep=1 / MOTOR_HZ),
        mpc,
        terrain=terrain,
        gains=Gains(config.kp, config.kd, config.lookahead),
        mpc_hz=config.mpc_hz,
        progress=progress,
        reference_digest=_digest(upstream.npz["reference.npz"]),
    )
    rollout = outcome.rollout
    report = {
        "fell": outcome.fall is not None,
        **metrics.errors(rollout),
        **metrics.solver(rollout, period=1 / config.mpc_hz),
        "state": "truth",
        "fall": outcome.fall,
        "torque_ratio_p99": float(np.percentile(outcome.torque_ratio, 99)),
        "simulated_seconds": float(rollout.t[-1] - rollout.t[0]),
        "wall_seconds": perf_counter() - start,
        "compile_seconds": compiling,
        "method": f"MPC (H = {config.horizon}, {config.mpc_hz} Hz), inverse kinematics + PD + J^T forces, MuJoCo",
    }
    return Artifact(
        npz={"rollout.npz": rollout.to_arrays()},
        json={"metrics.json": report},
        failure=f"{robot.name} fell: {outcome.fall}" if outcome.fall else None,
    )


def _digest(arrays: Arrays) -> str:
    """SHA-256 of arrays by name, dtype, shape and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        x = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {x.dtype.str} {x.shape} ".encode() + x.tobytes())
    return digest.hexdigest()


def _check(config: Config) -> None:
    if config.mpc_hz <= 0 or JOINT_HZ % config.mpc_hz:
        raise UsageError(f"{config.mpc_hz} does not divide {JOINT_HZ}", where="track.mpc_hz", valid=(50, 100, 125, 250))
    for name in ("horizon", "dt", "iterations", "mu", "kappa", "kp", "friction", "blend"):
        if not getattr(config, name) > 0:
            raise UsageError(f"needs a number above 0, got {getattr(config, name)}", where=f"track.{name}")
    for name in ("kd", "lookahead", "settle"):
        if not getattr(config, name) >= 0:
            raise UsageError(f"needs a number of at least 0, got {getattr(config, name)}", where=f"track.{name}")


def _check_robot(reference: Reference, robot: Robot) -> None:
    if reference.robot_digest != robot.digest or reference.point_names != robot.foot_names:
        raise MissingInput(
            f"the reference was made for another robot (or another version of it) than {robot.name}",
            where="reference.npz",
            todo=f"run: slomo optimize --robot {robot.name}",
        )
