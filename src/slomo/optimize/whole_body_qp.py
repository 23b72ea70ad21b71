"""The quadratic program of one Newton step of the whole-body problem, and its solution by Clarabel.

Unknowns: tangents dq of the knots, displacements of the contact points, contact forces, joint torques, and slacks that
make every program feasible at a price (an l1 penalty method: Fletcher 1987, section 14.3). Rows in this order:

    equations    dynamics of each step; points move with the joints
    limits       torque, joint range, joint speed; gap, gap x force, slide x force; slacks
    cones        friction |lam_t| <= mu lam_n (second-order cones)
"""

from dataclasses import dataclass
from typing import NamedTuple

import clarabel
import numpy as np
import scipy.sparse as sp

Array = np.ndarray


class Linearized(NamedTuple):
    """A motion of T = K + 1 knots (and the one before) and everything that the program needs about it.

    Attributes:
        h: (K + 1,) s.  v: (K + 1, nv).  q_joints: (T, nj) rad.
        force: (K, nv), Jt: (K, nv, 3 C), D: (K, 3, nv, nv) as in `whole_body_model.Steps`.
        J: (T, C, 3, nv) of the points.
        frames: (T, C, 3, 3) rows: two tangents and the normal of the ground under each point.  gap: (T, C) m.
        closing: (2, nv) by how much the ends of a cycle do not meet, or (0, nv).
        by_start, by_end: (2 or 0, nv, nv) its derivatives by the first two knots and by the last two.
        lam: (K, C, 3) N.  load: (K, C) N, its normal part.  slide: (K, C, 2) m, tangential way of a point in a step.
        P: sparse (n, n), gradient: (n,): the cost's, over `Layout`'s unknowns.  now: (n,) their values as it is.
    """

    h: Array
    v: Array
    q_joints: Array
    force: Array
    Jt: Array
    D: Array
    J: Array
    frames: Array
    gap: Array
    lam: Array
    load: Array
    slide: Array
    closing: Array
    by_start: Array
    by_end: Array
    P: sp.csc_matrix
    gradient: Array
    now: Array


class Limits(NamedTuple):
    """lower, upper (nj,) rad; effort (nj,) N m; velocity (nj,) rad/s; mu; kappa, kappa_slide: N m."""

    lower: Array
    upper: Array
    effort: Array
    velocity: Array
    mu: float
    kappa: float
    kappa_slide: float


class Penalties(NamedTuple):
    """Price of a slack: base force or torque (1/N, 1/N m), torque and speed as a part of their limit, depth (1/m),
    gap x force and slide x force (1/N m), ends of a cycle that do not meet (1/m, 1/rad)."""

    base: float = 0.1
    torque: float = 100.0
    speed: float = 100.0
    depth: float = 1e3
    contact: float = 100.0
    slide: float = 100.0
    cycle: float = 100.0


class Layout:
    """Columns of the unknowns, each an array of column numbers."""

    def __init__(self, T: int, coupled: Array, moved: Array, *, cyclic: bool):
        """Of T knots; coupled (nv, nv) and moved (C, nv) as of `WholeBodyModel.structure`."""
        self.coupled, self.moved = coupled, moved
        C, nj = len(moved), len(coupled) - 6
        self.T, self.K, self.C, self.nj, self.nv = T, T - 1, C, nj, 6 + nj
        self.n = 0
        self.dq = self._take(T + 1, self.nv)
        self.dp = self._take(T, C, 3)
        self.lam = self._take(self.K, C, 3)
        self.tau = self._take(self.K, nj)
        first = self.n
        self.s_base = self._take(self.K, 6, 2)
        self.s_torque = self._take(self.K)
        self.s_speed = self._take(self.K)
        self.s_depth = self._take(T, C)
        self.s_contact = self._take(self.K, C)
        self.s_slide = self._take(self.K, C)
        self.s_cycle = self._take(2 if cyclic else 0, self.nv, 2)
        self.slack = np.arange(first, self.n)
        self.slacks = (
            self.s_base,
            self.s_torque,
            self.s_speed,
            self.s_depth,
            self.s_contact,
            self.s_slide,
            self.s_cycle,
        )

    def _take(self, *shape: int) -> Array:
        size = int(np.prod(shape))
        out = np.arange(self.n, self.n + size).reshape(shape)
        self.n += size
        return out


