"""Parameters of `slomo track`, and what they may be."""

from dataclasses import dataclass, replace

import numpy as np

from slomo.errors import UsageError
from slomo.gravity import GRAVITY
from slomo.robot import Robot
from slomo.track.mpc import MODELS, MpcConfig
from slomo.track.planner import PLANNERS

JOINT_HZ = 500
HORIZON = 1.5
STATES = ("estimated", "truth")
LAYERS = ("auto", "ik", "qp")


@dataclass(frozen=True)
class Config(MpcConfig):
    """Parameters of the controller and of its test in simulation; those of the MPC are those of `mpc.MpcConfig`.

    Attributes:
        horizon: how many steps the MPC looks ahead; 0: as many as suit the robot's height, 10 on a Go1.
        controller: "ci-mpc"; for comparison "convex-mpc" (contact schedule of the reference) or "open-loop" (its joint
            angles, by PD), see docs/trials.md.
        state: what the controller knows: "estimated" from joint encoders and IMU, or "truth", for study.
        joint_layer: from plan to joints: "ik" (inverse kinematics, PD and J^T forces), "qp" (a whole-body quadratic
            program) or "auto": the one that does better with that kind of robot, "ik" for a quadruped, "qp" for a
            humanoid.
        mpc_hz: 1/s, a divisor of 500. Two Newton steps a tick converge the sooner the oftener they are made: at 100 Hz
            feet move too late after a push.
        kp: N m/rad, stiffness of the motor PD.
        kd: N m s/rad, its damping.
        lookahead: s, how far ahead of now the joints aim on the plan.
        friction: of the simulated ground; the controller plans with its own `mu`.
        command_delay: s, from a command to the motors.
        settle: s, standing still in the first pose.
        blend: s, gathering the first pose's velocity.
    """

    horizon: int = 0
    controller: str = "ci-mpc"
    state: str = "estimated"
    joint_layer: str = "auto"
    mpc_hz: int = 250
    kp: float = 20.0
    kd: float = 1.0
    lookahead: float = 0.02
    friction: float = 0.8
    command_delay: float = 0.002
    settle: float = 0.3
    blend: float = 0.6


def resolved(config: Config, robot: Robot) -> Config:
    """With a horizon. Tall robots fall more slowly: it lasts `HORIZON` times sqrt(height / g), which is 10 steps of
    25 ms on a Go1."""
    if config.horizon:
        return config
    return replace(config, horizon=round(HORIZON * np.sqrt(robot.standing_height / GRAVITY) / config.dt))


def layer_of(config: Config, kind: str) -> str:
    """ "ik" or "qp" for a robot of that kind: for a quadruped the first, for a humanoid the second, unless chosen."""
    return {"quadruped": "ik", "humanoid": "qp"}[kind] if config.joint_layer == "auto" else config.joint_layer


def check(config: Config) -> None:
    """Raises `UsageError` for a parameter out of range."""
    if config.mpc_hz <= 0 or JOINT_HZ % config.mpc_hz:
        raise UsageError(f"{config.mpc_hz} does not divide {JOINT_HZ}", where="track.mpc_hz", valid=(50, 100, 125, 250))
    choices = (("controller", tuple(PLANNERS)), ("mpc_model", MODELS), ("state", STATES), ("joint_layer", LAYERS))
    for name, valid in choices:
        if getattr(config, name) not in valid:
            raise UsageError(f"{getattr(config, name)!r}", where=f"track.{name}", valid=valid)
    for name in ("dt", "iterations", "mu", "kappa", "kp", "friction", "blend"):
        if not getattr(config, name) > 0:
            raise UsageError(f"needs a number above 0, got {getattr(config, name)}", where=f"track.{name}")
    for name in ("horizon", "kd", "lookahead", "command_delay", "settle"):
        if not getattr(config, name) >= 0:
            raise UsageError(f"needs a number of at least 0, got {getattr(config, name)}", where=f"track.{name}")
