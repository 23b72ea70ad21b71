"""Parameters of a run on the robot: how it stands up and lies down, and what the supervisor lets pass."""

from dataclasses import dataclass

from slomo.errors import UsageError

HZ = 500  # of commands and states, as in the vendor's examples


@dataclass(frozen=True)
class Config:
    """Parameters of `slomo deploy`; those of the controller are those of `track`.

    Attributes:
        listen: s, of states before anything moves.
        fold: s, from the pose in which the robot lies to a crouch.  rise: s, from there to a stand.
        stand: s, standing before the controller takes over.  blend: s, from the stand's command to the controller's.
        rest: s, after the motion's end, before the feet are set below the hips again.
        lower: s, down to a crouch.  damp: s, of damping before the end.
        stand_kp: N m/rad, stiffness of the motors in standing up and lying down.  stand_kd: N m s/rad, their damping.
        stale: s, age of the newest state from which the robot is damped.
        max_loss: fraction of the states of the last second that may be missing.
        hold: s, for which the last command is repeated when the controller is late; then the robot is damped.
        max_tilt: degrees, of the body.
        min_height: lowest body height over the lowest foot while standing and moving, as a fraction of the least of
            standing height and the motion's lowest.
        beyond_limit: rad, how far a joint may be outside of its limits.
        max_joint_rate: rad/s, of the joint targets.  max_torque_rate: N m/s, of the feed-forward torques.
        max_power: W, mechanical, of all motors, averaged over 0.1 s.
        max_temperature: degrees C, of a motor.  min_battery: %, of its charge.
    """

    listen: float = 0.5
    fold: float = 1.5
    rise: float = 1.5
    stand: float = 0.5
    blend: float = 0.2
    rest: float = 0.5
    lower: float = 1.5
    damp: float = 1.0
    stand_kp: float = 60.0
    stand_kd: float = 3.0
    stale: float = 0.1
    max_loss: float = 0.1
    hold: float = 0.05
    max_tilt: float = 50.0
    min_height: float = 0.5
    beyond_limit: float = 0.02
    max_joint_rate: float = 40.0
    max_torque_rate: float = 10_000.0
    max_power: float = 400.0
    max_temperature: float = 80.0
    min_battery: float = 15.0


def check(config: Config) -> None:
    """Raises `UsageError` for a parameter out of range."""
    positive = (
        "fold", "rise", "blend", "lower", "stand_kp", "stale", "max_loss", "hold", "max_tilt", "max_joint_rate",
        "max_torque_rate", "max_power", "max_temperature",
    )  # fmt: skip
    for name in positive:
        if not getattr(config, name) > 0:
            raise UsageError(f"needs a number above 0, got {getattr(config, name)}", where=f"deploy.{name}")
    for name in ("stand", "rest", "damp", "stand_kd", "min_height", "beyond_limit", "min_battery"):
        if not getattr(config, name) >= 0:
            raise UsageError(f"needs a number of at least 0, got {getattr(config, name)}", where=f"deploy.{name}")
    if config.listen < 0.2:
        raise UsageError(f"needs at least 0.2 s, got {config.listen}", where="deploy.listen")
    if config.stale > 0.1:
        raise UsageError(f"may not be more than 0.1 s, got {config.stale}", where="deploy.stale")