class _Rows:
    """Blocks of a sparse matrix with right-hand sides."""

    def __init__(self):
        self.count = 0
        self.data: list[tuple[Array, ...]] = []
        self.b: list[Array] = []

    def add(self, b: Array, *blocks: tuple[Array, ...]) -> None:
        """Rows sum_i values_i x[columns_i] with right-hand side b (..., r); columns (..., c), values (..., r, c) or of
        a shape that broadcasts to it, and where they can differ from zero, of such a shape, if not everywhere."""
        rows = self.count + np.arange(b.size).reshape(b.shape)
        self.count += b.size
        self.b.append(b.ravel())
        for columns, values, *where in blocks:
            shape = (*b.shape, columns.shape[-1])
            kept = np.broadcast_to(where[0] if where else True, shape)
            parts = rows[..., None], columns[..., None, :], values
            self.data.append(tuple(np.broadcast_to(x, shape)[kept] for x in parts))

    def matrix(self, n: int) -> tuple[sp.csc_matrix, Array]:
        rows, columns, values = (np.concatenate(x) for x in zip(*self.data, strict=True))
        return sp.csc_matrix((values, (rows, columns)), shape=(self.count, n)), np.concatenate(self.b)


@dataclass(frozen=True)
class Step:
    """dq (T + 1, nv); lam (K, C, 3) N; decrease of the program's objective from the motion as it is; solved: Clarabel
    was content."""

    dq: Array
    lam: Array
    decrease: float
    solved: bool


