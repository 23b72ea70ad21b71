"""Gauss-Newton differential dynamic programming with multiple shooting, compiled.

States and inputs are both unknown; gaps f(x_k, u_k) - x_{k+1} between the pieces are closed by the Newton steps
themselves (Giftthaler et al., "A family of iterative Gauss-Newton shooting methods", 2018). Input limits are a box
solved exactly in the backward pass (Tassa et al. 2014). A Levenberg-Marquardt term and an l1 merit
function make every step a descent step. The work is linear in the number of knots.
"""

from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from slomo.optimize.cost import input_cost, input_derivative, state_cost, state_derivative
from slomo.optimize.dense import box_qp, copy, solve_lower, solve_upper, transpose_times
from slomo.optimize.dynamics import linearize, minus, plus, step
from slomo.optimize.jit import compiled

Array = np.ndarray

CONVERGED, ITERATIONS, STUCK, NOT_FINITE = 0, 1, 2, 3
STATUS = ("converged", "iteration limit", "no descent", "not finite")

# Proximal weights of the Levenberg-Marquardt term: positions, velocities, inputs (1/m^2, s^2/m^2, 1/N^2).
_PROX_Q, _PROX_V, _PROX_U = 1.0, 1e-2, 1e-4
# Least weight of the gaps in the merit function. Near an optimum the cost's slope vanishes while closing a gap still
# costs in second order; without this the line search refuses the good step, as for a robot that simply stands.
_LEAST_PENALTY = 1e-2


class Iterate(NamedTuple):
    """qs (N + 1, 7 + 3 C), vs (N + 1, 6 + 3 C), us (N, 3 C), lam (N, C, 3); multiplier (N + 1, C, 2) of leg limits."""

    qs: Array
    vs: Array
    us: Array
    lam: Array
    multiplier: Array


class Work(NamedTuple):
    """Everything else that a solve writes to; `K` (N, 3 C, nx) are the feedback gains, `gap` (N, nx) the defects."""

    A: Array
    B: Array
    D: Array
    Lx: Array
    Lu: Array
    K: Array
    k: Array
    dx: Array
    du: Array
    gap: Array
    trial: Iterate
    trial_gap: Array
    q1: Array
    v1: Array

    @classmethod
    def make(cls, N: int, C: int) -> "Work":
        nv, nu = 6 + 3 * C, 3 * C
        nx = 2 * nv
        z = np.zeros
        return cls(
            A=z((N, nx, nx)), B=z((N, nx, nu)), D=z((C, 3, 7)), Lx=z((N + 1, nx)), Lu=z((N, nu)),
            K=z((N, nu, nx)), k=z((N, nu)), dx=z((N + 1, nx)), du=z((N, nu)), gap=z((N, nx)),
            trial=Iterate(z((N + 1, nv + 1)), z((N + 1, nv)), z((N, nu)), z((N, C, 3)), z((N + 1, C, 2))),
            trial_gap=z((N, nx)), q1=z(nv + 1), v1=z(nv),
        )  # fmt: skip


@compiled
def evaluate(body, task, kappa, it, rho, gap, q1, v1):
    """Cost of an iterate (its lam is written) and the l1 norm of its gaps (N, nx, written)."""
    N = it.us.shape[0]
    J = total = 0.0
    for k in range(N):
        step(body, task.h[k], kappa, task.heights[k + 1], it.qs[k], it.vs[k], it.us[k], q1, v1, it.lam[k])
        J += input_cost(body, task, k, it.us[k], v1, it.lam[k])
        minus(q1, v1, it.qs[k + 1], it.vs[k + 1], gap[k])
        for i in range(gap.shape[1]):
            total += abs(gap[k, i])
    for k in range(N + 1):
        J += state_cost(body, task, k, it.qs[k], it.vs[k], it.multiplier[k], rho)
    return J, total


