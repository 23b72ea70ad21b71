"""Small dense linear algebra for compiled code: what a knot needs, without allocation or BLAS overhead."""

from math import sqrt

from slomo.optimize.jit import compiled


@compiled
def copy(source, target):
    """target = source, both (n, m)."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@compiled
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


@compiled
def symmetric_times(A, VA, out):
    """Lower triangle of out = A^T VA where that is symmetric, skipping zeros of A: A and VA (n, m), out (m, m)."""
    n, m = A.shape
    for i in range(m):
        for j in range(i + 1):
            out[i, j] = 0.0
    for k in range(n):
        for i in range(m):
            a = A[k, i]
            if a != 0.0:
                for j in range(i + 1):
                    out[i, j] += a * VA[k, j]


@compiled
def subtract_square(S, n, out):
    """Lower triangle of out (m, m) -= S^T S with the first n rows of S (., m)."""
    for k in range(n):
        for i in range(out.shape[0]):
            s = S[k, i]
            for j in range(i + 1):
                out[i, j] -= s * S[k, j]


@compiled
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


@compiled
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


@compiled
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


@compiled
def _free_set(H, g, lower, upper, x, index, descent):
    """Number of variables that no bound holds at x: index[:number], and descent[:number, 0] minus their gradient."""
    number = 0
    for i in range(g.shape[0]):
        s = g[i]
        for j in range(g.shape[0]):
            s += H[i, j] * x[j]
        if not ((x[i] <= lower[i] and s > 0) or (x[i] >= upper[i] and s < 0)):
            index[number] = i
            descent[number, 0] = -s
            number += 1
    return number


@compiled
def box_qp(H, g, lower, upper, x, index, L, d):
    """x = argmin (1/2) x^T H x + g^T x within lower <= x <= upper, by projected Newton steps.

    Bertsekas, "Projected Newton methods" (1982), as in Tassa, Mansard, Todorov, "Control-limited differential dynamic
    programming" (2014), section III-B. H (n, n) positive definite. index (n,) int and d (n, 1) are scratch.

    Returns:
        Number of free variables; index[:free] are they and L their factor. -1 when H is not positive definite.
    """
    n = g.shape[0]
    scale = 0.0
    for i in range(n):
        x[i] = min(max(0.0, lower[i]), upper[i])
        scale += g[i] * g[i]
    free = _free_set(H, g, lower, upper, x, index, d)
    for _ in range(50):
        if not cholesky(H, index, free, L):
            return -1
        squares = 0.0
        for i in range(free):
            squares += d[i, 0] * d[i, 0]
        if squares <= 1e-22 * scale:
            break
        solve_lower(L, free, d)
        solve_upper(L, free, d)
        # Halve the step until the cost falls along the projected arc; inside the bounds the Newton step is the minimum.
        alpha = 1.0
        for _ in range(30):
            inside = True
            for i in range(free):
                a = index[i]
                inside = inside and lower[a] <= x[a] + alpha * d[i, 0] <= upper[a]
            change = -1.0
            if not inside:
                change = 0.0
                for i in range(free):
                    a = index[i]
                    s = g[a]
                    for j in range(n):
                        s += H[a, j] * x[j]
                    for j in range(free):
                        b = index[j]
                        s += 0.5 * H[a, b] * (min(max(x[b] + alpha * d[j, 0], lower[b]), upper[b]) - x[b])
                    change += s * (min(max(x[a] + alpha * d[i, 0], lower[a]), upper[a]) - x[a])
            if change < 0.0:
                break
            alpha *= 0.5
        for i in range(free):
            a = index[i]
            x[a] = min(max(x[a] + alpha * d[i, 0], lower[a]), upper[a])
        free = _free_set(H, g, lower, upper, x, index, d)
    return free
