"""State constraints g(q) <= 0 (and = 0), which the solver holds by an augmented Lagrangian.

For C points, P pairs and K directions (toe and heel of a foot), in this order:

    C   leg_min <= |p + R hip - f|                   C   |p + R hip - f| <= leg_max
    C   (R^T (f - p))_z <= -clearance                points stay below the body
    C K n . R^T (f - p) <= d                         and within the hull of what their joints reach (last)
    P   |f_a - f_b| = pair_length                    2 P |(f_a - f_b)_z| <= pair_length sin(TILT): feet stay about level
"""

from math import sin, sqrt

import numpy as np

from slomo.optimize import so3
from slomo.optimize.jit import compiled

TILT = 0.6  # rad, steepest foot: about what an ankle allows
_SIN_TILT = sin(TILT)


@compiled
def number(body):
    """How many constraints a state has."""
    return body.hips.shape[0] * (3 + body.directions.shape[0]) + 3 * body.pairs.shape[0]


@compiled
def is_equality(body, n):
    """Whether constraint n is g = 0."""
    first = 3 * body.hips.shape[0]
    return first <= n < first + body.pairs.shape[0]


@compiled
def _leg(body, q, R, c, d):
    """Vector d (3,) from point to hip and its length."""
    for i in range(3):
        d[i] = q[i] - q[7 + 3 * c + i]
        for k in range(3):
            d[i] += R[i, k] * body.hips[c, k]
    return max(sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9)


@compiled
def _place(q, R, c, x):
    """x (3,) = R^T (f - p), a point in the body frame."""
    for i in range(3):
        x[i] = 0.0
        for k in range(3):
            x[i] += R[k, i] * (q[7 + 3 * c + k] - q[k])


@compiled
def _apart(body, q, p, d):
    """Vector d (3,) from the second to the first point of pair p and its length."""
    a, b = 7 + 3 * body.pairs[p, 0], 7 + 3 * body.pairs[p, 1]
    for i in range(3):
        d[i] = q[a + i] - q[b + i]
    return max(sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9)


@compiled
def values(body, q, out):
    """out (number,): g, m; positive is a violation."""
    C, P = body.hips.shape[0], body.pairs.shape[0]
    R, d = np.empty((3, 3)), np.empty(3)
    so3.matrix(q[3:7], R)
    K = body.directions.shape[0]
    for c in range(C):
        length = _leg(body, q, R, c, d)
        out[c] = body.leg_min[c] - length
        out[C + c] = length - body.leg_max[c]
        _place(q, R, c, d)
        out[2 * C + c] = d[2] + body.clearance[c]
        for k in range(K):
            n = body.directions[k]
            out[3 * C + 3 * P + c * K + k] = n[0] * d[0] + n[1] * d[1] + n[2] * d[2] - body.workspace[c, k]
    for p in range(P):
        length = _apart(body, q, p, d)
        out[3 * C + p] = length - body.pair_length[p]
        most = body.pair_length[p] * _SIN_TILT
        out[3 * C + P + p] = d[2] - most
        out[3 * C + 2 * P + p] = -d[2] - most


