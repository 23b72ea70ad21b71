"""How well a roll-out followed its reference, in numbers."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference, Rollout
from slomo.robot import Robot

Array = np.ndarray

STANDING = 1.0  # N, vertical force from which a foot stands
NEAR = 0.1  # s
BOUNCE = 0.02  # s


def errors(rollout: Rollout) -> dict[str, float | None]:
    """Root-mean-square errors over t >= 0: `body_rmse`, `foot_rmse` (m), `orientation_rmse` (degrees).

    Position errors are distances in space; feet are taken together. None if it ended before t = 0.
    """
    on = rollout.t >= 0
    if not on.any():
        return dict.fromkeys(("body_rmse", "foot_rmse", "orientation_rmse"))
    body = rollout.body[on, :3] - rollout.body_ref[on, :3]
    feet = rollout.points[on] - rollout.points_ref[on]
    turn = Rotation.from_quat(rollout.body_ref[on, 3:]).inv() * Rotation.from_quat(rollout.body[on, 3:])
    return {
        "body_rmse": _rms(np.linalg.norm(body, axis=-1)),
        "foot_rmse": _rms(np.linalg.norm(feet, axis=-1)),
        "orientation_rmse": float(np.degrees(_rms(turn.magnitude()))),
    }


def estimate(rollout: Rollout) -> dict[str, float | None]:
    """How far the controller's idea of the body was from the truth, over t >= 0.

    `estimate_rmse`: m, of position.  `estimate_end`: m, at the end, which is the drift.  `estimate_height_rmse`: m, of
    its vertical part.  `estimate_tilt_rmse`, `estimate_heading_rmse`: degrees.
    """
    on = rollout.t >= 0
    names = ("rmse", "end", "height_rmse", "tilt_rmse", "heading_rmse")
    if not on.any():
        return {f"estimate_{name}": None for name in names}
    off = rollout.body_est[on, :3] - rollout.body[on, :3]
    distance = np.linalg.norm(off, axis=-1)
    turn = Rotation.from_quat(rollout.body_est[on, 3:]) * Rotation.from_quat(rollout.body[on, 3:]).inv()
    w = np.degrees(turn.as_rotvec())  # world axes
    tilt = np.linalg.norm(w[:, :2], axis=-1)
    values = (_rms(distance), float(distance[-1]), _rms(off[:, 2]), _rms(tilt), _rms(w[:, 2]))
    return {f"estimate_{name}": x for name, x in zip(names, values, strict=True)}


def joints(rollout: Rollout, robot: Robot, *, torque_ratio: Array, lookahead: float) -> dict[str, float]:
    """How well joints followed and how hard they worked.

    `joint_rmse`: rad, of the angles from the targets, which are for `lookahead` (s) later.  `torque_ratio_p50`, `_p99`:
    of the largest torque asked for, over its limit (torque_ratio (T,)).  `torque_saturated`: share of ticks at which
    some motor was asked for more than its effort limit.  `speed_ratio_max`: largest joint speed over its limit.
    `power_mean`: W, mechanical, what goes in and what brakes alike.
    """
    n = round(lookahead / (rollout.t[1] - rollout.t[0])) if len(rollout.t) > 1 else 0
    n = min(n, len(rollout.t) - 1)
    speeds = np.abs(rollout.v[:, 6:])
    return {
        "joint_rmse": _rms(rollout.q_des[: len(rollout.t) - n] - rollout.q[n:, 7:]),
        "torque_ratio_p50": float(np.percentile(torque_ratio, 50)),
        "torque_ratio_p99": float(np.percentile(torque_ratio, 99)),
        "torque_saturated": float(np.mean(torque_ratio > 1)),
        "speed_ratio_max": float(np.max(speeds / robot.velocity)),
        "power_mean": float(np.sum(np.abs(rollout.tau) * speeds, axis=1).mean()),
    }


def contact_timing(rollout: Rollout, reference: Reference) -> dict[str, float | int | None]:
    """How well touchdowns and lift-offs keep the reference's times, over t >= 0.

    `contact_agreement`: share of time and feet in which both stand or neither does.  `contact_events`: touchdowns and
    lift-offs of the reference;  `contact_events_missed`: those that the robot does not have within `NEAR` s;
    `contact_timing_error`: s, mean of how much earlier or later it has the others.
    """
    on = rollout.t >= 0
    t = rollout.t[on]
    step = np.clip(np.searchsorted(reference.t, t, side="right") - 1, 0, len(reference.h) - 1)
    planned, real = reference.lam[step, :, 2] > STANDING, rollout.lam[on, :, 2] > STANDING
    errors, missed = [], 0
    for c in range(real.shape[1]):
        seen = _events(t, real[:, c])
        for when, lands in _events(t, planned[:, c]):
            off = [abs(when - at) for at, landed in seen if landed == lands]
            if off and min(off) <= NEAR:
                errors.append(min(off))
            else:
                missed += 1
    return {
        "contact_agreement": float(np.mean(planned == real)) if len(t) else None,
        "contact_events": len(errors) + missed,
        "contact_events_missed": missed,
        "contact_timing_error": float(np.mean(errors)) if errors else None,
    }


def _events(t: Array, stands: Array) -> list[tuple[float, bool]]:
    """Times at which a foot's state (T,) changes, and to what; states that last less than `BOUNCE` are no changes."""
    edges = np.flatnonzero(np.diff(stands)) + 1
    out: list[tuple[float, bool]] = []
    for k, i in enumerate(edges):
        lasts = k + 1 == len(edges) or t[edges[k + 1]] - t[i] >= BOUNCE
        if lasts and stands[i] != (out[-1][1] if out else stands[0]):
            out.append((float(t[i]), bool(stands[i])))
    return out


def solver(rollout: Rollout, *, period: float) -> dict[str, Any]:
    """The controller's wall times.

    `mpc_ms_p50`, `mpc_ms_p99`, `mpc_ms_max`: ms of a solve.  `missed_ticks`: solves that took longer than the period
    (s).  `mpc_kept_plans`: ticks at which the solver failed and the previous plan was kept.
    """
    ms = rollout.mpc_ms
    return {
        "mpc_ms_p50": float(np.percentile(ms, 50)),
        "mpc_ms_p99": float(np.percentile(ms, 99)),
        "mpc_ms_max": float(ms.max()),
        "missed_ticks": int(np.sum(ms > 1e3 * period)),
        "mpc_kept_plans": int(np.sum(rollout.mpc_status != 0)),
    }


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
