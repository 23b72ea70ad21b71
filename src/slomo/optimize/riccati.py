"""The backward pass of the solver: a Riccati recursion with input limits, and with a cyclic end where there is one."""

from math import inf

import numpy as np

from slomo.optimize.closing import end_derivative, end_gap
from slomo.optimize.cost import input_derivative, state_derivative
from slomo.optimize.dense import (
    box_qp,
    copy,
    solve_lower,
    solve_upper,
    subtract_square,
    symmetric_times,
    transpose_times,
)
from slomo.optimize.jit import compiled
from slomo.optimize.linear_body import task_linearize
from slomo.optimize.load import load_derivative
from slomo.optimize.reach import reach_derivative

# Proximal weights of the Levenberg-Marquardt term: positions, velocities, inputs (1/m^2, s^2/m^2, 1/N^2), step length.
_PROX_Q, _PROX_V, _PROX_U, _PROX_H = 1.0, 1e-2, 1e-4, 1e2


@compiled
def backward(body, task, kappa, it, rho, reg, free_start, w):
    """Riccati pass about an iterate whose gaps are in w.gap: gains and the first step w.dx[0]. False: reg too small.

    The end of a cyclic motion depends on its start: then the value function carries the first step dt as a parameter,
    V(dx, dt) = Vx dx + Vt dt + (1/2) dx Vxx dx + dx Vxt dt + (1/2) dt Vtt dt, and the gains have a part K_t dt.
    """
    N, nu = it.us.shape
    nx, nf = w.dx.shape[1], 3 * body.hips.shape[0]
    nv = nx // 2
    nt = nx if task.cyclic else 0
    Vt, Vxt, Vtt = np.zeros(nt), np.zeros((nx, nt)), np.zeros((nt, nt))
    Qxt, Qut, St = np.empty((nx, nt)), np.empty((nu, nt)), np.empty((nu, nt))
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
            reach_derivative(task.reach, k, it.qs[k], it.beyond[k], rho, Lx, Vxx)
            load_derivative(task.speed, k, it.vs[k], it.speeds[k], rho, Lx[nv:], Vxx[nv:, nv:])
            for i in range(nx):
                Vx[i] = Lx[i]
            if task.cyclic:
                end_gap(task, it.qs[0], it.vs[0], it.qs[N], it.vs[N], w.end)
                end_derivative(task, w.end, it.closing, rho, Vx, Vxx, Vt, Vxt, Vtt)
                for i in range(nx):
                    Lx[i] = Vx[i]
                    w.Lt[i] = Vt[i]
        else:
            A, B, Lu = w.A[k], w.B[k], w.Lu[k]
            q, v, u = it.qs[k], it.vs[k], it.us[k]
            h = u[nf] if nu > nf else task.h[k]
            task_linearize(body, task, kappa, k, h, q, v, u, w.q1, w.v1, it.lam[k], A, B, w.D)
            for i in range(nx):
                for j in range(nx):
                    Vx[i] += Vxx[i, j] * w.gap[k, j]
                for j in range(nt):
                    Vt[j] += Vxt[i, j] * w.gap[k, i]
            transpose_times(A, Vxx, AtV)
            transpose_times(B, Vxx, BtV)
            for i in range(nx):
                for j in range(nx):
                    VA[j, i] = AtV[i, j]
                for j in range(nu):
                    VB[i, j] = BtV[j, i]
            symmetric_times(A, VA, Qxx)
            transpose_times(B, VA, Qux)
            transpose_times(B, VB, Quu)
            for i in range(nu):
                Lu[i] = 0.0
            input_derivative(body, task, k, v, u, w.v1, it.lam[k], it.cone[k], rho, A, B, w.D, Lx, Lu, Qxx, Quu, Qux)
            load_derivative(task.load, k, u, it.loads[k], rho, Lu, Quu)
            state_derivative(body, task, k, it.qs[k], it.vs[k], it.multiplier[k], rho, Lx, Qxx)
            reach_derivative(task.reach, k, it.qs[k], it.beyond[k], rho, Lx, Qxx)
            load_derivative(task.speed, k, it.vs[k], it.speeds[k], rho, Lx[nv:], Qxx[nv:, nv:])
            for i in range(nu):
                Quu[i, i] += reg * (_PROX_U if i < nf else _PROX_H)
                lower[i], upper[i] = task.u_low[k, i] - u[i], task.u_high[k, i] - u[i]
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
                lower[i] = Lx[i]
            for j in range(nx):
                for i in range(nx):
                    lower[i] += A[j, i] * Vx[j]
            for j in range(nu):
                for i in range(nx):
                    lower[i] += Qux[j, i] * w.k[k, j]
            for i in range(nx):
                Vx[i] = lower[i]
            copy(Qxx, Vxx)
            if task.cyclic:
                transpose_times(A, Vxt, Qxt)
                transpose_times(B, Vxt, Qut)
                for j in range(nt):
                    for i in range(nu):
                        Vt[j] += Qut[i, j] * w.k[k, i]
                        w.Kt[k, i, j] = 0.0
                    for i in range(n):
                        St[i, j] = Qut[index[i], j]
                solve_lower(L, n, St)
                for m in range(n):
                    for i in range(nx):
                        for j in range(nt):
                            Qxt[i, j] -= S[m, i] * St[m, j]
                    for i in range(nt):
                        for j in range(nt):
                            Vtt[i, j] -= St[m, i] * St[m, j]
                copy(Qxt, Vxt)
                solve_upper(L, n, St)
                for i in range(n):
                    for j in range(nt):
                        w.Kt[k, index[i], j] = -St[i, j]
            subtract_square(S, n, Vxx)
            solve_upper(L, n, S)
            for i in range(n):
                for j in range(nx):
                    K[index[i], j] = -S[i, j]
        for i in range(nx):
            Vxx[i, i] += reg * (_PROX_Q if i < nv else _PROX_V)
            for j in range(i):
                Vxx[j, i] = Vxx[i, j]
    if free_start:
        for i in range(nt):
            Vx[i] += Vt[i]
            for j in range(nt):
                Vxx[i, j] += Vxt[i, j] + Vxt[j, i] + Vtt[i, j]
        # Any start, but with its points not under the ground.
        for i in range(nx):
            lower[i], upper[i] = -inf, inf
        for c in range(nf // 3):
            plane, f = task.ground[0, c], it.qs[0, 7 + 3 * c : 10 + 3 * c]
            lower[8 + 3 * c] = (plane[3] - plane[0] * f[0] - plane[1] * f[1]) / plane[2] - f[2]
        return box_qp(Vxx, Vx, lower, upper, w.dx[0], index, L, scratch) >= 0
    for i in range(nx):
        w.dx[0, i] = 0.0
    return True
