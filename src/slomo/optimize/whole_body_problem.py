"""The whole-body problem at one motion: cost, what is violated, and the linearisation for the quadratic program."""

from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.optimize.whole_body_model import Kinematics, Steps, WholeBodyModel, carried, minus, right_jacobian_inverse
from slomo.optimize.whole_body_qp import Layout, Limits, Linearized, Penalties
from slomo.terrain import Terrain

Array = np.ndarray


@dataclass(frozen=True)
class Weights:
    """Weights of squares, per second of motion, the cost being half of their sum.

    Attributes:
        position: 1/m^2, base frame.  orientation: 1/rad^2.  point: 1/m^2.  These follow the point-foot motion.
        posture: 1/rad^2, joints against the start's.
        base_acceleration: s^4/m^2, root against the start's.  joint_acceleration: s^4/rad^2.
        torque: of torques as parts of their limits.  force: 1/N^2, contact forces against the point-foot motion's.
    """

    position: float = 1000.0
    orientation: float = 200.0
    point: float = 1000.0
    posture: float = 10.0
    base_acceleration: float = 0.05
    joint_acceleration: float = 1e-5
    torque: float = 0.1
    force: float = 1e-4


@dataclass(frozen=True)
class Violations:
    """By how much the constraints do not hold, in the units that `Penalties` prices.

    Attributes:
        base: (K, 6) N, N m.  torque, speed: (K,) over the limit, as a part of it.  depth: (T, C) m.
        contact, slide: (K, C) N m.  cycle: (2 or 0, nv) m and rad.
    """

    base: Array
    torque: Array
    speed: Array
    depth: Array
    contact: Array
    slide: Array
    cycle: Array

    def beyond(self, allowed: Penalties) -> list[str]:
        """Names of what is more than allowed anywhere."""
        return [f.name for f in fields(self) if getattr(self, f.name).max(initial=0.0) > getattr(allowed, f.name)]

    def price(self, penalties: Penalties) -> float:
        return float(sum(p * getattr(self, f.name).sum() for p, f in zip(penalties, fields(self), strict=True)))


@dataclass(frozen=True)
class Point:
    """A motion, evaluated: q (T + 1, nq) with the knot before the first; lam (K, C, 3) N; tau (K, nj) N m."""

    q: Array
    lam: Array
    kinematics: Kinematics
    steps: Steps
    tau: Array
    frames: Array
    gap: Array
    load: Array
    slide: Array
    cost: float
    violations: Violations


def ground(terrain: Terrain, points: Array) -> tuple[Array, Array]:
    """Frames (..., 3, 3) with rows of two tangents and the normal, and gaps (...) m, under points (..., 3)."""
    n = terrain.normal(points)
    gap = n[..., 2] * (points[..., 2] - terrain.height(points))
    a = np.stack([n[..., 2], np.zeros_like(gap), -n[..., 0]], axis=-1)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    return np.stack([a, np.cross(n, a), n], axis=-2), gap


