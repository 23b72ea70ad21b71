"""A creature's motion in the robot's size on a ground that does not move: scale, stances, slide, footprints."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slomo.errors import InvalidData
from slomo.retarget import feet
from slomo.retarget.footprint import Footprint, footprint
from slomo.retarget.soles import RobotBody
from slomo.retarget.subject import Subject
from slomo.retarget.trunk import Trunk
from slomo.stage import Progress

if TYPE_CHECKING:
    from slomo.retarget.stage import Config

Array = np.ndarray
_CLEARANCE = 0.10  # of the leg: a foot lifted more than this swings
_SHORTEST = 0.08  # s, shorter stances and swings are noise
_CREEP = 0.25  # of the leg: a standing foot that creeps further takes a step
_STEP = 0.24  # s, duration of such a step
_FLIGHT = 0.6  # s, longer than any flight phase
_LEVEL = 0.5  # rad, a body tilted less stands as usual
_DRIFT = 0.3  # of the leg: ground that rises and sinks more is worth a word
_ON_ITS_BACK = 2.0  # rad
_AIRBORNE = 0.05  # of the frames: so much time with no foot on the ground is worth a word


@dataclass(frozen=True)
class Walk:
    """Soles on the ground, in the robot's size, T frames.

    Attributes:
        paths: of soles and body.  trunk: leveled.
        lift: (T, S) m over the ground, 0 in stance.  standing: (T, S) bool.  known: (S,) bool, seen at least once.
        pointing: (T, S) rad, world, constant in stance.
        rise: (T,) m, body over its height when it stands.
    """

    paths: Footprint
    trunk: Trunk
    lift: Array
    standing: Array
    known: Array
    pointing: Array
    rise: Array


def grounded(
    subject: Subject, body: RobotBody, config: "Config", stepping: Array, report: dict[str, Any], progress: Progress
) -> Walk:
    """Ground, scale, stances, slide and footprints; every decision goes to `report`, what is not obvious is said.

    Args:
        stepping: (S,) bool, soles on the step; empty without one.

    Raises:
        InvalidData: the trunk lies below the feet.
    """
    dt, origin = 1 / config.rate, subject.trunk.origin
    known = np.any(subject.confidence > 0, axis=0)
    heights = np.where(known, subject.feet[..., 2], 0.0)
    leg = subject.standing or float(np.median(origin[:, 2] - heights[:, known].mean(axis=1)))
    over = feet.lifts(
        heights, known, body.pairs, dt=dt, leg=abs(leg),
        # A body that never moves shows no flight either: the lowest foot is on the ground all the time.
        window=dt if subject.fixed else _FLIGHT,
    )  # fmt: skip
    if over.held.any():
        progress.note(f"held up all the time: {', '.join(np.array(body.soles)[over.held])}")
    trunk = _level(subject.trunk, body, config, stepping, report, progress)
    rise = origin[:, 2] - over.ground
    standing_height = subject.standing or _standing_height(rise, trunk, body, report, progress)
    if standing_height <= 0:
        raise InvalidData("the trunk lies below the feet", where="key points", todo="check that z points up")
    scale = config.scale or body.leg / (subject.leg or standing_height)
    xy, lift, base = scale * subject.feet[..., :2], scale * over.lift, scale * origin[:, :2]
    clearance = _CLEARANCE * body.leg

    # A bridge over a gap says little, and a fast foot that is low is about to land, which is no slide.
    seen = np.where(subject.confidence > 0, 1.0, 0.3) * (known & ~over.held)
    low = np.exp(-((lift / clearance) ** 2)) * seen * feet.slowness(xy, dt=dt)
    drift = feet.slide(xy, low, dt=dt, smoothing=0.15)
    standing = _standing(subject, xy - drift[:, None], lift, over.held | ~known, clearance=clearance, dt=dt)
    drift = drift + feet.slide(xy - drift[:, None], standing.astype(float), dt=dt, smoothing=0.1)
    paths = footprint(xy - drift[:, None], base - drift, trunk, standing, body)
    creep = _CREEP * body.leg
    standing = np.stack(
        [
            feet.split(p, on, dt=dt, tolerance=creep, step=_STEP)
            for p, on in zip(paths.soles.swapaxes(0, 1), standing.T, strict=True)
        ],
        axis=1,
    )
    soles = np.stack([feet.anchor(p, on) for p, on in zip(paths.soles.swapaxes(0, 1), standing.T, strict=True)], axis=1)
    pointing = np.repeat(trunk.heading[:, None], len(known), axis=1) if subject.pointing is None else subject.pointing
    pointing = np.column_stack(
        [feet.anchor(p[:, None], on)[:, 0] for p, on in zip(pointing.T, standing.T, strict=True)]
    )
    lift = np.stack([feet.clear(z, on, least=clearance) for z, on in zip(lift.T, standing.T, strict=True)], axis=1)
    airborne = float(np.mean(~standing[:, known].any(axis=1)))
    report |= {
        "scale": float(scale),
        "standing_height_source": standing_height,
        "stride_scale": float(paths.stride),
        "slide_removed_m": float(np.linalg.norm(np.diff(drift, axis=0), axis=1).sum()),
        "ground_drift_source": float(np.ptp(over.ground)),
        "held_up": [n for n, h in zip(body.soles, over.held, strict=True) if h],
        "airborne_fraction": airborne,
    }
    drifted = report["ground_drift_source"] / standing_height
    if drifted > _DRIFT:
        progress.note(f"the ground under the feet rises and sinks by {drifted:.0%} of the leg: taken for drift")
    if paths.stride < 1:
        progress.note(f"strides shortened to {paths.stride:.0%}: the robot's legs reach no further")
    if airborne > _AIRBORNE:
        progress.note(f"no foot is on the ground during {airborne:.0%} of the time")
    return Walk(
        Footprint(soles, paths.body, paths.stride),
        trunk,
        lift,
        standing,
        known,
        pointing,
        scale * (rise - standing_height),
    )


def _level(
    trunk: Trunk, body: RobotBody, config: "Config", stepping: Array, report: dict[str, Any], progress: Progress
) -> Trunk:
    """Roll and pitch about zero, or about the slope of the step."""
    slope = 0.0
    if stepping.any() and not body.length:
        slope = float(-np.arctan(np.polyfit(body.roots[:, 0], config.step_height * stepping, 1)[0]))
    bias = np.zeros(2)
    if config.level:
        trunk, bias = trunk.leveled(slope=slope)
    if np.median(np.linalg.norm(trunk.tilt, axis=1)) > _ON_ITS_BACK:
        raise InvalidData(
            "the body lies on its back most of the time", where="key points",
            todo="check that left and right are not exchanged and that z points up",
        )  # fmt: skip
    report["leveled_rad"] = bias.tolist()
    report["tilt_rad"] = np.abs(trunk.tilt).max(axis=0).tolist()
    if np.linalg.norm(bias) > 0.02:
        progress.note(f"leveled by {np.degrees(bias[0]):+.0f} degrees of roll and {np.degrees(bias[1]):+.0f} of pitch")
    return trunk


def _standing_height(rise: Array, trunk: Trunk, body: RobotBody, report: dict[str, Any], progress: Progress) -> float:
    """m in the creature's size: the median while the body is level, or half of it that the trunk is long."""
    level = np.linalg.norm(trunk.tilt, axis=1) < _LEVEL
    if level.mean() < 0.1:
        progress.note("the body is never level: the median height of its middle counts as standing")
    return float(np.median(rise[level] if level.mean() >= 0.1 else rise))


def _standing(subject: Subject, xy: Array, lift: Array, never: Array, *, clearance: float, dt: float) -> Array:
    """(T, S) bool: the given contact probabilities where there are any, else low and slow feet."""
    speed = np.linalg.norm(np.gradient(xy, dt, axis=0), axis=2)
    standing = feet.stance(lift, speed, dt=dt, clearance=clearance, shortest=_SHORTEST) & ~never
    standing = np.where(np.isnan(subject.stands), standing, subject.stands > 0.5)
    return feet.settled(standing, dt=dt, shortest=_SHORTEST)
