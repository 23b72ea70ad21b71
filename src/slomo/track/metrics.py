"""How well a roll-out followed its reference, in numbers."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Rollout

Array = np.ndarray


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


def solver(rollout: Rollout, *, period: float) -> dict[str, Any]:
    """The controller's wall times.

    `mpc_ms_p50`, `mpc_ms_p99`: ms of a solve.  `missed_ticks`: solves that took longer than the period (s).
    `mpc_kept_plans`: ticks at which the solver failed and the previous plan was kept.
    """
    ms = rollout.mpc_ms
    return {
        "mpc_ms_p50": float(np.percentile(ms, 50)),
        "mpc_ms_p99": float(np.percentile(ms, 99)),
        "missed_ticks": int(np.sum(ms > 1e3 * period)),
        "mpc_kept_plans": int(np.sum(rollout.mpc_status != 0)),
    }


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
