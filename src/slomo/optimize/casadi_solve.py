"""What CasADi's solvers have in common: the homotopy over kappa, the ground under the moving feet, an honest status."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from slomo.errors import UsageError
from slomo.optimize import constraints
from slomo.optimize.casadi_nlp import Knot, OptimalControl
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body
from slomo.optimize.iterate import Iterate
from slomo.optimize.solve import Settings, Solution, differs
from slomo.terrain import Terrain

Array = np.ndarray
Report = Callable[[float, str], None]

SECONDS = 600.0  # of solving, after which it is given up


class Form(Protocol):
    """How the task becomes a problem with the unknowns z (N, nz) at the knots and the end state."""

    body: Body
    knots: tuple[Knot, Knot, Knot]

    def parameters(self, task: Task, kappa: float) -> Array:
        """(N + 1, np)."""
        ...

    def bounds(self, task: Task) -> tuple[Array, Array]:
        """(N, nz) each."""
        ...

    def pack(self, task: Task, it: Iterate, kappa: float) -> tuple[Array, Array]:
        """z and end state of an iterate."""
        ...

    def unpack(self, task: Task, z: Array, end: Array, kappa: float) -> Iterate:
        """Inverse of `pack`, with contact forces."""
        ...


@dataclass(frozen=True)
class Plugin:
    """A solver of CasADi.

    Attributes:
        name: as `casadi.nlpsol` knows it.  title: for messages.
        options: from (most iterations, seconds that remain) to its options.
        seconds: after which a solve is given up.
    """

    name: str
    title: str
    options: Callable[[int, float], Mapping[str, Any]]
    seconds: float = SECONDS


def run(
    form: Form, plugin: Plugin, task: Task, start: Iterate, *, terrain: Terrain, settings: Settings, report: Report
) -> Solution:
    """Follow `settings.kappas` down; at the last one move the ground until the points stay on their planes.

    Every kappa gets all iterations: an interior-point iterate that is stopped early is no start for the next one.

    Returns:
        The last iterate. Its status is "converged" when the solver says so at the last kappa and the ground under every
        point is the plane that it was solved with; otherwise it says what went wrong.

    Raises:
        UsageError: points that may not slide, which only the compiled solver does.
    """
    if settings.strict or np.any(task.stick):
        raise UsageError(f"{plugin.title} has no strict contact", where="optimize.solver", todo="use the solver ddp")
    began = time.perf_counter()
    control = OptimalControl(*form.knots, N=len(start.us), plugin=plugin.name)
    compile_seconds, began = time.perf_counter() - began, time.perf_counter()
    z, end = form.pack(task, start, settings.kappas[0])
    low, high = form.bounds(task)
    it, iterations, cost, status = start, 0, np.inf, "time limit"
    for n, kappa in enumerate(settings.kappas):
        last = n == len(settings.kappas) - 1
        for turn in range(settings.rounds if last else 1):
            remaining = plugin.seconds - (time.perf_counter() - began)
            if remaining <= 0:
                status = "time limit"
                break
            report((n + turn / settings.rounds) / len(settings.kappas), f"{plugin.title}, kappa {kappa:g} N m")
            # A solver that cannot look at the clock itself gets as many iterations as the time will do.
            spent = plugin.seconds - remaining
            most = settings.iterations
            if iterations:
                most = min(most, 1 + int(remaining * iterations / max(spent, 1e-3)))
            options = plugin.options(most, remaining)
            result = control.solve(z, end, form.parameters(task, kappa), low=low, high=high, options=options)
            iterations += result.iterations
            if not np.all(np.isfinite(result.z)):
                status = "not finite"
                break
            z, end, cost = result.z, result.end, result.cost
            it = form.unpack(task, z, end, kappa)
            status = "converged" if result.success else result.status
            if status == "iteration limit" and most < settings.iterations:
                status = "time limit"
            ground = np.ascontiguousarray(terrain.planes(it.qs[:, 7:].reshape(len(it.qs), -1, 3)))
            moved = differs(task, ground, it)
            if last and result.success and moved:
                status = "feet keep crossing an edge of the terrain"
            elif last:
                break
            task = task._replace(ground=ground) if moved else task
    seconds = time.perf_counter() - began
    return Solution(it, status, iterations, cost, _violation(form.body, it), "targets", 1, seconds, compile_seconds)


def _violation(body: Body, it: Iterate) -> float:
    """m, the largest of the constraints."""
    g, worst = np.empty(it.multiplier.shape[1]), 0.0
    for q in it.qs:
        constraints.values(body, q, g)
        worst = max(worst, float(g.max(initial=0.0)))
    return worst
