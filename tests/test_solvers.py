"""The solvers behind the same task: they agree where they should, and say so where they fail."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench_optimize import PROBLEMS, SHARED, check
from gaits import gait, humanoid, on, quadruped, reference
from slomo.errors import UsageError
from slomo.optimize import problem
from slomo.optimize.casadi_nlp import OptimalControl
from slomo.optimize.closing import end_gap
from slomo.optimize.cycle import close, end_shift
from slomo.optimize.fatrop import SmoothForm, solve_fatrop
from slomo.optimize.ipopt import solve_ipopt
from slomo.optimize.solve import Settings, solve
from slomo.optimize.verify import verify
from slomo.terrain import Slope, Terrain

FLAT = Terrain()
SETTINGS = Settings(kappas=(1e-1, 1e-2, 1e-3, 5e-5))


def make(model, duration, *, terrain=FLAT, steps=None, **motion):
    """Task and start of a gait."""
    want = on(gait(model, duration, **motion), terrain)
    task = problem.make_task(model, want, terrain, problem.Weights(), steps=steps)
    return task, problem.make_start(model, want, task)


@pytest.mark.parametrize("plugin", ["fatrop", "ipopt"])
def test_assembled_derivatives_are_those_of_the_whole_problem(plugin):
    model, rng = quadruped(), np.random.default_rng(0)
    task, start = make(model, 0.2)
    form = SmoothForm(model, task)
    control = OptimalControl(*form.knots, N=4, plugin=plugin)
    f = control.functions
    z, end = form.pack(task, start, 1e-2)
    x = np.append(z, end)
    x += 1e-2 * rng.normal(size=len(x))
    p, lam_f = form.parameters(task, 1e-2).ravel(), 0.7
    lam = rng.normal(size=f["nlp_g"].numel_out(0))
    X, P = ca.MX.sym("X", len(x)), ca.MX.sym("P", len(p))
    F, G = f["nlp_f"](X, P), f["nlp_g"](X, P)
    L = lam_f * F + ca.dot(lam, G)
    whole = ca.Function("w", [X, P], [ca.gradient(F, X), ca.jacobian(G, X), ca.gradient(L, X), ca.hessian(L, X)[0]])
    slope, jacobian, slope_l, hessian = (np.array(ca.DM(y).full()) for y in whole(x, p))
    scale = np.abs(hessian).max()
    got = f["nlp_grad_f"](x, p)
    assert np.allclose(np.array(got if plugin == "fatrop" else got[1]), slope, atol=1e-9 * np.abs(slope).max())
    assert np.allclose(f["nlp_jac_g"](x, p)[1].full(), jacobian, atol=1e-9 * np.abs(jacobian).max())
    got = f["nlp_hess_l"](x, p, lam_f, lam)
    if plugin == "fatrop":
        assert np.allclose(got[0].full(), slope_l, atol=1e-9 * np.abs(slope_l).max())
        assert np.allclose(got[1].full(), hessian, atol=1e-9 * scale)
    else:
        assert np.allclose(got.full(), np.triu(hessian), atol=1e-9 * scale)


def apart(a, b):
    """Largest differences of two iterates: positions (m) and orientations (rad)."""
    turn = (Rotation.from_quat(a.qs[:, 3:7]).inv() * Rotation.from_quat(b.qs[:, 3:7])).magnitude().max()
    return np.abs(np.delete(a.qs - b.qs, np.s_[3:7], axis=1)).max(), turn


@pytest.mark.parametrize(
    ("model", "terrain", "motion"),
    [
        (quadruped(), FLAT, {}),
        (quadruped(), FLAT, {"turn": 2.0}),
        (quadruped(), Terrain(slopes=(Slope(-9, 9, -9, 9, -1.35, 0.1, 0.05),)), {}),
        (humanoid(), FLAT, {}),
    ],
    ids=["trot", "turning", "slope", "person"],
)
def test_fatrop_finds_what_the_compiled_solver_finds(model, terrain, motion):
    task, start = make(model, 0.5, terrain=terrain, **motion)
    ours = solve(model, task, start, terrain=terrain, settings=SETTINGS)
    other = solve_fatrop(model, task, start, terrain=terrain, settings=SETTINGS)
    assert ours.status == other.status == "converged"
    assert other.cost == pytest.approx(ours.cost, rel=1e-2)
    moved, turned = apart(ours.iterate, other.iterate)
    assert moved < 2e-3
    assert turned < 5e-3
    assert other.violation <= 1.001e-5
    checks = verify(model, reference(model, task, other), terrain=terrain)
    assert [n for n, c in checks.items() if not c.holds] == []


@pytest.mark.parametrize("slope", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_the_published_form_verifies(slope):
    """Hard complementarity and Coulomb's pyramid: about the motion that the smooth contact gives."""
    terrain = Terrain(slopes=(Slope(-9, 9, -9, 9, -9 * slope, slope),))
    model = quadruped()
    task, start = make(model, 0.4, terrain=terrain)
    ours = solve(model, task, start, terrain=terrain, settings=SETTINGS)
    other = solve_ipopt(model, task, start, terrain=terrain, settings=SETTINGS)
    assert other.status == "converged"
    checks = verify(model, reference(model, task, other), terrain=terrain)
    assert [n for n, c in checks.items() if not c.holds] == []
    if slope == 0.0:
        assert other.cost == pytest.approx(ours.cost, rel=1e-2)
        moved, turned = apart(ours.iterate, other.iterate)
        assert moved < 1e-3
        assert turned < 1e-3
    else:
        # There is more than one optimum, where feet stand a little elsewhere; both solvers find good ones.
        assert other.cost == pytest.approx(ours.cost, rel=0.2)


