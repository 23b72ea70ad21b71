"""The right-invariant extended Kalman filter of a legged robot, compiled.

State: attitude R (world from root), velocity v, position p, N points d that stand on the ground (all world), biases of
gyroscope and accelerometer. Its error xi is that of the group, X_estimated = exp(xi) X_true in SE_{2+N}(3), in the
order R, v, p, d_1..d_N, gyro bias, accelerometer bias; so neither a leg's measurement nor, but for the biases, the
error's propagation depends on the estimate itself (Hartley, Ghaffari, Eustice, Grizzle 2020, "Contact-aided invariant
extended Kalman filtering for robot state estimation"; its world-centric, right-invariant form).
"""

import numpy as np

from slomo.optimize.jit import compiled


@compiled
def _skew(a, out):
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -a[2], a[1], -a[0]
    out[1, 0], out[2, 0], out[2, 1] = a[2], -a[1], a[0]


@compiled
def _exponential(w, E, J):
    """E = exp(w^) and J its left Jacobian (Rodrigues), both (3, 3)."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-6:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle2
        c = (1 - a) / angle2
    W = np.empty((3, 3))
    _skew(w, W)
    for i in range(3):
        for j in range(3):
            square = w[i] * w[j] - (angle2 if i == j else 0.0)
            one = 1.0 if i == j else 0.0
            E[i, j] = one + a * W[i, j] + b * square
            J[i, j] = one + b * W[i, j] + c * square


@compiled
def _times(A, x, out):
    """out = A x, (3, 3) (3,)."""
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@compiled
def _put(A, M, i, j, factor):
    """A[i:i+3, j:j+3] = factor * M."""
    for a in range(3):
        for b in range(3):
            A[i + a, j + b] = factor * M[a, b]


@compiled
def _cross_rotated(a, R, out):
    """out = a^ R, (3, 3)."""
    for j in range(3):
        out[0, j] = a[1] * R[2, j] - a[2] * R[1, j]
        out[1, j] = a[2] * R[0, j] - a[0] * R[2, j]
        out[2, j] = a[0] * R[1, j] - a[1] * R[0, j]


@compiled
def transition(R, v, p, d, dt, g, Phi, G):
    """Phi (n, n): how the error goes on in dt, to first order; G (n, 6): how the noise of the IMU enters."""
    n, N = Phi.shape[0], d.shape[0]
    gyro, accelerometer = n - 6, n - 3
    for i in range(n):
        for j in range(n):
            Phi[i, j] = 1.0 if i == j else 0.0
        for j in range(6):
            G[i, j] = 0.0
    M = np.empty((3, 3))
    _put(Phi, R, 0, gyro, -dt)
    _put(G, R, 0, 0, 1.0)
    for k in range(2 + N):
        _cross_rotated(v if k == 0 else p if k == 1 else d[k - 2], R, M)
        _put(Phi, M, 3 + 3 * k, gyro, -dt)
        _put(G, M, 3 + 3 * k, 0, 1.0)
    Phi[3, 1], Phi[4, 0] = g * dt, -g * dt  # (0, 0, -g)^
    _put(Phi, R, 3, accelerometer, -dt)
    _put(G, R, 3, 3, 1.0)
    for i in range(3):
        Phi[6 + i, 3 + i] = dt


@compiled
def predict(R, v, p, d, bias, P, gyro, acceleration, drift, dt, g, noise, foot_noise):
    """Propagate by one sample, in place.

    Args:
        R (3, 3), v (3,) m/s, p (3,) m, d (N, 3) m, bias (6,), P (n, n), n = 15 + 3 N.
        gyro: (3,) rad/s, acceleration: (3,) m/s^2, as measured.
        drift: (N, 3) m/s, world: how the points move (rolling feet).
        noise: (4,) densities: gyro rad/s/sqrt(Hz), accelerometer m/s^2/sqrt(Hz), and of the biases' random walks.
        foot_noise: (N,) m/sqrt(s), of each point's random walk.
    """
    n, N = P.shape[0], d.shape[0]
    Phi, G, T = np.empty((n, n)), np.empty((n, 6)), np.empty((n, n))
    transition(R, v, p, d, dt, g, Phi, G)
    for i in range(n):
        for j in range(n):
            x = P[i, j]
            for k in range(n):
                if k != i and Phi[i, k] != 0.0:
                    x += Phi[i, k] * P[k, j]
            T[i, j] = x
    # Symmetric to the last bit: no measurement takes away what rounding makes asymmetric, and integrating it twice made
    # it grow with the fourth power of time, until after six minutes it was larger than the variances.
    for i in range(n):
        for j in range(i + 1):
            x = T[i, j]
            for k in range(n):
                if k != j and Phi[j, k] != 0.0:
                    x += T[i, k] * Phi[j, k]
            P[i, j] = P[j, i] = x
    for i in range(n - 6):
        for j in range(n - 6):
            x = 0.0
            for k in range(6):
                s = noise[0] if k < 3 else noise[1]
                x += G[i, k] * G[j, k] * s * s
            P[i, j] += x * dt
    for k in range(3):
        P[n - 6 + k, n - 6 + k] += noise[2] ** 2 * dt
        P[n - 3 + k, n - 3 + k] += noise[3] ** 2 * dt
    for c in range(N):
        for k in range(3):
            i = 9 + 3 * c + k
            P[i, i] += foot_noise[c] ** 2 * dt
            d[c, k] += drift[c, k] * dt

    w, a = np.empty(3), np.empty(3)
    E, J, f = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(3):
        w[i] = (gyro[i] - bias[i]) * dt
        a[i] = acceleration[i] - bias[3 + i]
    _exponential(w, E, J)
    _times(J, a, f)  # the mean force over the step, in the frame of its start
    _times(R, f, a)
    a[2] -= g
    for i in range(3):
        p[i] += v[i] * dt + 0.5 * a[i] * dt * dt
        v[i] += a[i] * dt
    turned = R @ E
    for i in range(3):
        for j in range(3):
            R[i, j] = turned[i, j]


@compiled
def _take(P, xi, H, z, variance):
    """One scalar measurement z = H xi + noise: updates P (n, n) and the error's mean xi (n,), in place."""
    n = P.shape[0]
    PH = np.zeros(n)
    total, expected = variance, 0.0
    for i in range(n):
        for j in range(n):
            PH[i] += P[i, j] * H[j]
    for i in range(n):
        total += H[i] * PH[i]
        expected += H[i] * xi[i]
    for i in range(n):
        xi[i] += PH[i] / total * (z - expected)
        for j in range(n):
            P[i, j] -= PH[i] * PH[j] / total


