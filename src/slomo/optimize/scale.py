"""The size of the motion as a variable of the problem: one factor on all targets, found with the trajectory.

With V(s) = min over trajectories of the cost for targets of scale s, the best scale solves V'(s) = 0. By the envelope
theorem V'(s) is the derivative of the cost at a fixed, optimal trajectory, so that each solve gives it exactly and a
bracketed secant needs a handful of them, each warm-started from the last. Tracking errors are measured relative to the
scale, so that a motion does not shrink only because small motions have small errors.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from slomo.optimize.cost import Task
from slomo.optimize.iterate import Iterate
from slomo.optimize.problem import Targets, velocities
from slomo.optimize.solve import Solution
from slomo.terrain import Terrain

Array = np.ndarray

SMALLEST, LARGEST = 0.6, 1.6
WEIGHT = 5.0  # per second of motion, of log(scale)^2: without a reason it stays 1
TOLERANCE = 2e-3
_STEP = 1e-5  # of the central difference in s at a fixed trajectory


def scaled(want: Targets, s: float, terrain: Terrain) -> Targets:
    """Targets with horizontal positions scaled about the origin and heights about the ground."""
    q = want.q.copy()
    for i in (0, *range(7, q.shape[1], 3)):
        over = want.q[:, i + 2] - terrain.height(want.q[:, i : i + 2])
        q[:, i : i + 2] *= s
        q[:, i + 2] = terrain.height(q[:, i : i + 2]) + s * over
    return replace(want, q=q, v=velocities(want.t, q))


def best_scale(
    want: Targets,
    terrain: Terrain,
    *,
    make_task: Callable[[Targets], Task],
    solve: Callable[[Task, Iterate | None], Solution],
) -> tuple[float, Targets, Task, Solution]:
    """The scale, its targets and task, and the solution for them.

    Args:
        want: targets of scale 1.
        make_task: targets to a task.  solve: a task and a start (None: its own) to a solution.
    """
    duration = float(want.t[-1] - want.t[0])
    found: dict[float, tuple[Targets, Task, Solution]] = {}

    def task_at(s: float) -> Task:
        task = make_task(scaled(want, s, terrain))
        w = task.w_x.copy()
        nv = w.shape[1] // 2
        for i in (0, 1, 2, *range(6, nv)):
            w[:, i] /= s**2
        return task._replace(w_x=w)

    def slope(s: float) -> float:
        task = task_at(s)
        start = found[min(found, key=lambda x: abs(x - s))][2].iterate if found else None
        solution = solve(task, start)
        found[s] = (scaled(want, s, terrain), task, solution)
        up, down = (_tracking(task_at(s + d), solution.iterate) for d in (_STEP, -_STEP))
        return (up - down) / (2 * _STEP) + 2 * WEIGHT * duration * np.log(s) / s

    low = high = 1.0
    at_low = at_high = slope(1.0)
    # Widen the bracket towards where the cost falls.
    while at_low > 0 and low > SMALLEST:
        high, at_high = low, at_low
        low = max(SMALLEST, low - 0.1)
        at_low = slope(low)
    while at_high < 0 and high < LARGEST:
        low, at_low = high, at_high
        high = min(LARGEST, high + 0.1)
        at_high = slope(high)
    if at_low < 0 < at_high:
        s = float(brentq(slope, low, high, xtol=TOLERANCE, maxiter=8, disp=False))  # pyright: ignore[reportArgumentType]
        s = min(found, key=lambda x: abs(x - s))
    else:
        s = low if at_low >= 0 else high
    return (s, *found[s])


def _tracking(task: Task, it: Iterate) -> float:
    """Cost of the deviation from the targets, which is what depends on the scale at a fixed trajectory."""
    nv = it.vs.shape[1]
    dq = np.delete(it.qs - task.q_ref, [3, 4, 5, 6], axis=1)
    w = np.delete(task.w_x[:, :nv], [3, 4, 5], axis=1)
    dv = it.vs - task.v_ref
    return float(0.5 * np.sum(task.h[:, None] * (w * dq**2))) + float(
        0.5 * np.sum(task.h[:, None] * task.w_x[:, nv:] * dv**2)
    )
