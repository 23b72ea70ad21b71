"""Rotations for compiled code: unit quaternions (xyzw) with the tangent space on the right, R <- R exp(w).

Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), equations 132 to 147.
"""

from math import atan2, cos, sin, sqrt

from slomo.optimize.jit import compiled


@compiled
def matrix(quat_xyzw, R):
    """Rotation matrix of a unit quaternion into R (3, 3)."""
    x, y, z, w = quat_xyzw[0], quat_xyzw[1], quat_xyzw[2], quat_xyzw[3]
    R[0, 0] = 1 - 2 * (y * y + z * z)
    R[0, 1] = 2 * (x * y - w * z)
    R[0, 2] = 2 * (x * z + w * y)
    R[1, 0] = 2 * (x * y + w * z)
    R[1, 1] = 1 - 2 * (x * x + z * z)
    R[1, 2] = 2 * (y * z - w * x)
    R[2, 0] = 2 * (x * z - w * y)
    R[2, 1] = 2 * (y * z + w * x)
    R[2, 2] = 1 - 2 * (x * x + y * y)


@compiled
def plus(a, wx, wy, wz, out):
    """out = a * exp(w), normalised."""
    angle2 = wx * wx + wy * wy + wz * wz
    angle = sqrt(angle2)
    s = sin(0.5 * angle) / angle if angle > 1e-8 else 0.5 - angle2 / 48
    x, y, z, w = s * wx, s * wy, s * wz, cos(0.5 * angle)
    o0 = a[3] * x + a[0] * w + a[1] * z - a[2] * y
    o1 = a[3] * y - a[0] * z + a[1] * w + a[2] * x
    o2 = a[3] * z + a[0] * y - a[1] * x + a[2] * w
    o3 = a[3] * w - a[0] * x - a[1] * y - a[2] * z
    n = 1 / sqrt(o0 * o0 + o1 * o1 + o2 * o2 + o3 * o3)
    out[0], out[1], out[2], out[3] = o0 * n, o1 * n, o2 * n, o3 * n


@compiled
def minus(b, a, out):
    """out (3,) = log(a^-1 b): the tangent vector that leads from a to b, of length at most pi."""
    x = a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1]
    y = a[3] * b[1] + a[0] * b[2] - a[1] * b[3] - a[2] * b[0]
    z = a[3] * b[2] - a[0] * b[1] + a[1] * b[0] - a[2] * b[3]
    w = a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if w < 0:
        x, y, z, w = -x, -y, -z, -w
    n = sqrt(x * x + y * y + z * z)
    s = 2 * atan2(n, w) / n if n > 1e-10 else 2.0
    out[0], out[1], out[2] = s * x, s * y, s * z


@compiled
def _series(w, J, alpha, beta):
    """J = 1 + alpha [w] + beta [w]^2."""
    x, y, z = w[0], w[1], w[2]
    J[0, 0] = 1 - beta * (y * y + z * z)
    J[1, 1] = 1 - beta * (x * x + z * z)
    J[2, 2] = 1 - beta * (x * x + y * y)
    J[0, 1] = beta * x * y - alpha * z
    J[1, 0] = beta * x * y + alpha * z
    J[0, 2] = beta * x * z + alpha * y
    J[2, 0] = beta * x * z - alpha * y
    J[1, 2] = beta * y * z - alpha * x
    J[2, 1] = beta * y * z + alpha * x


@compiled
def exp_matrix(w, R):
    """R (3, 3) = exp([w])."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    a = sqrt(a2)
    if a > 1e-5:
        _series(w, R, sin(a) / a, (1 - cos(a)) / a2)
    else:
        _series(w, R, 1 - a2 / 6, 0.5 - a2 / 24)


@compiled
def right_jacobian(w, J):
    """J (3, 3): exp(w + d) = exp(w) exp(J d) to first order (Sola 143)."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    a = sqrt(a2)
    if a > 1e-4:
        _series(w, J, -(1 - cos(a)) / a2, (a - sin(a)) / (a2 * a))
    else:
        _series(w, J, -0.5 + a2 / 24, 1 / 6 - a2 / 120)


@compiled
def right_jacobian_inverse(w, J):
    """J (3, 3): log(exp(w) exp(d)) = w + J d to first order (Sola 144)."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    a = sqrt(a2)
    if a > 1e-3:
        _series(w, J, 0.5, 1 / a2 - (1 + cos(a)) / (2 * a * sin(a)) if a < 3.1 else 1 / a2)
    else:
        _series(w, J, 0.5, 1 / 12 + a2 / 720)
