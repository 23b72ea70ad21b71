"""One randomised trial: what happens to the robot in it, and how it ends.

A trial is named `row/number`. What happens follows from the seed, the row and the number alone, so that any trial can
be done again without the others.
"""

from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from slomo.errors import UsageError
from slomo.motion import Reference
from slomo.robot import Robot
from slomo.stage import Progress
from slomo.terrain import Box, Terrain
from slomo.track import metrics
from slomo.track.config import Config
from slomo.track.disturbance import Disturbance, Push
from slomo.track.loop import Outcome, simulate

Array = np.ndarray

AFTER = 1.0  # s of motion that are left after a push begins, so that a fall is seen
MASS, FRICTION, STEP, LATENCY, PUSH = 0.2, 0.6, 0.02, 0.01, 18.0  # full size; "all" has half of each
BLOCK = 0.15  # m, half the side of the block that stands for a step where the plan knows none
ROWS = {
    "none": "sensor noise only",
    "push-12": "push of 12 N s",
    "push-18": "push of 18 N s",
    "mass": "mass +-20 %",
    "friction": "friction x0.6",
    "step": "step +-2 cm",
    "latency": "10 ms more latency",
    "all": "all at once, half size",
}


@dataclass(frozen=True)
class World:
    """The disturbance of one trial, and the ground that is really there."""

    disturbance: Disturbance
    ground: Terrain


@dataclass(frozen=True)
class Result:
    """How one trial ended.

    Attributes:
        controller, row, number: which one it was.
        fall: None or what happened.
        end: s, time of the motion at which it ended.
        body_rmse, foot_rmse: m.  orientation_rmse: degrees.  None where it fell before the motion began.
        mpc_ms_p50, mpc_ms_p99: of its solves, wall time.
        about: what was done to the robot.
    """

    controller: str
    row: str
    number: int
    fall: str | None
    end: float
    body_rmse: float | None
    foot_rmse: float | None
    orientation_rmse: float | None
    mpc_ms_p50: float
    mpc_ms_p99: float
    about: str


def parse_trial(text: str) -> tuple[str, int]:
    """(row, number) of "push-12/7". Raises `UsageError`."""
    row, _, number = text.partition("/")
    if row not in ROWS or not number.isdecimal():
        raise UsageError(f"no trial {text!r}", where="--replay", valid=ROWS, todo="name one as row/number: push-12/7")
    return row, int(number)


def make_world(row: str, number: int, *, seed: int, reference: Reference, terrain: Terrain) -> World | None:
    """What a trial of `row` (of `ROWS`) does; None where this motion leaves no place for it.

    Args:
        seed: of all trials.  reference: without lead-in.  terrain: as planned.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, crc32(row.encode()), number]))
    noise, sign, angle, when = int(rng.integers(2**31)), rng.choice([-1.0, 1.0], 2), rng.uniform(0, 360), rng.uniform()
    last = float(reference.t[-1])
    d = Disturbance(seed=noise)
    ground = terrain
    size = 0.5 if row == "all" else 1.0
    if row in ("push-12", "push-18", "all"):
        impulse = 12.0 if row == "push-12" else size * PUSH
        d = replace(d, pushes=(Push(impulse, when * max(last - AFTER, last / 2), angle),))
    if row in ("mass", "all"):
        d = replace(d, mass_scale=1.0 + size * MASS * sign[0])
    if row in ("friction", "all"):
        d = replace(d, friction_scale=1.0 - size * (1.0 - FRICTION))
    if row in ("latency", "all"):
        d = replace(d, latency=size * LATENCY)
    if row in ("step", "all"):
        if terrain.boxes:
            d = replace(d, step_height=size * STEP * sign[1])
        elif (block := _block(rng, reference, size * STEP)) is not None:
            ground = replace(terrain, boxes=(block,))
        elif row == "step":
            return None
    return World(d, ground)


def _block(rng: np.random.Generator, reference: Reference, height: float) -> Box | None:
    """A block that the plan does not know of, where a foot lands later; None where all feet stay in their places."""
    start = reference.points[0, :, :2]
    landed = np.linalg.norm(reference.v[1:, 6:].reshape(len(reference.h), -1, 3), axis=-1) < 0.05
    places = reference.points[1:, :, :2][landed]
    off = np.abs(places[:, None] - start).max(axis=-1).min(axis=1)
    places = places[off > BLOCK + 0.03]  # a foot that stands on its edge at the start would be stuck in it
    if not len(places):
        return None
    x, y = places[rng.integers(len(places))]
    return Box(float(x) - BLOCK, float(x) + BLOCK, float(y) - BLOCK, float(y) + BLOCK, height)


def describe(world: World, planned: Terrain) -> str:
    """One line on what a trial does to the robot."""
    d = world.disturbance
    parts = [f"push of {p.impulse:g} N s at {p.time:.2f} s towards {p.direction:.0f} degrees" for p in d.pushes]
    parts += [f"mass x{d.mass_scale:g}"] if d.mass_scale != 1 else []
    parts += [f"friction x{d.friction_scale:g}"] if d.friction_scale != 1 else []
    parts += [f"{1e3 * d.latency:g} ms more latency"] if d.latency else []
    parts += [f"step {1e3 * d.step_height:+.0f} mm"] if d.step_height else []
    if world.ground != planned:
        b = world.ground.boxes[-1]
        parts += [f"block of {1e3 * b.height:.0f} mm at ({b.x_min + BLOCK:.2f}, {b.y_min + BLOCK:.2f}) m"]
    return ", ".join(parts) or "sensor noise only"


def run_trial(
    row: str,
    number: int,
    *,
    seed: int,
    robot: Robot,
    reference: Reference,
    terrain: Terrain,
    config: Config,
    progress: Progress,
    reference_digest: str = "",
) -> tuple[Result, Outcome] | None:
    """Simulate one trial; None where there is none (see `make_world`)."""
    world = make_world(row, number, seed=seed, reference=reference, terrain=terrain)
    if world is None:
        return None
    outcome = simulate(
        robot, reference, terrain=terrain, config=config, disturbance=world.disturbance, progress=progress,
        world=world.ground, reference_digest=reference_digest,
    )  # fmt: skip
    times = metrics.solver(outcome.rollout, period=1 / config.mpc_hz)
    result = Result(
        controller=config.controller, row=row, number=number, fall=outcome.fall, end=float(outcome.rollout.t[-1]),
        **metrics.errors(outcome.rollout), mpc_ms_p50=times["mpc_ms_p50"], mpc_ms_p99=times["mpc_ms_p99"],
        about=describe(world, terrain),
    )  # fmt: skip
    return result, outcome