class Problem:
    """Follow a point-foot motion under the full dynamics, beginning at knots q (T + 1, nq)."""

    def __init__(
        self,
        model: WholeBodyModel,
        terrain: Terrain,
        limits: Limits,
        weights: Weights,
        reference: Reference,
        *,
        start: Array,
    ):
        self.model, self.terrain, self.limits, self.weights = model, terrain, limits, weights
        self.reference, self.start = reference, start
        # In a cycle, what leads to the first knot is what leads to the last.
        self.cyclic = len(reference.cycle) > 0
        self.h = np.concatenate([reference.h[-1:] if self.cyclic else reference.h[:1], reference.h])
        self.base = reference.q[:, :7]
        self.layout = Layout(len(reference.t), *model.structure(), cyclic=self.cyclic)
        # Of the damping, for steps of 1 rad or m and of 300 N.
        self.scale = np.zeros(self.layout.n)
        self.scale[self.layout.dq], self.scale[self.layout.lam] = 1.0, 1e-5
        # (K, 3) factors of three knots that give the acceleration over them.
        h0, h1 = self.h[:-1], self.h[1:]
        self.bend = np.stack([1 / (h0 * h1), -(1 / h0 + 1 / h1) / h1, 1 / h1**2], axis=1)

    def evaluate(self, q: Array, lam: Array) -> Point:
        """Everything at a motion."""
        w, limits, h = self.weights, self.limits, self.h[1:]
        kin = self.model.kinematics(q[1:])
        steps = self.model.steps(q, self.h, lam)
        residual = steps.residual(lam)
        tau = residual[:, 6:]
        frames, gap = ground(self.terrain, kin.points)
        load = np.einsum("kci,kci->kc", frames[1:, :, 2], lam)
        slide = np.einsum("kcij,kcj->kci", frames[1:, :, :2], np.diff(kin.points, axis=0))
        e = minus(kin.base, self.base)
        acceleration = self._accelerations(q)
        cost = 0.5 * (
            self.h @ (w.position * np.sum(e[:, :3] ** 2, axis=1) + w.orientation * np.sum(e[:, 3:] ** 2, axis=1))
            + self.h @ (w.point * np.sum((kin.points - self.reference.points) ** 2, axis=(1, 2)))
            + self.h @ (w.posture * np.sum((q[1:, 7:] - self.start[1:, 7:]) ** 2, axis=1))
            + h @ (acceleration**2 @ self._acceleration_weights(w))
            + h @ (w.torque * np.sum((tau / limits.effort) ** 2, axis=1))
            + h @ (w.force * np.sum((lam - self.reference.lam) ** 2, axis=(1, 2)))
        )
        over = np.maximum
        violations = Violations(
            base=np.abs(residual[:, :6]),
            torque=over(np.max(np.abs(tau) / limits.effort, axis=1) - 1, 0.0),
            speed=over(np.max(np.abs(steps.v[1:, 6:]) / limits.velocity, axis=1) - 1, 0.0),
            depth=over(-gap, 0.0),
            contact=over(over(gap[1:], 0.0) * load - limits.kappa, 0.0),
            slide=over(np.max(np.abs(slide), axis=2) * load - limits.kappa_slide, 0.0),
            cycle=np.abs(self._closing(q)),
        )
        return Point(q, lam, kin, steps, tau, frames, gap, load, slide, float(cost), violations)

    def _accelerations(self, q: Array) -> Array:
        """(K, 3 + nj): of the root, less the start's, m/s^2; of the joints, rad/s^2."""
        x, c = np.concatenate([q[:, :3] - self.start[:, :3], q[:, 7:]], axis=1), self.bend[:, :, None]
        return c[:, 0] * x[:-2] + c[:, 1] * x[1:-1] + c[:, 2] * x[2:]

    def _closing(self, q: Array) -> Array:
        """(2, nv) tangents from where a cycle's last two knots should be to where they are, or (0, nv)."""
        if not self.cyclic:
            return np.zeros((0, self.layout.nv))
        return minus(q[-2:], carried(q[:2], self.reference.cycle))

    def _acceleration_weights(self, w: Weights) -> Array:
        return np.repeat([w.base_acceleration, w.joint_acceleration], [3, self.layout.nj])

    def linearize(self, x: Point, *, follow: bool = True) -> Linearized:
        """The program at a motion, with the Gauss-Newton Hessian of the cost, or of no cost unless `follow`."""
        layout, h = self.layout, self.h
        w = self.weights if follow else Weights(*[0.0] * len(fields(Weights)))
        diagonal, gradient = np.zeros(layout.n), np.zeros(layout.n)
        columns = layout.dq[1:, 6:]
        diagonal[columns] += h[:, None] * w.posture
        gradient[columns] += h[:, None] * w.posture * (x.q[1:, 7:] - self.start[1:, 7:])
        diagonal[layout.dp] += h[:, None, None] * w.point
        gradient[layout.dp] += h[:, None, None] * w.point * (x.kinematics.points - self.reference.points)
        diagonal[layout.lam] += h[1:, None, None] * w.force
        gradient[layout.lam] -= h[1:, None, None] * w.force * self.reference.lam
        diagonal[layout.tau] += h[1:, None] * w.torque / self.limits.effort**2
        blocks = [(np.arange(layout.n), np.arange(layout.n), diagonal)]

        e, J = minus(x.kinematics.base, self.base), x.kinematics.J_base[:, :, :6].copy()
        J[:, 3:] = right_jacobian_inverse(e[:, 3:]) @ J[:, 3:]
        weight = h[:, None] * np.repeat([w.position, w.orientation], 3)
        columns = layout.dq[1:, :6]
        gradient[columns] += np.einsum("kji,kj->ki", J, weight * e)
        blocks.append(_entries(columns, np.einsum("kji,kj,kjl->kil", J, weight, J)))

        straight = np.delete(layout.dq, range(3, 6), axis=1)
        columns = np.stack([straight[:-2], straight[1:-1], straight[2:]], axis=-1)  # (K, 3 + nj, 3)
        weight = h[1:, None] * self._acceleration_weights(w)
        np.add.at(gradient, columns, (weight * self._accelerations(x.q))[..., None] * self.bend[:, None])
        square = self.bend[:, :, None] * self.bend[:, None]
        blocks.append(_entries(columns, weight[..., None, None] * square[:, None]))

        rows, cols, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        P = sp.csc_matrix((values, (rows, cols)), shape=(layout.n, layout.n))
        now = np.zeros(layout.n)
        now[layout.lam], now[layout.tau] = x.lam, x.tau
        closing = self._closing(x.q)
        for columns, f in zip(layout.slacks[1:-1], fields(Violations)[1:-1], strict=True):
            now[columns] = getattr(x.violations, f.name)
        for columns, lack in ((layout.s_base, x.steps.residual(x.lam)[:, :6]), (layout.s_cycle, closing)):
            now[columns] = np.stack([np.maximum(lack, 0.0), np.maximum(-lack, 0.0)], axis=-1)
        by_end = np.tile(np.eye(layout.nv), (len(closing), 1, 1))
        by_end[:, 3:6, 3:6] = right_jacobian_inverse(closing[:, 3:6])
        by_start = -np.swapaxes(by_end, 1, 2)
        if self.cyclic:
            by_start[:, :3, :3] = -Rotation.from_euler("z", self.reference.cycle[3]).as_matrix()
        s = x.steps
        assert s.D is not None
        return Linearized(
            h=h, v=s.v, q_joints=x.q[1:, 7:], force=s.force, Jt=s.Jt, D=s.D, J=x.kinematics.J, frames=x.frames,
            gap=x.gap, closing=closing, by_start=by_start, by_end=by_end, lam=x.lam, load=x.load, slide=x.slide,
            P=P, gradient=gradient, now=now,
        )  # fmt: skip


def _entries(columns: Array, values: Array) -> tuple[Array, Array, Array]:
    """Rows, columns and values of square blocks (..., n, n) over columns (..., n)."""
    shape = values.shape
    return (
        np.broadcast_to(columns[..., :, None], shape).ravel(),
        np.broadcast_to(columns[..., None, :], shape).ravel(),
        np.ascontiguousarray(values).ravel(),
    )
