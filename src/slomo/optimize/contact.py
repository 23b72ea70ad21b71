"""Smooth contact of one point mass with flat ground, in closed form.

One implicit step of length h of a point of mass m, with gap phi, velocity v, internal force -u and gravity, has the
free velocity v_free = v + h (-u/m - g e_z). With a = h^2/m and b = phi + h v_free_z, the relaxed complementarity
gamma * phi_next = kappa with phi_next = b + a gamma gives

    gamma = (-b + sqrt(b^2 + 4 a kappa)) / (2 a)        > 0, and phi_next > 0, by construction.

Friction is the force that stops the point, f_s = -(m/h) v_free_xy, brought inside the cone smoothly:

    f_t = f_s (1 + (|f_s| / (mu gamma))^6)^(-1/6),      |f_t| < mu gamma.

Both are smooth functions of (phi, v, u), so no complementarity constraint is left in the optimisation; kappa -> 0
recovers the rigid contact (Stewart and Trinkle 1996, relaxed as in interior-point methods).
"""

from math import sqrt

from slomo.optimize.jit import compiled


@compiled
def contact_force(phi, v, u, m, h, mu, g, kappa, lam):
    """Contact force on a point into lam (3,), N, world.

    Args:
        phi: m, height over the ground.  v, u: (3,) m/s and N.  m: kg.  h: s.  mu: friction coefficient.
        g: m/s^2.  kappa: N m, relaxed complementarity.
    """
    a = h * h / m
    b = phi + h * v[2] - a * (u[2] + m * g)
    root = sqrt(b * b + 4 * a * kappa)
    gamma = 2 * kappa / (b + root) if b > 0 else (root - b) / (2 * a)
    sx = u[0] - m / h * v[0]
    sy = u[1] - m / h * v[1]
    r2 = (sx * sx + sy * sy) / (mu * gamma) ** 2
    c = (1 + r2 * r2 * r2) ** (-1 / 6)
    lam[0], lam[1], lam[2] = sx * c, sy * c, gamma


@compiled
def contact_derivative(phi, v, u, m, h, mu, g, kappa, lam, D):
    """`contact_force` with D (3, 7), its derivative with respect to (phi, v, u)."""
    a = h * h / m
    b = phi + h * v[2] - a * (u[2] + m * g)
    root = sqrt(b * b + 4 * a * kappa)
    gamma = 2 * kappa / (b + root) if b > 0 else (root - b) / (2 * a)
    sx = u[0] - m / h * v[0]
    sy = u[1] - m / h * v[1]
    cone2 = (mu * gamma) ** 2
    r2 = (sx * sx + sy * sy) / cone2
    r6 = r2 * r2 * r2
    c = (1 + r6) ** (-1 / 6)
    lam[0], lam[1], lam[2] = sx * c, sy * c, gamma

    dgamma_db = -gamma / root
    D[2, 0] = dgamma_db
    D[2, 1] = D[2, 2] = 0.0
    D[2, 3] = h * dgamma_db
    D[2, 4] = D[2, 5] = 0.0
    D[2, 6] = -a * dgamma_db
    # f_t = f_s c(r): df_t/df_s = c 1 - e f_s f_s^T with e = c r^4 / ((1 + r^6) cone^2), and
    # df_t/dgamma = f_s c r^6 / (1 + r^6) / gamma.
    e = c * r2 * r2 / ((1 + r6) * cone2)
    jxx, jxy, jyy = c - e * sx * sx, -e * sx * sy, c - e * sy * sy
    k = c * (r6 / (1 + r6)) / gamma
    for i in range(2):
        js_x, js_y = (jxx, jxy) if i == 0 else (jxy, jyy)
        kg = k * (sx if i == 0 else sy)
        D[i, 0] = kg * D[2, 0]
        D[i, 1] = -m / h * js_x
        D[i, 2] = -m / h * js_y
        D[i, 3] = kg * D[2, 3]
        D[i, 4] = js_x
        D[i, 5] = js_y
        D[i, 6] = kg * D[2, 6]
