"""One tick of the MPC beside other ways to solve it: `make bench-mpc`.

    python tests/bench_mpc.py [--horizons 3,10,20] [--ticks 200] [--minutes 0] [--json]

A trot of 2.5 strides a second with noise on the measured state, one core, compiled code warm. Times are of this
thread's processor: others at work on the machine do not count. Every row is solved at the same ticks, about the same
plan:

    ncp, lcp     the controller as it runs, whole tick (reference sampled, 2 iterations at most)
    clarabel,    one QP of the same size and structure: the tick's linearised dynamics as equations, its weights, limits
    proxqp       of inputs. Setting up is not counted, only the solve.
    fatrop       the tick's nonlinear problem, to convergence, started from the controller's own plan

`--minutes` also runs the controller for that long and reports whether its memory grows and its times drift.
"""

import argparse
import gc
import json
import os
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass

import casadi as ca
import clarabel
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import sparse

from gaits import gait, quadruped, reference
from slomo.optimize import problem
from slomo.optimize.casadi_nlp import OptimalControl
from slomo.optimize.fatrop import SmoothForm
from slomo.optimize.iterate import Iterate
from slomo.optimize.solve import Settings, solve
from slomo.terrain import Terrain
from slomo.track.mpc import Mpc, MpcConfig
from slomo.track.plan import Plan

try:
    from proxsuite import proxqp  # pyright: ignore[reportMissingImports]
except ImportError:
    proxqp = None

BARS = {3: 1.0, 10: 2.0}  # ms, p99 of the controller's tick
PERIOD = 0.01  # s


@dataclass(frozen=True)
class Row:
    """Times of one way at one horizon, ms of the processor; `ratio` of its median to the controller's."""

    horizon: int
    solver: str
    ticks: int
    p50: float
    p99: float
    ratio: float
    failed: int


def make_reference():
    model = quadruped()
    want = gait(model, 2.0)
    task = problem.make_task(model, want, Terrain(), problem.Weights())
    start = problem.make_start(model, want, task)
    return model, reference(model, task, solve(model, task, start, terrain=Terrain(), settings=Settings()))


def noisy_states(mpc: Mpc, ticks: int):
    """(t, q, v) at each tick: where the last plan should have led, with noise as of an estimator; round and round."""
    rng = np.random.default_rng(0)
    last, plan = float(mpc.reference.t[-1]), None
    q, v = mpc.reference.q[0].copy(), mpc.reference.v[0].copy()
    for k in range(ticks):
        t = (k * PERIOD) % last
        if t < PERIOD:
            mpc.reset()
            q, v = mpc.reference.q[0].copy(), mpc.reference.v[0].copy()
        elif plan is not None:
            p = plan.at(t)
            q = np.concatenate([p.position, p.quat_xyzw, p.points.ravel()])
            v = np.concatenate([p.velocity, p.angular_velocity, p.point_velocities.ravel()])
            q[:3] += rng.normal(0, 0.003, 3)
            q[7:] += rng.normal(0, 0.003, len(q) - 7)
            v += rng.normal(0, 0.03, len(v))
        plan = yield t, q, v


def run_controller(mpc: Mpc, ticks: int, after: Callable[[Plan], None] | None = None) -> list[float]:
    """ms of the processor for each tick."""
    mpc.warm_up()
    states, times = noisy_states(mpc, ticks), []
    state = next(states)
    while True:
        began = time.thread_time()
        plan = mpc.step(*state)
        times.append(1e3 * (time.thread_time() - began))
        if after is not None:
            after(plan)
        try:
            state = states.send(plan)
        except StopIteration:
            return times


def quadratic(mpc: Mpc, plan: Plan):
    """P, g, A, b of a tick's QP (equations A z = b) with z = (du_0, dx_1, du_1, ...), and the limits of all z."""
    w, task = mpc._work, mpc._task
    H, nx, nu = w.B.shape
    n = nx + nu
    diagonal = np.concatenate([np.append(task.h[k] * task.w_u[k], task.h[k + 1] * task.w_x[k + 1]) for k in range(H)])
    rows = []
    for k in range(H):
        row = [sparse.csc_matrix((nx, n))] * H
        row[k] = sparse.hstack([-w.B[k], sparse.eye(nx)])
        if k:
            row[k - 1] = sparse.hstack([sparse.csc_matrix((nx, nu)), -w.A[k]])
        rows.append(row)
    free = np.full((H, nx), 1e3)
    low = np.hstack([task.u_low - plan.u, -free]).ravel()
    high = np.hstack([task.u_high - plan.u, free]).ravel()
    target = np.concatenate([np.append(task.u_ref[k] - plan.u[k], np.zeros(nx)) for k in range(H)])
    A = sparse.csc_matrix(sparse.bmat(rows))
    return sparse.diags(diagonal, format="csc"), -diagonal * target, A, w.gap.ravel(), low, high