class Program:
    """One program after another of the same structure; only the first is analysed."""

    def __init__(self, layout: Layout, limits: Limits):
        self.layout, self.limits = layout, limits
        self._solver: clarabel.DefaultSolver | None = None

    def solve(self, x: Linearized, penalties: Penalties, *, damping: Array, tolerance: float) -> Step:
        """The step that minimises cost, penalties and |.|^2 / 2 weighted by damping (n,), under linear equations."""
        layout = self.layout
        A, b, equations, bounds = self._rows(x)
        # A slack is counted by what it costs, without which the interior-point method takes three times as many steps.
        price = np.ones(layout.n)
        for columns, value in zip(layout.slacks, penalties, strict=True):
            price[columns] = value
        A.data /= np.repeat(price, np.diff(A.indptr))
        # Solved for the change of forces and torques, so that its tolerance is one of the step.
        past, now = x.now.copy(), np.zeros(layout.n)
        past[layout.slack] = 0.0
        now[layout.slack] = (price * x.now)[layout.slack]
        b, gradient = b - A @ past, x.gradient + x.P @ past
        gradient[layout.slack] = 1.0
        P = sp.triu(x.P, format="csc")
        P.sort_indices()
        P.data[P.indptr[1:] - 1] += damping  # the diagonal ends each column, and is always stored
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.max_threads, settings.direct_solve_method = False, 1, "qdldl"
        settings.presolve_enable = settings.chordal_decomposition_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        solver = self._solver
        if solver is None:
            cones = [
                clarabel.ZeroConeT(equations),
                clarabel.NonnegativeConeT(bounds),
                *(clarabel.SecondOrderConeT(3) for _ in range(layout.K * layout.C)),
            ]
            solver = self._solver = clarabel.DefaultSolver(P, gradient, A, b, cones, settings)
        else:
            solver.update(P=P, q=gradient, A=A, b=b, settings=settings)
        solution = solver.solve()
        z = np.array(solution.x)
        good = solution.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved)
        step, total = z - now, z + now
        decrease = -step @ gradient - 0.5 * (step @ (x.P @ total) + step @ (damping * total))
        lam = _inside_cone(x.lam + z[layout.lam], x.frames[1:], self.limits.mu)
        return Step(z[layout.dq], lam, float(decrease), bool(good and np.all(np.isfinite(z))))

    def _rows(self, x: Linearized) -> tuple[sp.csc_matrix, Array, int, int]:
        layout, limits, rows = self.layout, self.limits, _Rows()
        K, C, nj, nv = layout.K, layout.C, layout.nj, layout.nv
        one = np.ones((1, 1))
        # Dynamics: force + D dq - Jt lam = (slack, tau).
        knots = np.concatenate([layout.dq[:-2], layout.dq[1:-1], layout.dq[2:]], axis=1)
        D = np.concatenate([x.D[:, 0], x.D[:, 1], x.D[:, 2]], axis=2)
        lam = layout.lam.reshape(K, -1)
        chain, lever = np.tile(layout.coupled, 3), np.repeat(layout.moved.T, 3, axis=1)
        slack, own, axis = np.kron(np.eye(6), [[1.0, -1.0]]), np.eye(nj), np.eye(3)
        rows.add(-x.force[:, :6], (knots, D[:, :6]), (lam, -x.Jt[:, :6]),
                 (layout.s_base.reshape(K, 12), slack, slack != 0))  # fmt: skip
        rows.add(-x.force[:, 6:], (knots, D[:, 6:], chain[6:]), (lam, -x.Jt[:, 6:], lever[6:]),
                 (layout.tau, -own, own != 0))  # fmt: skip
        rows.add(np.zeros((K + 1, C, 3)), (layout.dp, axis, axis != 0),
                 (layout.dq[1:, None], -x.J, layout.moved[:, None]))  # fmt: skip
        n = len(x.closing)
        slack, own = np.kron(np.eye(nv), [[1.0, -1.0]]), np.eye(nv) > 0
        own[3:6, 3:6] = own[:3, :3] = True
        rows.add(-x.closing, (layout.dq[:n], x.by_start, own), (layout.dq[-2:][:n], x.by_end, own),
                 (layout.s_cycle.reshape(n, 2 * nv), -slack, slack != 0))  # fmt: skip
        equations = rows.count
        # Limits of the joints.
        q, dq = x.q_joints, layout.dq[..., 6:, None]
        rows.add(np.broadcast_to(limits.upper, q.shape)[..., None] - q[..., None], (dq[1:], one))
        rows.add(q[..., None] - np.broadcast_to(limits.lower, q.shape)[..., None], (dq[1:], -one))
        tau, slack = layout.tau[..., None], np.repeat(layout.s_torque[:, None, None], nj, axis=1)
        limit = np.broadcast_to(limits.effort[:, None], tau.shape)
        both = np.concatenate([dq[1:], dq[:-1]], axis=-1)[1:]
        pair = np.array([[1.0, -1.0]]) / x.h[1:, None, None, None]
        speed, v = np.broadcast_to(limits.velocity[:, None], tau.shape), x.v[1:, 6:, None]
        speed_slack = np.repeat(layout.s_speed[:, None, None], nj, axis=1)
        for sign in (1.0, -1.0):
            rows.add(limit, (tau, sign * one), (slack, -limit[..., None]))
            rows.add(speed - sign * v, (both, sign * pair), (speed_slack, -speed[..., None]))
        # Contact: gap + n dp >= 0; load n dp + gap n lam <= kappa; load (slide + dt) + slide (n lam - load) in +-kappa.
        n, t = x.frames[:, :, 2], x.frames[:, :, :2]
        gap, load = x.gap[1:], x.load
        rows.add(x.gap[..., None], (layout.dp, -n[:, :, None]), (layout.s_depth[..., None], -one))
        kappa = np.full((K, C, 1), limits.kappa)
        rows.add(kappa, (layout.dp[1:], (load[..., None] * n[1:])[:, :, None]),
                 (layout.lam, (gap[..., None] * n[1:])[:, :, None]), (layout.s_contact[..., None], -one))  # fmt: skip
        along, forces = load[..., None, None] * t[1:], x.slide[..., None] * n[1:, :, None]
        for sign in (1.0, -1.0):
            way = (layout.dp[1:], sign * along), (layout.dp[:-1], -sign * along)
            force = (layout.lam, sign * forces), (layout.s_slide[..., None], -one)
            rows.add(np.full((K, C, 2), limits.kappa_slide), *way, *force)
        rows.add(np.zeros((len(layout.slack), 1)), (layout.slack[:, None], -one))
        bounds = rows.count - equations
        cone = np.concatenate([limits.mu * n[1:, :, None], t[1:]], axis=2)
        rows.add(np.zeros((K, C, 3)), (layout.lam, -cone))
        A, b = rows.matrix(layout.n)
        return A, b, equations, bounds


def _inside_cone(lam: Array, frames: Array, mu: float) -> Array:
    """Forces (K, C, 3) without what rounding left outside of the friction cones."""
    local = np.einsum("kcij,kcj->kci", frames, lam)
    local[..., 2] = np.maximum(local[..., 2], 0.0)
    size = np.linalg.norm(local[..., :2], axis=-1)
    local[..., :2] *= np.minimum(1.0, mu * local[..., 2] / np.maximum(size, 1e-12))[..., None]
    return np.einsum("kcji,kcj->kci", frames, local)