def test_the_compiled_solution_is_feasible_for_casadi():
    """Same discretisation to rounding: CasADi's constraints hold at the compiled solver's result."""
    model = quadruped()
    task, start = make(model, 0.5, turn=2.0)
    ours = solve(model, task, start, terrain=FLAT)
    kappa = Settings().kappas[-1]
    form = SmoothForm(model, task._replace(ground=FLAT.planes(ours.iterate.qs[:, 7:].reshape(-1, 4, 3))))
    control = OptimalControl(*form.knots, N=len(task.u_ref), plugin="fatrop")
    x = np.append(*form.pack(task, ours.iterate, kappa))
    g = control.functions["nlp_g"](x, form.parameters(task, kappa).ravel()).full()[:, 0]
    nx = 36
    rows = form.knots[1].path.numel() + nx
    first = form.knots[0].path.numel() + nx
    gaps = np.concatenate([g[:nx], g[first : first + 9 * rows].reshape(9, rows)[:, :nx].ravel()])
    assert np.abs(gaps).max() < 1e-9


def test_step_lengths_as_unknowns():
    model = quadruped()
    task, start = make(model, 0.4, steps=problem.Steps(shortest=0.8, longest=1.2, weight=1e-3))
    other = solve_fatrop(model, task, start, terrain=FLAT)
    assert other.status == "converged"
    h = other.iterate.us[:, -1]
    assert np.all((h > 0.8 * 0.05 - 1e-6) & (h < 1.2 * 0.05 + 1e-6))
    assert np.ptp(h) > 1e-4
    assert other.cost == pytest.approx(solve(model, task, start, terrain=FLAT).cost, rel=1e-2)


def test_points_that_may_not_slide_are_refused():
    model = quadruped()
    task, start = make(model, 0.2)
    with pytest.raises(UsageError, match="strict"):
        solve_fatrop(model, task, start, terrain=FLAT, settings=Settings(strict=True))
    with pytest.raises(UsageError, match="strict"):
        solve_ipopt(model, task._replace(stick=~task.stick), start, terrain=FLAT)


@pytest.mark.slow
def test_a_cycle_closes():
    """One stride of a turning trot, end and start the same but for the way that it went; two solvers, one optimum."""
    model = quadruped()
    want = close(gait(model, 0.4, turn=0.5), 0, 8)
    task = problem.make_task(model, want, FLAT, problem.Weights())
    task, start = task._replace(cyclic=True, shift=end_shift(want)), problem.make_start(model, want, task)
    costs = []
    for solver in (solve, solve_fatrop, solve_ipopt):
        other = solver(model, task, start, terrain=FLAT, settings=SETTINGS)
        assert other.status == "converged"
        e, it = np.zeros(36), other.iterate
        end_gap(task, it.qs[0], it.vs[0], it.qs[-1], it.vs[-1], e)
        assert np.abs(e).max() < 1e-6
        checks = verify(model, reference(model, task, other), terrain=FLAT)
        assert [n for n, c in checks.items() if not c.holds] == []
        costs.append(other.cost)
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-2)


def test_a_solver_out_of_iterations_says_so_and_keeps_its_iterate():
    model = quadruped()
    task, start = make(model, 0.4)
    other = solve_fatrop(model, task, start, terrain=FLAT, settings=Settings(iterations=2, early_iterations=2))
    assert other.status != "converged"
    assert not other.converged
    assert np.all(np.isfinite(other.iterate.qs))


def test_a_solver_out_of_time_says_so_and_keeps_its_iterate():
    model = quadruped()
    task, start = make(model, 0.4)
    other = solve_ipopt(model, task, start, terrain=FLAT, seconds=0.1)
    assert other.status == "time limit"
    assert np.all(np.isfinite(other.iterate.qs))
    assert np.ptp(other.iterate.lam) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cat00", "dog_cpr"])
def test_what_the_compiled_solver_finds_of_published_motions_is_an_optimum(name):
    """An interior-point method with exact Hessians, started there, ends where it began."""
    if not (SHARED / f"{name}.json").exists():
        pytest.skip(f"{SHARED / name}.json is not there")
    p = PROBLEMS[name]()
    task = problem.make_task(p.model, p.want, p.terrain, problem.Weights())
    start = problem.make_start(p.model, p.want, task)
    ours = solve(p.model, task, start, terrain=p.terrain, settings=SETTINGS)
    assert ours.status == "converged"
    other = check(p.model, task, ours.iterate, terrain=p.terrain, settings=SETTINGS)
    assert other.status == "converged"
    assert other.cost == pytest.approx(ours.cost, rel=1e-2)
    moved, turned = apart(ours.iterate, other.iterate)
    assert moved < 1e-2
    assert turned < 2e-2