class Others:
    """The other solvers at each tick of a controller."""

    def __init__(self, mpc: Mpc):
        self.mpc, self.times, self.failed = mpc, {}, {}
        form = SmoothForm(mpc.model, mpc._task)
        _, middle, last = form.knots
        self._form, H = form, mpc.config.horizon
        control = OptimalControl(middle, middle, last, N=H, plugin="fatrop")
        options = {"fatrop": dict(max_iter=100, tolerance=1e-4, constr_viol_tol=1e-6, print_level=0)}
        self._control = control
        self._fatrop = ca.nlpsol(
            "solver", "fatrop", control._problem,
            {"cache": control.functions, "calc_lam_p": False, "print_time": False, **control._structure, **options},
        )  # fmt: skip

    def __call__(self, plan: Plan) -> None:
        P, g, A, b, low, high = quadratic(self.mpc, plan)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        eye = sparse.eye(len(g), format="csc")
        stacked = sparse.vstack([A, eye, -eye], format="csc")
        cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(2 * len(g))]
        solver = clarabel.DefaultSolver(P, g, stacked, np.concatenate([b, high, -low]), cones, settings)
        self._time("clarabel", lambda: str(solver.solve().status) == "Solved")
        if proxqp is not None:
            qp = proxqp.sparse.QP(len(g), len(b), len(g))
            qp.init(P, g, A, b, eye, low, high)
            self._time("proxqp", lambda: (qp.solve(), qp.results.info.status.name == "PROXQP_SOLVED")[1])
        self._time("fatrop", self._solve_fatrop(plan))

    def _solve_fatrop(self, plan: Plan) -> Callable[[], bool]:
        task, form, C = self.mpc._task, self._form, self.mpc.model.C
        kappa, control = self.mpc.config.kappa, self._control
        z, end = form.pack(task, Iterate.at(plan.q, plan.v, plan.u, C=C, M=1), kappa)
        low, high = form.bounds(task)
        nx = len(end)
        low[0, :nx], high[0, :nx] = z[0, :nx] - 1e-7, z[0, :nx] + 1e-7
        free, gap, kinds = np.full(nx, np.inf), np.zeros(nx), control._kinds
        sides = [
            np.concatenate(
                [x for k, path in zip(kinds, side, strict=True) for x in ([gap] * (k.nn > 0) + [path]) * k.count]
            )
            for side in zip(*control._path_bounds, strict=True)
        ]
        given = dict(
            x0=np.append(z, end), p=form.parameters(task, kappa).ravel(), lbx=np.append(low, -free),
            ubx=np.append(high, free), lbg=sides[0], ubg=sides[1],
        )  # fmt: skip

        def solve() -> bool:
            self._fatrop(**given)
            return bool(self._fatrop.stats()["success"])

        return solve

    def _time(self, name: str, solve: Callable[[], bool]) -> None:
        began = time.thread_time()
        good = solve()
        self.times.setdefault(name, []).append(1e3 * (time.thread_time() - began))
        self.failed[name] = self.failed.get(name, 0) + (not good)


def side_by_side(model, ref, horizon: int, ticks: int) -> list[Row]:
    found: dict[str, list[float]] = {}
    for name in ("ncp", "lcp"):
        mpc = Mpc(model, ref, terrain=Terrain(), config=MpcConfig(horizon=horizon, mpc_model=name))
        found[name] = run_controller(mpc, ticks)
    others = Others(Mpc(model, ref, terrain=Terrain(), config=MpcConfig(horizon=horizon)))
    run_controller(others.mpc, max(ticks // 4, 20), others)
    found |= others.times
    first = float(np.median(found["ncp"]))
    return [
        Row(horizon, n, len(x), *map(float, np.percentile(x, [50, 99])), float(np.median(x)) / first,
            others.failed.get(n, 0))
        for n, x in found.items()
    ]  # fmt: skip


def endurance(model, ref, minutes: float) -> dict[str, float]:
    """The controller over and over: memory that Python and NumPy hold, and the median time, early and late."""
    mpc = Mpc(model, ref, terrain=Terrain(), config=MpcConfig())
    run_controller(mpc, 500)
    gc.collect()
    tracemalloc.start()
    ticks = round(minutes * 60 / PERIOD)
    tenth = max(ticks // 10, 200)
    early = float(np.median(run_controller(mpc, tenth)))
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    run_controller(mpc, max(ticks - 2 * tenth, 0) or 1)
    late = float(np.median(run_controller(mpc, tenth)))
    gc.collect()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return dict(ticks=ticks, growth_bytes=after - before, early_ms=early, late_ms=late)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--horizons", default="3,10,20")
    parser.add_argument("--ticks", type=int, default=400)
    parser.add_argument("--minutes", type=float, default=0.0, help="of control, for memory and drift; 0: none")
    parser.add_argument("--json", action="store_true", help="figures as JSON instead of a table")
    args = parser.parse_args()
    talk = Console(stderr=True)
    talk.print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", style="dim")
    if proxqp is None:
        talk.print("proxqp is left out: pip install proxsuite", style="yellow")
    model, ref = make_reference()
    rows = [row for H in map(int, args.horizons.split(",")) for row in side_by_side(model, ref, H, args.ticks)]
    lasting = endurance(model, ref, args.minutes) if args.minutes else None
    if args.json:
        print(json.dumps(dict(rows=[asdict(r) for r in rows], endurance=lasting)))
        return
    table = Table(title="One tick, ms of the processor", title_justify="left")
    for column in ("H", "solver", "ticks", "p50", "p99", "x ncp", "failed"):
        table.add_column(column, justify="left" if column == "solver" else "right")
    for r in rows:
        bar = f" (bar {BARS[r.horizon]:g})" if r.horizon in BARS and r.solver in ("ncp", "lcp") else ""
        table.add_row(
            f"{r.horizon}", r.solver, f"{r.ticks}", f"{r.p50:.2f}", f"{r.p99:.2f}{bar}", f"{r.ratio:.1f}", f"{r.failed}"
        )
    out = Console(width=110)
    out.print(table)
    if lasting:
        line = "{ticks} ticks: memory {growth_bytes:+d} bytes, median {early_ms:.2f} then {late_ms:.2f} ms"
        out.print(line.format(**lasting))


if __name__ == "__main__":
    main()
