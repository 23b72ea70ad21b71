"""The whole optimisation: homotopy over kappa, augmented Lagrangian over leg lengths, ground under the moving feet."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slomo.errors import StageFailed
from slomo.optimize import ddp
from slomo.optimize.cost import Task, leg_violation
from slomo.optimize.dynamics import Body
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray


@dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        kappas: N m, falling: the homotopy of the contact.
        iterations, early_iterations: most Newton steps at the last kappa, and at each one that leads to it.
        tolerance: of the relative decrease still expected.
        leg_penalty: 1/m^2, first penalty of the leg limits.  leg_tolerance: m, largest violation accepted.
        rounds: of the augmented Lagrangian (and of moving the ground) at the last kappa.
    """

    kappas: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4)
    iterations: int = 200
    early_iterations: int = 50
    tolerance: float = 1e-6
    leg_penalty: float = 1e4
    leg_tolerance: float = 1e-5
    rounds: int = 12


@dataclass(frozen=True)
class Solution:
    """The last iterate, whether it converged or not.

    Attributes:
        iterate: states, inputs, contact forces; its dynamics hold to rounding.
        status: "converged", or why not.  iterations: in all.  cost: of the last problem.
        leg_violation: m.  seconds: of solving.  compile_seconds: of compiling or loading compiled code before.
    """

    iterate: ddp.Iterate
    status: str
    iterations: int
    cost: float
    leg_violation: float
    seconds: float
    compile_seconds: float


def _violation(body: Body, it: ddp.Iterate) -> Array:
    out = np.empty((len(it.qs), len(body.leg_min), 2))
    for k in range(len(it.qs)):
        leg_violation(body, it.qs[k], out[k])
    return out


def warm_up(model: PointFootModel) -> float:
    """Compile (or load from the cache) everything that `solve` calls; returns the seconds that it took."""
    start = time.perf_counter()
    C, N = model.C, 2
    nv = 6 + 3 * C
    q = np.zeros((N + 1, nv + 1))
    q[:, 6] = 1.0
    q[:, 2] = model.leg_max.mean()
    q[:, 7:] = (model.hips * [1, 1, 0]).ravel()
    task = Task(
        h=np.full(N + 1, 0.01), heights=np.zeros((N + 1, C)), q_ref=q.copy(), v_ref=np.zeros((N + 1, nv)),
        u_ref=np.zeros((N, 3 * C)), w_x=np.ones((N + 1, 2 * nv)), w_u=np.ones((N, 3 * C)),
        w_acceleration=1.0, w_slip=1.0, slip_load=1.0,
    )  # fmt: skip
    it = ddp.Iterate(q, np.zeros((N + 1, nv)), np.zeros((N, 3 * C)), np.zeros((N, C, 3)), np.zeros((N + 1, C, 2)))
    body, work = Body.of(model), ddp.Work.make(N, C)
    ddp.solve(body, task, 1.0, it, 1.0, True, 1, 1e-6, 1e-6, work)
    ddp.close(body, task, 1.0, it, work)
    _violation(body, it)
    return time.perf_counter() - start


def solve(
    model: PointFootModel,
    task: Task,
    start: ddp.Iterate,
    *,
    terrain: Terrain,
    settings: Settings | None = None,
    report: Callable[[float, str], None] = lambda fraction, message: None,
) -> Solution:
    """Minimise the task's cost from a start (not changed).

    The iterate that is returned satisfies the dynamics and the input limits whatever the status; leg limits and
    convergence hold when the status is "converged". `report(fraction, message)` is called between the solves.

    Raises:
        StageFailed: the start is not finite.
    """
    s = settings or Settings()
    compile_seconds = warm_up(model)
    began = time.perf_counter()
    body = Body.of(model)
    it = ddp.Iterate(*(x.copy() for x in start))
    work = ddp.Work.make(len(it.us), model.C)
    rho, reg, iterations = s.leg_penalty, 1e-3, 0
    status, cost, worst = ddp.ITERATIONS, np.inf, np.inf
    C = model.C
    previous, moved = np.inf, False
    for n, kappa in enumerate(s.kappas):
        last = n == len(s.kappas) - 1
        most = s.iterations if last else s.early_iterations
        for turn in range(s.rounds if last else 1):
            report((n + turn / s.rounds) / len(s.kappas), f"kappa {kappa:g} N m, leg limits round {turn + 1}")
            status, count, cost, _, reg = ddp.solve(
                body, task, kappa, it, rho, True, most, s.tolerance, max(reg, 1e-6), work
            )
            iterations += count
            if status == ddp.NOT_FINITE:
                raise StageFailed("met numbers that are not finite", where="optimize", todo="check the key points")
            g = _violation(body, it)
            worst = float(max(g.max(), 0.0))
            heights = terrain.height(it.qs[:, 7:].reshape(-1, C, 3))
            moved = not np.array_equal(heights, task.heights)
            if last and worst <= s.leg_tolerance and not moved and status == ddp.CONVERGED:
                break
            it.multiplier[:] = np.maximum(0.0, it.multiplier + rho * g)
            if worst > 0.5 * previous and rho < 1e7:
                rho *= 4.0
            previous = worst
            if moved:
                task = task._replace(heights=np.ascontiguousarray(heights))
            reg = min(reg, 1e-3)
    ddp.close(body, task, s.kappas[-1], it, work)
    worst = float(max(_violation(body, it).max(), 0.0))
    what = ddp.STATUS[status]
    if status == ddp.CONVERGED and worst > 10 * s.leg_tolerance:
        what = f"leg limits exceeded by {1e3 * worst:.2f} mm"
    elif status == ddp.CONVERGED and moved:
        what = "feet keep crossing an edge of the terrain"
    return Solution(it, what, iterations, float(cost), worst, time.perf_counter() - began, compile_seconds)