@compiled
def backward(body, task, kappa, it, rho, reg, free_start, w):
    """Riccati pass about an iterate whose gaps are in w.gap: gains and the first step w.dx[0]. False: reg too small."""
    N, nu = it.us.shape
    nx = w.dx.shape[1]
    nv = nx // 2
    Vx, Vxx = np.zeros(nx), np.zeros((nx, nx))
    Qxx, Qux, Quu, Qu = np.empty((nx, nx)), np.empty((nu, nx)), np.empty((nu, nu)), np.empty(nu)
    AtV, VA = np.empty((nx, nx)), np.empty((nx, nx))
    BtV, VB = np.empty((nu, nx)), np.empty((nx, nu))
    S, L = np.empty((nu, nx)), np.empty((nx, nx))
    lower, upper = np.empty(nx), np.empty(nx)
    index, scratch = np.empty(nx, np.int64), np.empty((nx, 1))
    for k in range(N, -1, -1):
        Lx = w.Lx[k]
        for i in range(nx):
            Lx[i] = 0.0
        if k == N:
            state_derivative(body, task, k, it.qs[k], it.vs[k], it.multiplier[k], rho, Lx, Vxx)
            for i in range(nx):
                Vx[i] = Lx[i]
        else:
            A, B, Lu = w.A[k], w.B[k], w.Lu[k]
            q, v, u, height = it.qs[k], it.vs[k], it.us[k], task.heights[k + 1]
            linearize(body, task.h[k], kappa, height, q, v, u, w.q1, w.v1, it.lam[k], A, B, w.D)
            for i in range(nx):
                for j in range(nx):
                    Vx[i] += Vxx[i, j] * w.gap[k, j]
            transpose_times(A, Vxx, AtV)
            transpose_times(B, Vxx, BtV)
            for i in range(nx):
                for j in range(nx):
                    VA[j, i] = AtV[i, j]
                for j in range(nu):
                    VB[i, j] = BtV[j, i]
            transpose_times(A, VA, Qxx)
            transpose_times(B, VA, Qux)
            transpose_times(B, VB, Quu)
            for i in range(nu):
                Lu[i] = 0.0
            input_derivative(body, task, k, it.us[k], w.v1, it.lam[k], A, B, w.D, Lx, Lu, Qxx, Quu, Qux)
            state_derivative(body, task, k, it.qs[k], it.vs[k], it.multiplier[k], rho, Lx, Qxx)
            for i in range(nu):
                Quu[i, i] += reg * _PROX_U
                lower[i], upper[i] = -body.u_max[i] - it.us[k, i], body.u_max[i] - it.us[k, i]
                s = Lu[i]
                for j in range(nx):
                    s += B[j, i] * Vx[j]
                Qu[i] = s
            n = box_qp(Quu, Qu, lower, upper, w.k[k], index, L, scratch)
            if n < 0:
                return False
            # K_free = -Quu_free^-1 Qux_free; V = Qxx - S^T S with S = L^-1 Qux_free.
            K = w.K[k]
            for i in range(nu):
                for j in range(nx):
                    K[i, j] = 0.0
            for i in range(n):
                for j in range(nx):
                    S[i, j] = Qux[index[i], j]
            solve_lower(L, n, S)
            for i in range(nx):
                s = Lx[i]
                for j in range(nx):
                    s += A[j, i] * Vx[j]
                for j in range(nu):
                    s += Qux[j, i] * w.k[k, j]
                scratch[i, 0] = s
            for i in range(nx):
                Vx[i] = scratch[i, 0]
            copy(Qxx, Vxx)
            for m in range(n):
                for i in range(nx):
                    s = S[m, i]
                    for j in range(nx):
                        Vxx[i, j] -= s * S[m, j]
            solve_upper(L, n, S)
            for i in range(n):
                for j in range(nx):
                    K[index[i], j] = -S[i, j]
        for i in range(nx):
            Vxx[i, i] += reg * (_PROX_Q if i < nv else _PROX_V)
            for j in range(i):
                Vxx[i, j] = Vxx[j, i] = 0.5 * (Vxx[i, j] + Vxx[j, i])
    if free_start:
        # Any start, but with its points not under the ground.
        for i in range(nx):
            lower[i], upper[i] = -inf, inf
        for c in range(nu // 3):
            lower[8 + 3 * c] = task.heights[0, c] - it.qs[0, 9 + 3 * c]
        return box_qp(Vxx, Vx, lower, upper, w.dx[0], index, L, scratch) >= 0
    for i in range(nx):
        w.dx[0, i] = 0.0
    return True


@compiled
def forward(body, it, w):
    """The full Newton step w.dx, w.du from w.dx[0]; returns the slope of the cost along it."""
    N, nu = it.us.shape
    nx = w.dx.shape[1]
    slope = 0.0
    for k in range(N):
        for i in range(nu):
            s = w.k[k, i]
            for j in range(nx):
                s += w.K[k, i, j] * w.dx[k, j]
            s = min(max(s, -body.u_max[i] - it.us[k, i]), body.u_max[i] - it.us[k, i])
            w.du[k, i] = s
            slope += w.Lu[k, i] * s
        for i in range(nx):
            s = w.gap[k, i]
            for j in range(nx):
                s += w.A[k, i, j] * w.dx[k, j]
            for j in range(nu):
                s += w.B[k, i, j] * w.du[k, j]
            w.dx[k + 1, i] = s
    for k in range(N + 1):
        for i in range(nx):
            slope += w.Lx[k, i] * w.dx[k, i]
    return slope


@compiled
def solve(body, task, kappa, it, rho, free_start, max_iterations, tolerance, reg, w):
    """Improves an iterate in place, for one kappa and one set of multipliers.

    Args:
        body, task: see `Body` and `Task`.
        kappa: N m.  it: start, and result.  rho: penalty of the leg limits.
        free_start: whether the first state is unknown too.
        max_iterations, tolerance: of the decrease still expected, relative to the cost.
        reg: Levenberg-Marquardt factor to start with.
        w: scratch; its gains K and gaps belong to the result.

    Returns:
        (status, iterations, cost, l1 norm of the gaps, reg).
    """
    N = it.us.shape[0]
    J, G = evaluate(body, task, kappa, it, rho, w.gap, w.q1, w.v1)
    nu = _LEAST_PENALTY
    if not isfinite(J + G):
        return NOT_FINITE, 0, J, G, reg
    for iteration in range(max_iterations):
        accepted = False
        for _ in range(12):
            slope = inf
            if backward(body, task, kappa, it, rho, reg, free_start, w):
                slope = forward(body, it, w)
            if isfinite(slope):
                if G > 1e-12:
                    nu = max(nu, 2.0 * max(slope, 0.0) / G)
                descent = slope - nu * G
                if descent > -tolerance * (1.0 + J) and G < 1e-7:
                    return CONVERGED, iteration, J, G, reg
                alpha = 1.0
                for _ in range(8):
                    for k in range(N + 1):
                        plus(it.qs[k], it.vs[k], w.dx[k], alpha, w.trial.qs[k], w.trial.vs[k])
                        copy(it.multiplier[k], w.trial.multiplier[k])
                    for k in range(N):
                        for i in range(it.us.shape[1]):
                            w.trial.us[k, i] = it.us[k, i] + alpha * w.du[k, i]
                    Jt, Gt = evaluate(body, task, kappa, w.trial, rho, w.trial_gap, w.q1, w.v1)
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
            it.us[k, i] = min(max(s, -body.u_max[i]), body.u_max[i])
        step(body, task.h[k], kappa, task.heights[k + 1], it.qs[k], it.vs[k], it.us[k], q, v, it.lam[k])
    for i in range(q.shape[0]):
        it.qs[N, i] = q[i]
    for i in range(v.shape[0]):
        it.vs[N, i] = v[i]
