"""Gauss-Newton differential dynamic programming with multiple shooting, compiled.

States and inputs are both unknown; gaps f(x_k, u_k) - x_{k+1} between the pieces are closed by the Newton steps
themselves (Giftthaler et al., "A family of iterative Gauss-Newton shooting methods", 2018). Input limits are a box
solved exactly in the backward pass (Tassa et al. 2014). A Levenberg-Marquardt term and an l1 merit
function make every step a descent step. The work is linear in the number of knots.
"""

from math import inf, isfinite

import numpy as np

from slomo.optimize.closing import end_cost, end_gap
from slomo.optimize.cost import input_cost, state_cost
from slomo.optimize.dense import copy
from slomo.optimize.dynamics import minus, plus
from slomo.optimize.jit import compiled
from slomo.optimize.linear_body import task_step
from slomo.optimize.load import load_cost
from slomo.optimize.reach import reach_cost
from slomo.optimize.riccati import backward

CONVERGED, ITERATIONS, STUCK, NOT_FINITE = 0, 1, 2, 3
STATUS = ("converged", "iteration limit", "no descent", "not finite")

# Least weight of the gaps in the merit function. Near an optimum the cost's slope vanishes while closing a gap still
# costs in second order; without this the line search refuses the good step, as for a robot that simply stands.
_LEAST_PENALTY = 1e-2


@compiled
def length(body, task, u, k):
    """Length of step k, s: given, or the input after the forces."""
    C = body.hips.shape[0]
    return u[3 * C] if u.shape[0] > 3 * C else task.h[k]


@compiled
def evaluate(body, task, kappa, it, rho, gap, w):
    """Cost of an iterate (its lam is written) and the l1 norm of its gaps (N, nx, written)."""
    N = it.us.shape[0]
    J = total = 0.0
    for k in range(N):
        u = it.us[k]
        task_step(body, task, kappa, k, length(body, task, u, k), it.qs[k], it.vs[k], u, w.q1, w.v1, it.lam[k])
        J += input_cost(body, task, k, it.vs[k], u, w.v1, it.lam[k], it.cone[k], rho)
        J += load_cost(task.load, k, u, it.loads[k], rho)
        minus(w.q1, w.v1, it.qs[k + 1], it.vs[k + 1], gap[k])
        for i in range(gap.shape[1]):
            total += abs(gap[k, i])
    for k in range(N + 1):
        J += state_cost(body, task, k, it.qs[k], it.vs[k], it.multiplier[k], rho)
        J += load_cost(task.speed, k, it.vs[k], it.speeds[k], rho)
        J += reach_cost(task.reach, k, it.qs[k], it.beyond[k], rho)
    if task.cyclic:
        end_gap(task, it.qs[0], it.vs[0], it.qs[N], it.vs[N], w.end)
        J += end_cost(w.end, it.closing, rho)
    return J, total


@compiled
def forward(task, it, w):
    """The full Newton step w.dx, w.du from w.dx[0]; returns the slope of the cost along it."""
    N, nu = it.us.shape
    nx = w.dx.shape[1]
    slope = 0.0
    for k in range(N):
        for i in range(nu):
            s = w.k[k, i]
            for j in range(nx):
                s += w.K[k, i, j] * w.dx[k, j]
            if task.cyclic:
                for j in range(nx):
                    s += w.Kt[k, i, j] * w.dx[0, j]
            w.du[k, i] = s
        for i in range(nx):
            s = w.gap[k, i]
            for j in range(nx):
                s += w.A[k, i, j] * w.dx[k, j]
            for j in range(nu):
                s += w.B[k, i, j] * w.du[k, j]
            w.dx[k + 1, i] = s
        for i in range(nu):
            s = min(max(w.du[k, i], task.u_low[k, i] - it.us[k, i]), task.u_high[k, i] - it.us[k, i])
            w.du[k, i] = s
            slope += w.Lu[k, i] * s
    for k in range(N + 1):
        for i in range(nx):
            slope += w.Lx[k, i] * w.dx[k, i]
    if task.cyclic:
        for i in range(nx):
            slope += w.Lt[i] * w.dx[0, i]
    return slope


