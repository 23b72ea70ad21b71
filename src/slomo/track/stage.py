"""Track: the whole robot follows the reference in simulation, under model-predictive control."""

import hashlib
from time import perf_counter

import numpy as np

from slomo.errors import MissingInput
from slomo.motion import Reference
from slomo.robot import Robot
from slomo.stage import Arrays, Artifact, Inputs, Progress
from slomo.terrain import Terrain
from slomo.track import metrics
from slomo.track.config import Config, check
from slomo.track.disturbance import Disturbance
from slomo.track.loop import simulate

VERSION = 1


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`rollout.npz` and `metrics.json` from the reference and terrain of `optimize`.

    The roll-out enters the motion from a stand before t = 0 (see `lead_in`); the metrics are of t >= 0. A fall ends it,
    and is the artifact's failure.

    Raises:
        UsageError: a parameter out of range.
        MissingInput: the reference was made for another robot.
    """
    check(config)
    robot = inputs.robot
    assert robot is not None
    upstream = inputs.artifacts["optimize"]
    reference = Reference.from_arrays(upstream.npz["reference.npz"])
    terrain = Terrain.from_json(upstream.json["terrain.json"])
    check_robot(reference, robot)
    for note in robot.notes:
        progress.note(f"{robot.name}: {note}")

    start = perf_counter()
    outcome = simulate(
        robot,
        reference,
        terrain=terrain,
        config=config,
        disturbance=Disturbance(),
        progress=progress,
        reference_digest=reference_digest(upstream.npz["reference.npz"]),
    )
    rollout = outcome.rollout
    report = {
        "fell": outcome.fall is not None,
        **metrics.errors(rollout),
        **metrics.estimate(rollout),
        **metrics.solver(rollout, period=1 / config.mpc_hz),
        "state": config.state,
        "fall": outcome.fall,
        "torque_ratio_p99": float(np.percentile(outcome.torque_ratio, 99)),
        "simulated_seconds": float(rollout.t[-1] - rollout.t[0]),
        "wall_seconds": perf_counter() - start,
        "compile_seconds": outcome.compile_seconds,
        "method": f"MPC (H = {config.horizon}, {config.mpc_hz} Hz), inverse kinematics + PD + J^T forces, MuJoCo",
    }
    return Artifact(
        npz={"rollout.npz": rollout.to_arrays()},
        json={"metrics.json": report},
        failure=f"{robot.name} fell: {outcome.fall}" if outcome.fall else None,
    )


def reference_digest(arrays: Arrays) -> str:
    """SHA-256 of arrays by name, dtype, shape and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        x = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {x.dtype.str} {x.shape} ".encode() + x.tobytes())
    return digest.hexdigest()


def check_robot(reference: Reference, robot: Robot) -> None:
    """Raises `MissingInput` where the reference is not the robot's."""
    if reference.robot_digest != robot.digest or reference.point_names != robot.foot_names:
        raise MissingInput(
            f"the reference was made for another robot (or another version of it) than {robot.name}",
            where="reference.npz",
            todo=f"run: slomo optimize --robot {robot.name}",
        )
