"""Track: the whole robot follows the reference in simulation, under model-predictive control."""

import hashlib
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from slomo.errors import MissingInput, UsageError
from slomo.motion import Reference
from slomo.robot import Robot
from slomo.stage import Arrays, Artifact, Inputs, Progress
from slomo.terrain import Terrain
from slomo.track import config as controller
from slomo.track import metrics
from slomo.track.config import layer_of, resolved
from slomo.track.cyclic import repeated
from slomo.track.disturbance import Disturbance, Push
from slomo.track.loop import simulate

VERSION = 7


@dataclass(frozen=True)
class Config(controller.Config):
    """Parameters of `slomo track --sim`: those of the controller, and how the world differs from the planned one.

    Attributes:
        seconds: how long a cyclic motion goes on; 0: as long as the reference is.
        payload: kg, on the trunk.
        push: each "N s @ s , degrees" (see `disturbance.Push`).
        latency: s, more delay from commands to motors.
        step_height: m, by how much the boxes of the ground are higher than planned.
        sensor_seed: of the sensors' biases and noise.
    """

    seconds: float = 0.0
    payload: float = 0.0
    push: tuple[str, ...] = ()
    latency: float = 0.0
    step_height: float = 0.0
    sensor_seed: int = 0

    def disturbance(self) -> Disturbance:
        """What the world does to the robot. Raises `UsageError`."""
        for name in ("seconds", "payload", "latency"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"needs a number of at least 0, got {getattr(self, name)}", where=f"track.{name}")
        return Disturbance(
            payload=self.payload,
            pushes=tuple(map(Push.parse, self.push)),
            latency=self.latency,
            step_height=self.step_height,
            seed=self.sensor_seed,
        )


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`rollout.npz`, `metrics.json` and `terrain.json` from the reference and terrain of `optimize`.

    The terrain is that of the simulation: the planned one, or the user's file ("world"), with the disturbances.

    The roll-out enters the motion from a stand before t = 0 (see `lead_in`); the metrics are of t >= 0. A fall ends it,
    and is the artifact's failure.

    Raises:
        UsageError: a parameter out of range.
        MissingInput: the reference was made for another robot.
    """
    controller.check(config)
    disturbance = config.disturbance()
    robot = inputs.robot
    assert robot is not None
    upstream = inputs.artifacts["optimize"]
    reference = Reference.from_arrays(upstream.npz["reference.npz"])
    terrain = Terrain.from_json(upstream.json["terrain.json"])
    check_robot(reference, robot)
    world = Terrain.load(inputs.files["world"]) if "world" in inputs.files else terrain
    if config.seconds:
        reference = repeated(reference, config.seconds)
    for note in robot.notes:
        progress.note(f"{robot.name}: {note}")

    start = perf_counter()
    outcome = simulate(
        robot,
        reference,
        terrain=terrain,
        config=config,
        disturbance=disturbance,
        world=world,
        progress=progress,
        reference_digest=reference_digest(upstream.npz["reference.npz"]),
    )
    rollout = outcome.rollout
    report = {
        "fell": outcome.fall is not None,
        **metrics.errors(rollout),
        **metrics.estimate(rollout),
        **metrics.joints(rollout, robot, torque_ratio=outcome.torque_ratio, lookahead=config.lookahead),
        **metrics.contact_timing(rollout, outcome.reference),
        **metrics.solver(rollout, period=1 / config.mpc_hz),
        "state": config.state,
        "fall": outcome.fall,
        "simulated_seconds": float(rollout.t[-1] - rollout.t[0]),
        "wall_seconds": perf_counter() - start,
        "compile_seconds": outcome.compile_seconds,
        "method": _method(config, robot),
    }
    return Artifact(
        npz={"rollout.npz": rollout.to_arrays()},
        json={"metrics.json": report, "terrain.json": disturbance.ground(world).to_json()},
        failure=f"{robot.name} fell: {outcome.fall}" if outcome.fall else None,
    )


def _method(config: Config, robot: Robot) -> str:
    """In words, what ran."""
    layers = {"ik": "inverse kinematics + PD + J^T forces", "qp": "whole-body QP + PD"}
    planner = f"{config.controller} (H = {resolved(config, robot).horizon}, {config.mpc_hz} Hz)"
    return f"{planner}, {layers[layer_of(config, robot.kind)]}, {config.state} state, MuJoCo"


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
