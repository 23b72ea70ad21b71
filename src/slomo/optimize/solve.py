"""The whole optimisation: homotopy over kappa, multipliers of the constraints, ground under moving feet, new starts."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from slomo.errors import StageFailed
from slomo.optimize import constraints, ddp
from slomo.optimize.closing import end_gap, end_penalty
from slomo.optimize.cost import Task, cone, cone_penalty
from slomo.optimize.dynamics import Body
from slomo.optimize.iterate import Iterate, Work
from slomo.optimize.load import load_excess, load_penalty
from slomo.optimize.reach import reach_excess
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray
Report = Callable[[float, str], None]

LOADED = 1.0  # N, a point is in contact during a step when its normal force exceeds this
_PENALTY_MOST = 1e7
# l1 norm of the gaps in the end, m, rad, m/s, rad/s: the roll-out closes them without a trace in cost or constraints,
# where Newton steps would take as many again; but a cycle's end is held more tightly than that.
_CLOSED, _CLOSED_CYCLE = 1e-5, 1e-7
_EARLY = 1e2  # factor on the tolerances before that
# Gap times force (N m) and gap (m) by which the planes that a solve used may differ from the ground that is there.
_GROUND_WORK, _GROUND = 1e-5, 1e-4


@dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        kappas: N m, falling: the homotopy of the contact.
        iterations, early_iterations: most Newton steps at the last kappa, and at each one that leads to it.
        tolerance: of the relative decrease still expected.
        penalty: 1/m^2, first penalty of the constraints.
        constraint_tolerance: m, largest violation accepted.  cone_tolerance: N, the same of a friction cone.
        load_tolerance: the same of joint torques and speeds over their limits.  reach_tolerance: m, of `reach`.
        end_tolerance: m, rad, m/s, rad/s, of the end of a cyclic motion.
        rounds: of the augmented Lagrangian (and of moving the ground) at the last kappa.
        most_iterations: in all, from one start.
        patience: rounds in a row at the last kappa without progress, after which a start is given up: Newton steps ran
            out, or violations did not halve, as where limits contradict each other.
        strict: whether loaded points may not slide at all, instead of at a cost.
        starts: most starts that are tried.
    """

    kappas: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4)
    iterations: int = 200
    early_iterations: int = 50
    tolerance: float = 1e-6
    penalty: float = 1e4
    constraint_tolerance: float = 5e-5
    cone_tolerance: float = 1e-3
    load_tolerance: float = 5e-3
    reach_tolerance: float = 5e-4
    end_tolerance: float = 5e-7
    rounds: int = 16
    most_iterations: int = 1500
    patience: int = 16
    strict: bool = False
    starts: int = 4


@dataclass(frozen=True)
class Solution:
    """The best iterate, whether it converged or not.

    Attributes:
        iterate: states, inputs, contact forces; where it converged its dynamics hold to rounding.
        status: "converged", or why not.  iterations: Newton steps in all.  cost: of the last problem.
        violation: m, of the constraints.  starts: how many were tried, the last one named by `start`.
        seconds: of solving.  compile_seconds: of compiling or loading compiled code before.
    """

    iterate: Iterate
    status: str
    iterations: int
    cost: float
    violation: float
    start: str
    starts: int
    seconds: float
    compile_seconds: float

    @property
    def converged(self) -> bool:
        return self.status == ddp.STATUS[ddp.CONVERGED]


def warm_up(model: PointFootModel) -> float:
    """Compile (or load from the cache) everything that `solve` calls; returns the seconds that it took."""
    began = time.perf_counter()
    C, N = model.C, 2
    nv = 6 + 3 * C
    q = np.zeros((N + 1, nv + 1))
    q[:, 6] = 1.0
    q[:, 2] = model.leg_max.mean()
    q[:, 7:] = (model.hips * [1, 1, 0]).ravel()
    up = np.tile([0.0, 0.0, 1.0, 0.0], (N + 1, C, 1))
    task = Task(
        h=np.full(N + 1, 0.01), ground=up, stick=np.zeros((N, C), bool), q_ref=q.copy(), v_ref=np.zeros((N + 1, nv)),
        u_ref=np.zeros((N, 3 * C)), w_x=np.ones((N + 1, 2 * nv)), w_u=np.ones((N, 3 * C)),
        u_low=np.full((N, 3 * C), -1.0), u_high=np.ones((N, 3 * C)), w_acceleration=1.0, w_spin=1.0, w_slip=1.0,
        slip_load=1.0, cyclic=False, shift=np.zeros(4),
    )  # fmt: skip
    it = Iterate.at(q, np.zeros((N + 1, nv)), np.zeros((N, 3 * C)), C=C, M=constraints.number(Body.of(model)))
    body, work = Body.of(model), Work.make(it)
    ddp.solve(body, task, 1.0, it, 1.0, True, 1, 1e-6, 1e-6, 1e-6, work)
    ddp.close(body, task, 1.0, it, work)
    _violations(body, task, it)
    return time.perf_counter() - began


