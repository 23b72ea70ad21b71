"""Small dense linear algebra for compiled code: what a knot needs, without allocation or BLAS overhead."""

from math import sqrt

import numpy as np
from numba import njit


@njit(cache=True)
def transpose_times(A, V, out):
    """out = A^T V, skipping zeros of A: A (n, m), V (n, p), out (m, p)."""
    n, m = A.shape
    p = V.shape[1]
    for i in range(m):
        for j in range(p):
            out[i, j] = 0.0
    for k in range(n):
        for i in range(m):
            a = A[k, i]
            if a != 0.0:
                for j in range(p):
                    out[i, j] += a * V[k, j]


@njit(cache=True)
def cholesky(H, index, n, L):
    """L (lower, n x n) of H restricted to index[:n]. False when it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            s = H[index[i], index[j]]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@njit(cache=True)
def solve_lower(L, n, X):
    """X (n, p) <- L^-1 X, in place."""
    p = X.shape[1]
    for i in range(n):
        for k in range(i):
            a = L[i, k]
            for j in range(p):
                X[i, j] -= a * X[k, j]
        a = 1.0 / L[i, i]
        for j in range(p):
            X[i, j] *= a


@njit(cache=True)
def solve_upper(L, n, X):
    """X (n, p) <- L^-T X, in place."""
    p = X.shape[1]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            a = L[k, i]
            for j in range(p):
                X[i, j] -= a * X[k, j]
        a = 1.0 / L[i, i]
        for j in range(p):
            X[i, j] *= a


@njit(cache=True)
def box_qp(H, g, lower, upper, x, index, L, work):
    """x = argmin (1/2) x^T H x + g^T x within lower <= x <= upper, by projected Newton steps.

    Bertsekas, "Projected Newton methods" (1982), as in Tassa, Mansard, Todorov, "Control-limited differential dynamic
    programming" (2014), section III-B. H (n, n) positive definite. index (n,) int and work (n, 1) are scratch.

    Returns:
        Number of free variables; index[:free] are they and L their factor. -1 when H is not positive definite.
    """
    n = g.shape[0]
    for i in range(n):
        x[i] = min(max(0.0, lower[i]), upper[i])
    free = 0
    for _ in range(50):
        free = 0
        for i in range(n):
            s = g[i]
            for j in range(n):
                s += H[i, j] * x[j]
            if (x[i] <= lower[i] and s > 0) or (x[i] >= upper[i] and s < 0):
                continue
            index[free] = i
            work[free, 0] = -s
            free += 1
        if not cholesky(H, index, free, L):
            return -1
        slope = 0.0
        for i in range(free):
            slope += work[i, 0] * work[i, 0]
        if slope < 1e-24:
            return free
        solve_lower(L, free, work[:free])
        solve_upper(L, free, work[:free])
        alpha = 1.0
        inside = False
        for _ in range(30):
            # Decrease along the projected arc.
            inside = True
            change = 0.0
            for i in range(free):
                y = x[index[i]] + alpha * work[i, 0]
                if y < lower[index[i]] or y > upper[index[i]]:
                    inside = False
            if inside:
                break
            for i in range(free):
                a = index[i]
                di = min(max(x[a] + alpha * work[i, 0], lower[a]), upper[a]) - x[a]
                s = g[a]
                for j in range(n):
                    s += H[a, j] * x[j]
                for j in range(free):
                    b = index[j]
                    s += 0.5 * H[a, b] * (min(max(x[b] + alpha * work[j, 0], lower[b]), upper[b]) - x[b])
                change += di * s
            if change < 0.0:
                break
            alpha *= 0.5
        for i in range(free):
            a = index[i]
            x[a] = min(max(x[a] + alpha * work[i, 0], lower[a]), upper[a])
        if inside and alpha == 1.0:
            # A full Newton step within the bounds: optimal unless a bound lets go, which the next pass would see.
            released = False
            for i in range(n):
                s = g[i]
                for j in range(n):
                    s += H[i, j] * x[j]
                at_bound = True
                for j in range(free):
                    at_bound = at_bound and index[j] != i
                if at_bound and not ((x[i] <= lower[i] and s > 0) or (x[i] >= upper[i] and s < 0)):
                    released = True
            if not released:
                return free
    return free