@compiled
def gradient(body, q, R, n, index, grad):
    """Nonzero entries of the derivative of g_n in the tangent space: grad[:count] at index[:count]; returns count.

    R: (3, 3) of q.  index, grad: (9,).
    """
    C, P = body.hips.shape[0], body.pairs.shape[0]
    d = np.empty(3)
    if n < 2 * C:
        c = n % C
        sign = (-1.0 if n < C else 1.0) / _leg(body, q, R, c, d)
        # d = p + R hip - f: dp, d(R exp(w) hip) = R [w] hip = -R [hip] w, -df.
        b0 = sign * (R[0, 0] * d[0] + R[1, 0] * d[1] + R[2, 0] * d[2])
        b1 = sign * (R[0, 1] * d[0] + R[1, 1] * d[1] + R[2, 1] * d[2])
        b2 = sign * (R[0, 2] * d[0] + R[1, 2] * d[1] + R[2, 2] * d[2])
        hip = body.hips[c]
        grad[3], grad[4], grad[5] = hip[1] * b2 - hip[2] * b1, hip[2] * b0 - hip[0] * b2, hip[0] * b1 - hip[1] * b0
        for i in range(3):
            grad[i], grad[6 + i] = sign * d[i], -sign * d[i]
            index[i], index[3 + i], index[6 + i] = i, 3 + i, 6 + 3 * c + i
        return 9
    if n < 3 * C or n >= 3 * C + 3 * P:
        K = body.directions.shape[0]
        c = n - 2 * C if n < 3 * C else (n - 3 * C - 3 * P) // K
        a0, a1, a2 = 0.0, 0.0, 1.0
        if n >= 3 * C:
            normal = body.directions[(n - 3 * C - 3 * P) % K]
            a0, a1, a2 = normal[0], normal[1], normal[2]
        _place(q, R, c, d)
        for i in range(3):
            grad[6 + i] = R[i, 0] * a0 + R[i, 1] * a1 + R[i, 2] * a2
            grad[i] = -grad[6 + i]
            index[i], index[3 + i], index[6 + i] = i, 3 + i, 6 + 3 * c + i
        # x = R^T (f - p): dx = [x] w.
        grad[3], grad[4], grad[5] = a1 * d[2] - a2 * d[1], a2 * d[0] - a0 * d[2], a0 * d[1] - a1 * d[0]
        return 9
    p = (n - 3 * C) % P
    a, b = 6 + 3 * body.pairs[p, 0], 6 + 3 * body.pairs[p, 1]
    if n < 3 * C + P:
        length = _apart(body, q, p, d)
        for i in range(3):
            grad[i], grad[3 + i] = d[i] / length, -d[i] / length
            index[i], index[3 + i] = a + i, b + i
        return 6
    sign = 1.0 if n < 3 * C + 2 * P else -1.0
    grad[0], grad[1] = sign, -sign
    index[0], index[1] = a + 2, b + 2
    return 2


@compiled
def add_curvature(body, q, R, n, force, H):
    """Adds force * (second derivative of g_n) to H (nx, nx) where it is positive semidefinite: longest legs and pairs.

    |d| curves with (1 - d d^T / |d|^2) / |d|: a force along a link holds it sideways too. Without this the Gauss-Newton
    step overshoots several times. The second derivative of the rotation itself is left out.
    """
    C, P = body.hips.shape[0], body.pairs.shape[0]
    d, J, index = np.empty(3), np.zeros((3, 9)), np.empty(9, np.int64)
    if C <= n < 2 * C:
        c, count = n - C, 9
        length = _leg(body, q, R, c, d)
        hip = body.hips[c]
        for i in range(3):
            J[i, i], J[i, 6 + i] = 1.0, -1.0
            # d(R exp(w) hip) = -R [hip] w.
            J[i, 3] = R[i, 2] * hip[1] - R[i, 1] * hip[2]
            J[i, 4] = R[i, 0] * hip[2] - R[i, 2] * hip[0]
            J[i, 5] = R[i, 1] * hip[0] - R[i, 0] * hip[1]
            index[i], index[3 + i], index[6 + i] = i, 3 + i, 6 + 3 * c + i
    elif 3 * C <= n < 3 * C + P:
        p, count = n - 3 * C, 6
        length = _apart(body, q, p, d)
        for i in range(3):
            J[i, i], J[i, 3 + i] = 1.0, -1.0
            index[i], index[3 + i] = 6 + 3 * body.pairs[p, 0] + i, 6 + 3 * body.pairs[p, 1] + i
    else:
        return
    if not force > 0.0:
        return
    along = np.zeros(9)
    for a in range(count):
        for i in range(3):
            along[a] += d[i] * J[i, a] / length
    for a in range(count):
        for b in range(count):
            s = -along[a] * along[b]
            for i in range(3):
                s += J[i, a] * J[i, b]
            H[index[a], index[b]] += force / length * s
