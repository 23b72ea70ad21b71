"""The point-foot model, its smooth contact and the task's cost as CasADi expressions: the same problem, second author.

Everything here says again, for CasADi's solvers, what `dynamics`, `contact`, `constraints` and `cost` compute in
compiled code; tests hold the two against each other. A state is a vector x (12 + 6 C) in tangent order: position,
rotation vector d from the task's orientation (R = R_ref exp(d)), points, velocity, angular velocity, point velocities.
So no unit-norm constraint is needed and rotations are exact as long as they stay within pi of what is wanted.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from slomo.optimize.casadi_nlp import Fields
from slomo.optimize.constraints import TILT
from slomo.optimize.cost import Task
from slomo.pointfoot import PointFootModel
from slomo.robot_workspace import directions

Array = np.ndarray

# Below these squares of an angle a series replaces sin and atan2: exact to rounding, and smooth through zero.
_SMALL = 1e-2
_SMALL_LOG = 1e-3
# m, how far the distance of a pair may be off. While both points stick their distance cannot change, so equations at
# every knot would depend on one another.
PAIR_TOLERANCE = 1e-5


def exponential(w: ca.SX) -> ca.SX:
    """Unit quaternion xyzw of a rotation vector (3,)."""
    s = ca.dot(w, w)
    small = s < _SMALL
    angle = ca.sqrt(ca.if_else(small, 1.0, s))
    near = 1 / 2 - s / 48 + s**2 / 3840 - s**3 / 645120 + s**4 / 185794560
    scale = ca.if_else(small, near, ca.sin(angle / 2) / angle)
    near = 1 - s / 8 + s**2 / 384 - s**3 / 46080 + s**4 / 10321920
    return ca.vertcat(scale * w, ca.if_else(small, near, ca.cos(angle / 2)))


def logarithm(quat_xyzw: ca.SX) -> ca.SX:
    """Rotation vector (3,), of length at most pi, of a unit quaternion."""
    q = ca.if_else(quat_xyzw[3] < 0, -1.0, 1.0) * quat_xyzw
    n2, w = ca.dot(q[:3], q[:3]), q[3]
    small = n2 < _SMALL_LOG
    c = ca.if_else(small, w, 1.0)
    t2 = n2 / (c * c)
    near = 2 / c * (1 - t2 / 3 + t2**2 / 5 - t2**3 / 7 + t2**4 / 9 - t2**5 / 11)
    n = ca.sqrt(ca.if_else(small, 1.0, n2))
    return ca.if_else(small, near, 2 * ca.atan2(n, w) / n) * q[:3]


def multiply(a: ca.SX, b: ca.SX) -> ca.SX:
    """Product of quaternions xyzw."""
    return ca.vertcat(a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3]), a[3] * b[3] - ca.dot(a[:3], b[:3]))


def conjugate(a: ca.SX) -> ca.SX:
    """Inverse of a unit quaternion xyzw."""
    return ca.vertcat(-a[:3], a[3])


def matrix(quat_xyzw: ca.SX) -> ca.SX:
    """Rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = (quat_xyzw[i] for i in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


class State(NamedTuple):
    """Parts of a state vector: columns of f and vf (3, C) are the points; d as in the module's text."""

    p: ca.SX
    d: ca.SX
    f: ca.SX
    v: ca.SX
    w: ca.SX
    vf: ca.SX

    @classmethod
    def of(cls, x: ca.SX) -> "State":
        nv = x.numel() // 2
        f, vf = ca.reshape(x[6:nv], 3, -1), ca.reshape(x[nv + 6 :], 3, -1)
        return cls(x[:3], x[3:6], f, x[nv : nv + 3], x[nv + 3 : nv + 6], vf)


def gap(plane: ca.SX, f: ca.SX) -> ca.SX:
    """Distance of a point f (3,) from a plane (4,): unit normal and offset."""
    return ca.dot(plane[:3], f) - plane[3]


def smooth_contact(
    plane: ca.SX, f: ca.SX, v: ca.SX, u: ca.SX, *, m: float, h: ca.SX, mu: float, g: float, kappa: ca.SX
) -> ca.SX:
    """Contact force (3,) of `contact.contact_force` (same arguments) on a point that may slide."""
    n = plane[:3]
    push = u + ca.vertcat(0, 0, m * g)
    a = h * h / m
    b = gap(plane, f) + h * ca.dot(n, v) - a * ca.dot(n, push)
    sum_ = ca.fabs(b) + ca.sqrt(b * b + 4 * a * kappa)
    gamma = ca.if_else(b > 0, 2 * kappa / sum_, sum_ / (2 * a))
    s = push - m / h * v
    s -= ca.dot(n, s) * n
    r2 = ca.dot(s, s) / (mu * gamma) ** 2
    return (1 + r2 * r2 * r2) ** (-1 / 6) * s + gamma * n


def advance(
    model: PointFootModel, x: ca.SX, u: ca.SX, lam: ca.SX, h: ca.SX, quat_ref: ca.SX, quat_next: ca.SX
) -> ca.SX:
    """The next state under given contact forces lam (3, C), as `dynamics.step`.

    quat_ref, quat_next: the task's orientations here and there.  u: forces on the body (3 C, or more).
    """
    s, C = State.of(x), model.C
    quat = multiply(quat_ref, exponential(s.d))
    forces = ca.reshape(u[: 3 * C], 3, C)
    weight, inertia = ca.DM([0, 0, -model.g]), ca.DM(model.inertia)
    torque = sum((ca.cross(s.f[:, c] - s.p, forces[:, c]) for c in range(C)), ca.SX(3, 1))
    v = s.v + h * (ca.sum2(forces) / model.mass + weight)
    spin = ca.mtimes(matrix(quat).T, torque) - ca.cross(s.w, ca.mtimes(inertia, s.w))
    w = s.w + h * ca.mtimes(ca.DM(np.linalg.inv(model.inertia)), spin)
    vf = [s.vf[:, c] + h * ((lam[:, c] - forces[:, c]) / model.foot_mass[c] + weight) for c in range(C)]
    vf = ca.vertcat(*vf)
    d = logarithm(multiply(conjugate(quat_next), multiply(quat, exponential(h * w))))
    return ca.vertcat(s.p + h * v, d, ca.vec(s.f) + h * vf, v, w, vf)


def limits(model: PointFootModel, x: ca.SX, quat_ref: ca.SX) -> tuple[ca.SX, Array, Array]:
    """`constraints` of a state as low <= rows <= high; lengths of legs and pairs are squared (m^2), the others in m."""
    s = State.of(x)
    R = matrix(multiply(quat_ref, exponential(s.d)))
    rows, low, high = [], [], []
    for c in range(model.C):
        leg = s.p + ca.mtimes(R, ca.DM(model.leg_roots[c])) - s.f[:, c]
        rows.append(ca.dot(leg, leg))
        low.append(model.leg_min[c] ** 2)
        high.append(model.leg_max[c] ** 2)
    for c in np.flatnonzero(np.isfinite(model.clearance)):
        rows.append(ca.dot(R[:, 2], s.p - s.f[:, int(c)]))
        low.append(model.clearance[c])
        high.append(np.inf)
    normals = directions()
    for c, k in np.argwhere(np.isfinite(model.workspace)):
        rows.append(ca.dot(ca.mtimes(R, ca.DM(normals[k])), s.f[:, int(c)] - s.p))
        low.append(-np.inf)
        high.append(model.workspace[c, k])
    for (i, j), length in zip(model.pairs, model.pair_length, strict=True):
        apart = s.f[:, int(i)] - s.f[:, int(j)]
        rows += [ca.dot(apart, apart), apart[2]]
        low += [(length - PAIR_TOLERANCE) ** 2, -length * np.sin(TILT)]
        high += [(length + PAIR_TOLERANCE) ** 2, length * np.sin(TILT)]
    return ca.vertcat(*rows), np.array(low), np.array(high)


def state_cost(x: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    """`cost.state_cost` without its augmented Lagrangian. p: parts of the parameters (see `parameters`)."""
    return 0.5 * p["h"] * ca.dot(p["w_x"], (x - p["x_ref"]) ** 2)


def input_cost(
    model: PointFootModel, task: Task, x: ca.SX, x_next: ca.SX, u: ca.SX, lam: ca.SX, p: dict[str, ca.SX]
) -> ca.SX:
    """`cost.input_cost`: effort, accelerations of the body, and slip of loaded points. lam: (3, C)."""
    a = ca.sum2(ca.reshape(u[: 3 * model.C], 3, -1)) / model.mass - ca.DM([0, 0, model.g])
    cost = ca.dot(p["w_u"], (u - p["u_ref"]) ** 2) + task.w_acceleration * ca.dot(a, a)
    h = u[3 * model.C] if u.numel() > 3 * model.C else p["h"]
    spin = (State.of(x_next).w - State.of(x).w) / h
    cost += task.w_spin * ca.dot(spin, spin)
    vf = State.of(x_next).vf
    for c in range(model.C):
        n = p["ground"][4 * c : 4 * c + 3]
        gamma = ca.dot(n, lam[:, c])
        slide = vf[:, c] - ca.dot(n, vf[:, c]) * n
        cost += task.w_slip * (gamma / (gamma + task.slip_load)) ** 2 * ca.dot(slide, slide)
    return 0.5 * p["h"] * cost


def fields(C: int, nu: int) -> Fields:
    """Parameters of one knot; `ground` is that of the step that begins there, `ground_here` that of the knot."""
    nx = 12 + 6 * C
    return Fields(
        dict(
            h=1, kappa=1, ground=4 * C, ground_here=4 * C, quat_ref=4, quat_next=4, x_ref=nx, w_x=nx,
            u_ref=nu, w_u=nu,
        )
    )  # fmt: skip


def parameters(task: Task, kappa: float) -> Array:
    """(N + 1, size of `fields`) of a task; the last knot begins no step."""
    T, C = task.ground.shape[:2]

    def ahead(x: Array) -> Array:
        return np.concatenate([x, x[-1:]])

    x_ref = to_tangent(task, task.q_ref, task.v_ref)
    return fields(C, task.u_ref.shape[1]).fill(
        T, h=task.h, kappa=kappa, ground=ahead(task.ground[1:]), ground_here=task.ground,
        quat_ref=task.q_ref[:, 3:7], quat_next=ahead(task.q_ref[1:, 3:7]), x_ref=x_ref, w_x=task.w_x,
        u_ref=ahead(task.u_ref), w_u=ahead(task.w_u),
    )  # fmt: skip


def to_tangent(task: Task, q: Array, v: Array) -> Array:
    """(T, 12 + 6 C) state vectors of q (T, 7 + 3 C), v (T, 6 + 3 C)."""
    d = (Rotation.from_quat(task.q_ref[:, 3:7]).inv() * Rotation.from_quat(q[:, 3:7])).as_rotvec()
    return np.concatenate([q[:, :3], d, q[:, 7:], v], axis=1)


def from_tangent(task: Task, x: Array) -> tuple[Array, Array]:
    """Inverse of `to_tangent`."""
    nv = x.shape[1] // 2
    quat = (Rotation.from_quat(task.q_ref[:, 3:7]) * Rotation.from_rotvec(x[:, 3:6])).as_quat()
    return np.concatenate([x[:, :3], quat, x[:, 6:nv]], axis=1), x[:, nv:]