def solve(
    model: PointFootModel,
    task: Task,
    start: Iterate,
    *,
    terrain: Terrain,
    settings: Settings | None = None,
    report: Report = lambda fraction, message: None,
) -> Solution:
    """Minimise the task's cost from a start (not changed), or from others where that does not converge.

    The iterate that is returned satisfies the input limits whatever the status; dynamics, constraints and convergence
    hold when the status is "converged". `report(fraction, message)` is called between the solves.

    Raises:
        StageFailed: the start is not finite.
    """
    s = settings or Settings()
    compile_seconds = warm_up(model)
    began = time.perf_counter()
    best: Solution | None = None
    iterations = 0
    for n, (name, first, how) in enumerate(_starts(task, start, s)):
        solution = replace(_descend(model, task, first, terrain, how, report), start=name, starts=n + 1)
        iterations += solution.iterations
        if best is None or solution.converged or solution.violation < 0.5 * best.violation:
            best = replace(solution, starts=n + 1)
        if solution.converged or n + 1 >= s.starts:
            break
        report(0.0, f"start {n + 1} ({name}): {solution.status}; another one")
    assert best is not None
    seconds = time.perf_counter() - began
    return replace(best, starts=n + 1, iterations=iterations, seconds=seconds, compile_seconds=compile_seconds)


def _starts(task: Task, start: Iterate, s: Settings) -> Iterator[tuple[str, Iterate, Settings]]:
    """Starts by name, with the settings for each."""
    yield "targets", start, s
    yield "targets, softer contact first", start, replace(s, kappas=(10.0, 1.0, *s.kappas), early_iterations=100)
    still = start.copy()
    still.vs[:] = 0.0
    still.us[:] = 0.5 * (task.u_low + task.u_high)
    yield "targets, no forces", still, replace(s, kappas=(10.0, 1.0, *s.kappas), penalty=10 * s.penalty)
    smooth = start.copy()
    T = len(smooth.qs)
    for x in (smooth.qs, smooth.vs):
        padded = np.concatenate([np.repeat(x[:1], 3, axis=0), x, np.repeat(x[-1:], 3, axis=0)])
        x[:] = sum(padded[i : i + T] for i in range(7)) / 7
    smooth.qs[:, 3:7] /= np.linalg.norm(smooth.qs[:, 3:7], axis=1, keepdims=True)
    yield "smoothed targets", smooth, replace(s, kappas=(1.0, *s.kappas), iterations=2 * s.iterations)


@dataclass
class _Multipliers:
    """Augmented Lagrangian: the penalty grows while the violations do not halve."""

    penalty: float
    previous: float = np.inf

    def update(self, body: Body, task: Task, it: Iterate, settings: Settings) -> float:
        """New multipliers in `it`; returns the largest violation relative to its tolerance."""
        rho = self.penalty
        g, sliding, end = _violations(body, task, it)
        over, fast = load_excess(task.load, it.us), load_excess(task.speed, it.vs)
        beyond = reach_excess(task.reach, it.qs)
        equal = np.array([constraints.is_equality(body, n) for n in range(g.shape[1])], bool)
        worst = max(
            float(np.where(equal, np.abs(g), g).max(initial=0.0)) / settings.constraint_tolerance,
            float(sliding.max(initial=0.0)) / settings.cone_tolerance,
            float(max(over.max(initial=0.0), fast.max(initial=0.0))) / settings.load_tolerance,
            float(beyond.max(initial=0.0)) / settings.reach_tolerance,
            float(np.abs(end).max(initial=0.0)) / settings.end_tolerance,
        )
        it.multiplier[:] = it.multiplier + rho * np.where(np.isfinite(g), g, 0.0)
        it.multiplier[:] = np.where(equal, it.multiplier, np.maximum(it.multiplier, 0.0))
        it.cone[:] = np.where(task.stick, np.maximum(0.0, it.cone + cone_penalty(rho) * sliding), 0.0)
        it.loads[:] = np.maximum(0.0, it.loads + load_penalty(rho) * over)
        it.speeds[:] = np.maximum(0.0, it.speeds + load_penalty(rho) * fast)
        it.beyond[:] = np.maximum(0.0, it.beyond + rho * beyond)
        if task.cyclic:
            nv = len(end) // 2
            it.closing[:] += np.array([end_penalty(rho, i, nv) for i in range(2 * nv)]) * end
        if worst > 0.5 * self.previous and rho < _PENALTY_MOST:
            self.penalty = 4.0 * rho
        self.previous = worst
        return worst


