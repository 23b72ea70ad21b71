"""The table at the end of a run: what was measured in each stage, beside the bar it had to meet."""

from collections.abc import Mapping
from typing import Any

Row = dict[str, Any]


def _row(stage: str, quantity: str, value: Any, unit: str = "", limit: float | None = None) -> Row:
    return {"stage": stage, "quantity": quantity, "value": value, "unit": unit, "limit": limit}


def rows(
    score: Mapping[str, Any] | None, retarget: Mapping[str, Any], optimize: Mapping[str, Any], track: Mapping[str, Any]
) -> list[Row]:
    """{stage, quantity, value, unit, limit (or None)} in the order of the line.

    Args:
        score: what `synth.score.score` returns, where the truth is known.
        retarget, optimize, track: the stages' own reports.
    """
    out: list[Row] = []
    if score is not None:
        for key, name in (
            ("pa_mpjpe_percent", "key points, each frame aligned"),
            ("w_mpjpe_percent", "key points, whole motion aligned"),
            ("root_path_error_percent", "root path, of the distance"),
            ("gravity_error_degrees", "vertical"),
        ):
            unit = "degrees" if key.endswith("degrees") else "%" if "root" in key else "% of body length"
            out.append(_row("reconstruct", name, score[key], unit))
    out += [
        _row("retarget", "scale, robot over creature", retarget.get("scale")),
        _row("retarget", "distance", retarget.get("distance_m"), "m"),
    ]
    limits = optimize.get("limits", {})
    units = {"dynamics_residual": "", "complementarity": "N m", "penetration": "m", "slip_per_second": "m/s"}
    units |= {"torque_ratio": "", "speed_ratio": "", "joint_miss": "m"}
    for key, unit in units.items():
        out.append(_row("optimize", key.replace("_", " "), optimize.get(key), unit, limits.get(key)))
    out += [
        _row("optimize", "body error", optimize.get("body_error"), "m", limits.get("body_error")),
        _row("optimize", "foot error", optimize.get("foot_error"), "m", limits.get("foot_error")),
        _row("optimize", "time to solve", optimize.get("solve_seconds"), "s"),
        _row("optimize", "duration of the motion", optimize.get("motion_seconds"), "s"),
        _row("track", "fell", track.get("fell")),
        _row("track", "body error, RMS", track.get("body_rmse"), "m"),
        _row("track", "foot error, RMS", track.get("foot_rmse"), "m"),
        _row("track", "orientation error, RMS", track.get("orientation_rmse"), "degrees"),
        _row("track", "MPC solve, median", track.get("mpc_ms_p50"), "ms"),
        _row("track", "MPC solve, 99th percentile", track.get("mpc_ms_p99"), "ms"),
        _row("track", "time to simulate", track.get("wall_seconds"), "s"),
    ]
    return [r for r in out if r["value"] is not None]


def as_text(table: list[Row]) -> str:
    """The rows in aligned columns."""

    def shown(value: Any) -> str:
        return "yes" if value is True else "no" if value is False else f"{value:.3g}"

    cells = [
        (
            r["stage"] if i == 0 or table[i - 1]["stage"] != r["stage"] else "",
            r["quantity"],
            shown(r["value"]),
            r["unit"],
            "" if r["limit"] is None else f"(at most {r['limit']:g})",
        )
        for i, r in enumerate(table)
    ]
    widths = [max(len(c[k]) for c in cells) for k in range(5)]
    return "\n".join(
        f"{s:<{widths[0]}}  {q:<{widths[1]}}  {v:>{widths[2]}} {u:<{widths[3]}}  {lim}".rstrip()
        for s, q, v, u, lim in cells
    )
