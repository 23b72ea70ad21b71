"""What trials come to: success rates with their intervals, as records, text and a plot."""

import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slomo.track.trial import ROWS, Result

COLOURS = {"ci-mpc": "#0072B2", "convex-mpc": "#E69F00", "open-loop": "#999999"}
Z95 = 1.959964  # 97.5th percentile of the normal distribution


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927): it stays within [0, 1] and is right at 0 and n successes."""
    if n == 0:
        return 0.0, 1.0
    p, z2 = successes / n, Z95**2 / n
    middle = (p + z2 / 2) / (1 + z2)
    half = Z95 / (1 + z2) * np.sqrt(p * (1 - p) / n + z2 / (4 * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def summary(results: Iterable[Result]) -> list[dict[str, Any]]:
    """One record for each controller and row: trials, successes, rate, interval, errors of those that held, falls."""
    found = sorted(results, key=lambda r: (list(COLOURS).index(r.controller), list(ROWS).index(r.row), r.number))
    groups: dict[tuple[str, str], list[Result]] = {}
    for r in found:
        groups.setdefault((r.controller, r.row), []).append(r)
    return [_record(controller, row, rs) for (controller, row), rs in groups.items()]


def _record(controller: str, row: str, results: Sequence[Result]) -> dict[str, Any]:
    held = [r for r in results if r.fall is None]
    low, high = wilson(len(held), len(results))

    def mean(name: str) -> float | None:
        values = [v for r in held if (v := getattr(r, name)) is not None]
        return float(np.mean(values)) if values else None

    return {
        "controller": controller,
        "row": row,
        "about": ROWS[row],
        "trials": len(results),
        "successes": len(held),
        "success_rate": len(held) / len(results),
        "interval": [low, high],
        "body_rmse": mean("body_rmse"),
        "foot_rmse": mean("foot_rmse"),
        "orientation_rmse": mean("orientation_rmse"),
        "falls": [
            {"trial": f"{row}/{r.number}", "fall": r.fall, "about": r.about} for r in results if r.fall is not None
        ],
    }


def as_text(rows: Sequence[dict[str, Any]]) -> str:
    """One table: a line for each row, a column for each controller."""
    controllers = [c for c in COLOURS if any(r["controller"] == c for r in rows)]
    cells = {(r["row"], r["controller"]): _cell(r) for r in rows}
    width = 34
    lines = [f"{'':<26}" + "".join(f"{c:<{width}}" for c in controllers).rstrip()]
    for row, about in ROWS.items():
        found = [cells.get((row, c), "-") for c in controllers]
        if any((row, c) in cells for c in controllers):
            lines.append(f"{about:<26}" + "".join(f"{cell:<{width}}" for cell in found).rstrip())
    return "\n".join(lines)


def _cell(r: dict[str, Any]) -> str:
    low, high = (100 * x for x in r["interval"])
    body = f", body {100 * r['body_rmse']:.1f} cm" if r["body_rmse"] is not None else ""
    return f"{r['successes']}/{r['trials']} ({low:.0f} to {high:.0f} %){body}"


def plot(rows: Sequence[dict[str, Any]], *, title: str) -> bytes:
    """PNG: success rate of each row with its interval, one bar for each controller."""
    controllers = [c for c in COLOURS if any(r["controller"] == c for r in rows)]
    names = [row for row in ROWS if any(r["row"] == row for r in rows)]
    figure = Figure(figsize=(9, 1.2 + 0.55 * len(names)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    high = 0.8 / len(controllers)
    for i, controller in enumerate(controllers):
        for r in (r for r in rows if r["controller"] == controller):
            y = names.index(r["row"]) + (i - (len(controllers) - 1) / 2) * high
            rate, (a, b) = 100 * r["success_rate"], (100 * x for x in r["interval"])
            axis.barh(y, rate, height=0.9 * high, color=COLOURS[controller])
            axis.plot([a, b], [y, y], color="0.15", lw=1.2)
            axis.text(102, y, f"{r['successes']}/{r['trials']}", va="center", fontsize=8)
    axis.set_yticks(range(len(names)), [ROWS[n] for n in names])
    axis.invert_yaxis()
    axis.set_xlim(0, 112)
    axis.set_xticks(range(0, 101, 20))
    axis.set_xlabel("trials without a fall (%), and the 95 % interval (Wilson)")
    axis.set_title(title, loc="left", fontsize=11)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    if len(controllers) > 1:
        handles = [axis.barh([0], [0], color=COLOURS[c], label=c) for c in controllers]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(controllers), frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()
