"""Smooth contact of one point mass with the plane under it, in closed form.

In the plane's frame (unit normal n, tangents t) one implicit step of length h of a point of mass m, with gap phi,
velocity v, internal force -u and gravity g, has the free velocity v_free = v + h (-u/m + g). With a = h^2/m and
b = phi + h v_free_n, the relaxed complementarity gamma * phi_next = kappa with phi_next = b + a gamma gives

    gamma = (-b + sqrt(b^2 + 4 a kappa)) / (2 a)        > 0, and phi_next > 0, by construction.

Friction is the force that stops the point, f_s = -(m/h) v_free_t, brought inside the cone smoothly:

    f_t = f_s (1 + (|f_s| / (mu gamma))^6)^(-1/6),      |f_t| < mu gamma.

Both are smooth functions of (point, v, u, h), so no complementarity constraint is left in the optimisation; kappa -> 0
recovers the rigid contact (Stewart and Trinkle 1996, relaxed as in interior-point methods). A point that `sticks` has
f_t = f_s, so that it does not move along the plane at all; its cone is then a constraint of the problem.
"""

from math import copysign, sqrt

from slomo.optimize.jit import compiled


@compiled
def tangents(n0, n1, n2):
    """Two unit vectors that make a right-handed frame with a unit normal; x and y for z.

    Duff et al., "Building an orthonormal basis, revisited" (2017).
    """
    s = copysign(1.0, n2)
    a = -1.0 / (s + n2)
    b = n0 * n1 * a
    return (1.0 + s * n0 * n0 * a, s * b, -s * n0), (b, s + n1 * n1 * a, -n1)


@compiled
def _dot(a, x):
    return a[0] * x[0] + a[1] * x[1] + a[2] * x[2]


@compiled
def contact_force(plane, f, v, u, m, h, mu, g, kappa, stick, lam):
    """Contact force on a point into lam (3,), N, world.

    Args:
        plane: (4,) unit normal n and offset d; the gap is n . f - d.
        f, v, u: (3,) m, m/s and N, world.  m: kg.  h: s.  mu: friction coefficient.
        g: m/s^2.  kappa: N m, relaxed complementarity.  stick: whether it may not slide.

    Returns:
        (|f_t|, gamma), N.
    """
    n = (plane[0], plane[1], plane[2])
    t1, t2 = tangents(n[0], n[1], n[2])
    a = h * h / m
    b = _dot(n, f) - plane[3] + h * _dot(n, v) - a * (_dot(n, u) + m * g * n[2])
    root = sqrt(b * b + 4 * a * kappa)
    gamma = 2 * kappa / (b + root) if b > 0 else (root - b) / (2 * a)
    s1 = _dot(t1, u) - m / h * _dot(t1, v) + m * g * t1[2]
    s2 = _dot(t2, u) - m / h * _dot(t2, v) + m * g * t2[2]
    c = 1.0
    if not stick:
        r2 = (s1 * s1 + s2 * s2) / (mu * gamma) ** 2
        c = (1 + r2 * r2 * r2) ** (-1 / 6)
    s1, s2 = c * s1, c * s2
    for i in range(3):
        lam[i] = s1 * t1[i] + s2 * t2[i] + gamma * n[i]
    return sqrt(s1 * s1 + s2 * s2), gamma


@compiled
def contact_derivative(plane, f, v, u, m, h, mu, g, kappa, stick, lam, D):
    """`contact_force` with D (3, 10), the derivative of lam with respect to (f, v, u, h)."""
    n = (plane[0], plane[1], plane[2])
    t1, t2 = tangents(n[0], n[1], n[2])
    a = h * h / m
    vn, un = _dot(n, v), _dot(n, u) + m * g * n[2]
    b = _dot(n, f) - plane[3] + h * vn - a * un
    root = sqrt(b * b + 4 * a * kappa)
    gamma = 2 * kappa / (b + root) if b > 0 else (root - b) / (2 * a)
    v1, v2 = _dot(t1, v), _dot(t2, v)
    s1 = _dot(t1, u) - m / h * v1 + m * g * t1[2]
    s2 = _dot(t2, u) - m / h * v2 + m * g * t2[2]
    c, jxx, jxy, jyy, k1, k2 = 1.0, 1.0, 0.0, 1.0, 0.0, 0.0
    if not stick:
        # f_t = f_s c(r): df_t/df_s = c 1 - e f_s f_s^T with e = c r^4 / ((1 + r^6) cone^2), and
        # df_t/dgamma = f_s c r^6 / (1 + r^6) / gamma.
        cone2 = (mu * gamma) ** 2
        r2 = (s1 * s1 + s2 * s2) / cone2
        r6 = r2 * r2 * r2
        c = (1 + r6) ** (-1 / 6)
        e = c * r2 * r2 / ((1 + r6) * cone2)
        jxx, jxy, jyy = c - e * s1 * s1, -e * s1 * s2, c - e * s2 * s2
        k = c * (r6 / (1 + r6)) / gamma
        k1, k2 = k * s1, k * s2
    # gamma solves a gamma^2 + b gamma = kappa.
    db = -gamma / root
    dh = db * (vn - 2 * h / m * un) - gamma * gamma / root * (2 * h / m)
    d1, d2 = m / (h * h) * v1, m / (h * h) * v2
    for i in range(3):
        lam[i] = c * s1 * t1[i] + c * s2 * t2[i] + gamma * n[i]
        # Along the change of gamma, and along those of f_s.
        along = k1 * t1[i] + k2 * t2[i] + n[i]
        e1 = jxx * t1[i] + jxy * t2[i]
        e2 = jxy * t1[i] + jyy * t2[i]
        D[i, 9] = along * dh + e1 * d1 + e2 * d2
        for j in range(3):
            tangential = e1 * t1[j] + e2 * t2[j]
            normal = along * db * n[j]
            D[i, j] = normal
            D[i, 3 + j] = h * normal - m / h * tangential
            D[i, 6 + j] = tangential - a * normal