@compiled
def solve(body, task, kappa, it, rho, free_start, max_iterations, tolerance, closed, reg, w):
    """Improves an iterate in place, for one kappa and one set of multipliers.

    Args:
        body, task: see `Body` and `Task`.
        kappa: N m.  it: start, and result.  rho: penalty of the constraints.
        free_start: whether the first state is unknown too.
        max_iterations, tolerance: of the decrease still expected, relative to the cost.
        closed: l1 norm of the gaps that counts as none.
        reg: Levenberg-Marquardt factor to start with.
        w: scratch; its gains K and gaps belong to the result.

    Returns:
        (status, iterations, cost, l1 norm of the gaps, reg).
    """
    N = it.us.shape[0]
    J, G = evaluate(body, task, kappa, it, rho, w.gap, w)
    nu = _LEAST_PENALTY
    copy(it.multiplier, w.trial.multiplier)
    copy(it.cone, w.trial.cone)
    copy(it.loads, w.trial.loads)
    copy(it.speeds, w.trial.speeds)
    copy(it.beyond, w.trial.beyond)
    for i in range(it.closing.shape[0]):
        w.trial.closing[i] = it.closing[i]
    if not isfinite(J + G):
        return NOT_FINITE, 0, J, G, reg
    for iteration in range(max_iterations):
        accepted = False
        for _ in range(12):
            slope = inf
            if backward(body, task, kappa, it, rho, reg, free_start, w):
                slope = forward(task, it, w)
            if isfinite(slope):
                if G > 1e-12:
                    nu = max(nu, 2.0 * max(slope, 0.0) / G)
                descent = slope - nu * G
                if descent > -tolerance * (1.0 + J) and closed > G:
                    return CONVERGED, iteration, J, G, reg
                alpha = 1.0
                for _ in range(8):
                    for k in range(N + 1):
                        plus(it.qs[k], it.vs[k], w.dx[k], alpha, w.trial.qs[k], w.trial.vs[k])
                    for k in range(N):
                        for i in range(it.us.shape[1]):
                            w.trial.us[k, i] = it.us[k, i] + alpha * w.du[k, i]
                    Jt, Gt = evaluate(body, task, kappa, w.trial, rho, w.trial_gap, w)
                    if isfinite(Jt + Gt) and Jt + nu * Gt <= J + nu * G + 1e-4 * alpha * descent:
                        accepted = True
                        break
                    alpha *= 0.5
                if accepted:
                    copy(w.trial.qs, it.qs)
                    copy(w.trial.vs, it.vs)
                    copy(w.trial.us, it.us)
                    copy(w.trial_gap, w.gap)
                    for k in range(N):
                        copy(w.trial.lam[k], it.lam[k])
                    J, G = Jt, Gt
                    if alpha > 0.4:
                        reg = max(reg / 4.0, 1e-9)
                    elif alpha < 0.1:
                        reg = max(4.0 * reg, 1e-4)
                    break
            reg = max(8.0 * reg, 1e-4)
        if not accepted:
            return STUCK, iteration, J, G, reg
    return ITERATIONS, max_iterations, J, G, reg


@compiled
def close(body, task, kappa, it, w):
    """Roll the iterate out with its feedback gains, so that its dynamics hold to rounding."""
    N, nu = it.us.shape
    d = np.empty(w.dx.shape[1])
    q, v = np.empty(it.qs.shape[1]), np.empty(it.vs.shape[1])
    for i in range(q.shape[0]):
        q[i] = it.qs[0, i]
    for i in range(v.shape[0]):
        v[i] = it.vs[0, i]
    for k in range(N):
        minus(q, v, it.qs[k], it.vs[k], d)
        for i in range(q.shape[0]):
            it.qs[k, i] = q[i]
        for i in range(v.shape[0]):
            it.vs[k, i] = v[i]
        for i in range(nu):
            s = it.us[k, i]
            for j in range(d.shape[0]):
                s += w.K[k, i, j] * d[j]
            it.us[k, i] = min(max(s, task.u_low[k, i]), task.u_high[k, i])
        task_step(body, task, kappa, k, length(body, task, it.us[k], k), it.qs[k], it.vs[k], it.us[k], q, v, it.lam[k])
    for i in range(q.shape[0]):
        it.qs[N, i] = q[i]
    for i in range(v.shape[0]):
        it.vs[N, i] = v[i]