@compiled
def _remove(R, v, p, d, bias, xi):
    """Take the error xi (n,) out of the estimate: X = exp(-xi) X, in place."""
    n = xi.shape[0]
    E, J, x, y = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(n):
        xi[i] = -xi[i]
    _exponential(xi, E, J)
    for k in range(2 + d.shape[0]):
        a = v if k == 0 else p if k == 1 else d[k - 2]
        _times(E, a, x)
        _times(J, xi[3 + 3 * k :], y)
        for i in range(3):
            a[i] = x[i] + y[i]
    turned = E @ R
    for i in range(3):
        for j in range(3):
            R[i, j] = turned[i, j]
    for i in range(6):
        bias[i] += xi[n - 6 + i]


@compiled
def correct_legs(R, v, p, d, bias, P, h, sigma):
    """The legs' kinematics say that the points are at h (N, 3) m in the root's frame, give or take sigma (m)."""
    n = P.shape[0]
    xi, z = np.zeros(n), np.empty(3)
    for c in range(d.shape[0]):
        _times(R, h[c], z)
        for i in range(3):
            # R h - (d - p) = xi_p - xi_d
            H = np.zeros(n)
            H[6 + i], H[9 + 3 * c + i] = 1.0, -1.0
            _take(P, xi, H, z[i] - d[c, i] + p[i], sigma * sigma)
    _remove(R, v, p, d, bias, xi)


@compiled
def correct_height(R, v, p, d, bias, P, c, height, sigma):
    """Point c is at this height (m, world), give or take sigma (m)."""
    n = P.shape[0]
    xi, H = np.zeros(n), np.zeros(n)
    # d_estimated - d = xi_d + xi_R x d
    H[0], H[1], H[9 + 3 * c + 2] = d[c, 1], -d[c, 0], 1.0
    _take(P, xi, H, d[c, 2] - height, sigma * sigma)
    _remove(R, v, p, d, bias, xi)


@compiled
def forget_place(P, sigma_heading, sigma_place):
    """Count errors from where the root is believed to be now: to it the world is moved and turned that is called true.

    Heading and place on the ground are seen by no measurement, so estimates stay as they are, while variances that
    would grow without end start anew from sigma_heading (rad) and sigma_place (m). To turn the world about its z axis
    adds to xi_R alone, in this filter's error, and to move it, to xi_p and each xi_d alike: P becomes A P A^T with
    A = I - (these directions) (these components of R and p).
    """
    n = P.shape[0]
    for k, sigma in ((2, sigma_heading), (6, sigma_place), (7, sigma_place)):
        last = 3 if k == 2 else n - 6
        row = P[k].copy()
        for i in range(n):
            for j in range(i + 1):
                moved_i = k <= i < last and (i - k) % 3 == 0
                moved_j = k <= j < last and (j - k) % 3 == 0
                x = P[i, j]
                if moved_i and moved_j:
                    x += row[k] - (row[i] + row[j]) + sigma * sigma
                elif moved_i:
                    x -= row[j]
                elif moved_j:
                    x -= row[i]
                P[i, j] = P[j, i] = x