def _descend(
    model: PointFootModel, task: Task, start: Iterate, terrain: Terrain, s: Settings, report: Report
) -> Solution:
    """From one start through all kappas, and once more with sticking points where that is asked for."""
    body, (loads, speeds, beyond) = Body.of(model), (x.most.shape[1] for x in (task.load, task.speed, task.reach))
    it = start.fitting(loads=loads, speeds=speeds, beyond=beyond)
    work = Work.make(it, cyclic=task.cyclic)
    multipliers = _Multipliers(s.penalty)
    reg, iterations, cost, failure, failed = 1e-3, 0, np.inf, "", 0
    stages = [(kappa, False) for kappa in s.kappas] + [(s.kappas[-1], True)] * s.strict
    for n, (kappa, strict) in enumerate(stages):
        last, final = n >= len(s.kappas) - 1, False
        for turn in range(s.rounds if last else 1):
            report((n + turn / s.rounds) / len(stages), f"kappa {kappa:g} N m, constraints round {turn + 1}")
            if strict:
                task = task._replace(stick=task.stick | (_normal_forces(task, it) > LOADED))
            most = s.iterations if last else s.early_iterations
            # What comes before the last multipliers need not be exact.
            factor, rho = 1.0 if final else _EARLY, multipliers.penalty
            near, apart = factor * s.tolerance, factor * (_CLOSED_CYCLE if task.cyclic else _CLOSED)
            status, count, cost, _, reg = ddp.solve(
                body, task, kappa, it, rho, True, most, near, apart, max(reg, 1e-6), work
            )
            iterations += count
            if status == ddp.NOT_FINITE:
                raise StageFailed("met numbers that are not finite", where="optimize", todo="check the key points")
            before, worst = multipliers.previous, multipliers.update(body, task, it, s)
            ground = np.ascontiguousarray(terrain.planes(it.qs[:, 7:].reshape(len(it.qs), -1, 3)))
            moved = differs(task, ground, it)
            new = strict and np.any(_normal_forces(task, it)[~task.stick] > LOADED)
            failure = "" if status == ddp.CONVERGED else ddp.STATUS[status]
            if worst > 1.0:
                failure = failure or f"constraints exceed their tolerance {worst:.1f} times"
            if moved:
                failure = failure or "feet keep crossing an edge of the terrain"
                task = task._replace(ground=ground)
            nothing = status != ddp.CONVERGED or worst > max(1.0, 0.5 * before)
            failed = failed + 1 if last and nothing else 0
            if iterations >= s.most_iterations or failed >= s.patience:
                failure = failure or ddp.STATUS[ddp.ITERATIONS]
                break
            if last and not failure and not new:
                if final:
                    break
                final = True
            # A cycle's end is held more tightly than what is not exact can tell.
            final = final or (task.cyclic and worst < _EARLY)
            reg = min(reg, 1e-3)
    closed = it.copy()
    ddp.close(body, task, s.kappas[-1], closed, work)
    # Far from converged the gains may not hold the roll-out together: then the knots stay apart, for inspection.
    if np.all(np.isfinite(closed.qs)) and np.all(np.isfinite(closed.vs)):
        it = closed
    g = _violations(body, task, it)[0]
    return Solution(
        it, failure or ddp.STATUS[ddp.CONVERGED], iterations, float(cost), float(g.max(initial=0.0)), "", 0, 0.0, 0.0
    )


def _violations(body: Body, task: Task, it: Iterate) -> tuple[Array, Array, Array]:
    """Of the constraints (N + 1, M) m, of the cones of sticking points (N, C) N, and of a cyclic end (nx or 0,)."""
    g = np.empty_like(it.multiplier)
    for k in range(len(g)):
        constraints.values(body, it.qs[k], g[k])
    sliding = np.zeros(task.stick.shape)
    for k, c in np.argwhere(task.stick):
        sliding[k, c] = cone(body, task.ground[k + 1, c], it.lam[k, c])
    end = np.zeros(len(it.closing) if task.cyclic else 0)
    if task.cyclic:
        end_gap(task, it.qs[0], it.vs[0], it.qs[-1], it.vs[-1], end)
    return g, sliding, end


def _normal_forces(task: Task, it: Iterate) -> Array:
    """(N, C) N."""
    return np.sum(task.ground[1:, :, :3] * it.lam, axis=2)


def differs(task: Task, ground: Array, it: Iterate) -> bool:
    """Whether planes (N + 1, C, 4) put a point at another height than those of the task, as far as it matters."""
    points = it.qs[:, 7:].reshape(len(it.qs), -1, 3)
    change = ground - task.ground
    gap = np.abs(np.sum(change[..., :3] * points, axis=2) - change[..., 3])
    work = gap[1:] * np.maximum(_normal_forces(task, it), 0.0)
    return bool(gap.max() > _GROUND or work.max() > _GROUND_WORK)
