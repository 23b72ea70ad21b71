"""Optimal control problems for CasADi's solvers, put together from what happens at one knot.

    min  sum_k cost_k(z_k)   with   x_{k+1} = next_k(z_k),   low_k <= path_k(z_k) <= high_k,   z_k within its bounds

Here z_k begins with the state x_k. There are three kinds of knot: first, middle and last (which has no next). CasADi
differentiates the three once, as scalar expressions; Jacobian and Hessian of the whole problem are assembled from them
by position, so building takes the same time for any length and every evaluation is linear in it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

Array = np.ndarray

# Fatrop returns a number (its IpSolverReturnFlag), IPOPT words.
_STATUS = {
    "1": "iteration limit",
    "3": "locally infeasible",
    "4": "line search failed",
    "5": "no step could be computed",
    "Maximum_Iterations_Exceeded": "iteration limit",
    "Maximum_CpuTime_Exceeded": "time limit",
    "Maximum_WallTime_Exceeded": "time limit",
    "Infeasible_Problem_Detected": "locally infeasible",
    "Restoration_Failed": "line search failed",
}


@dataclass(frozen=True)
class Knot:
    """One kind of knot as scalar expressions.

    Attributes:
        z: (nz,) unknowns, the state first.  p: (np,) parameters.
        cost: ().  next: (nx,), or none at the last knot.  path: (ng,).
        low, high: (ng,) bounds of the path; equal where it is an equation.
    """

    z: ca.SX
    p: ca.SX
    cost: ca.SX
    next: ca.SX
    path: ca.SX
    low: Array
    high: Array


@dataclass(frozen=True)
class Result:
    """Where a solver stopped: z (N, nz), end (nx,), and what it says of it."""

    z: Array
    end: Array
    cost: float
    success: bool
    status: str
    iterations: int


class Fields:
    """Names for the parts of a vector.

    Args:
        sizes: length of each part, in order.
    """

    def __init__(self, sizes: Mapping[str, int]):
        self._slices, self.size = {}, 0
        for name, length in sizes.items():
            self._slices[name] = slice(self.size, self.size + length)
            self.size += length

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    def symbols(self, name: str) -> tuple[ca.SX, dict[str, ca.SX]]:
        """A symbolic vector and its parts by name."""
        x = ca.SX.sym(name, self.size)
        return x, {n: x[s] for n, s in self._slices.items()}

    def fill(self, rows: int, **parts: Array | float) -> Array:
        """(rows, size) from arrays that broadcast to (rows, length of the part); what is not given is 0."""
        out = np.zeros((rows, self.size))
        for name, value in parts.items():
            out[:, self[name]] = np.asarray(value).reshape(rows, -1) if np.ndim(value) else value
        return out


class _Kind:
    """The functions of `count` knots of one kind."""

    def __init__(self, knot: Knot, nx: int, count: int, *, begins: bool):
        z, p = knot.z, knot.p
        self.count, self.nz, self.nx, self.np = count, z.numel(), nx, p.numel()
        self.nn, self.ng = knot.next.numel(), knot.path.numel()
        rows = ca.vertcat(-knot.next, knot.path)
        jac = ca.jacobian(rows, z)
        # Unless it is the first, the piece before ends at this state.
        ahead = 0 if begins else nx
        jac = ca.vertcat(ca.horzcat(ca.SX.eye(ahead), ca.SX(ahead, self.nz - ahead)), jac)
        weight, lam = ca.SX.sym("weight"), ca.SX.sym("lam", rows.numel())
        hess, _ = ca.hessian(weight * knot.cost + ca.dot(lam, rows), z)
        self.jac_sparsity, self.hess_sparsity = jac.sparsity(), hess.sparsity()
        self.cost = ca.Function("cost", [z, p], [knot.cost]).map(count)
        self.rows = ca.Function("rows", [z, p], [rows]).map(count)
        self.slope = ca.Function("slope", [z, p], [ca.gradient(knot.cost, z)]).map(count)
        self.jac = ca.Function("jacobian", [z, p], [jac]).map(count)
        self.hess = ca.Function("hessian", [z, p, weight, lam], [hess]).map(count)


def _split(x: ca.MX, rows: Sequence[int], counts: Sequence[int]) -> list[ca.MX]:
    """A vector as one matrix for each kind, a column for each knot."""
    ends = np.cumsum([0, *(r * n for r, n in zip(rows, counts, strict=True))])
    parts = ca.vertsplit(x, [int(e) for e in ends])
    return [ca.reshape(y, r, n) for y, r, n in zip(parts, rows, counts, strict=True)]


def _stack(parts: Sequence[ca.MX]) -> ca.MX:
    return ca.vertcat(*(ca.vec(ca.densify(x)) for x in parts))


def _nonzeros(parts: Sequence[ca.MX]) -> ca.MX:
    return ca.vertcat(*(x.nz[:] for x in parts))


class OptimalControl:
    """A solver for N pieces (N + 1 knots) of the problem above.

    Args:
        first, middle, last: the kinds of knot; their parameters have the same layout.
        N: number of pieces, at least 2.
        plugin: of CasADi, "fatrop" or "ipopt".
    """

    def __init__(self, first: Knot, middle: Knot, last: Knot, *, N: int, plugin: str):
        nx = last.z.numel()
        kinds = [
            _Kind(first, nx, 1, begins=True),
            _Kind(middle, nx, N - 1, begins=False),
            _Kind(last, nx, 1, begins=False),
        ]
        self._kinds, self.N, self.nx = kinds, N, nx
        self._path_bounds = [(k.low, k.high) for k in (first, middle, last)]
        counts = [k.count for k in kinds]
        nz, rows = [k.nz for k in kinds], [k.nn + k.ng for k in kinds]
        x = ca.MX.sym("x", sum(n * c for n, c in zip(nz, counts, strict=True)))
        p = ca.MX.sym("p", kinds[0].np * (N + 1))
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", sum(r * c for r, c in zip(rows, counts, strict=True)))
        at = list(zip(_split(x, nz, counts), _split(p, [kinds[0].np] * 3, counts), strict=True))
        lam = _split(lam_g, rows, counts)
        ends = ca.horzcat(*(z[:nx, :] for z, _ in at))
        ends = [ends[:, 1], ends[:, 2:], ca.MX(0, 1)]

        f = ca.sum1(_stack([k.cost(*a) for k, a in zip(kinds, at, strict=True)]))
        g = _stack([k.rows(*a) + ca.vertcat(e, ca.MX(k.ng, k.count)) for k, a, e in zip(kinds, at, ends, strict=True)])
        slope = _stack([k.slope(*a) for k, a in zip(kinds, at, strict=True)])
        jac = ca.MX(self._jacobian_sparsity(), _nonzeros([k.jac(*a) for k, a in zip(kinds, at, strict=True)]))
        hess = [k.hess(*a, ca.repmat(lam_f, 1, k.count), y) for k, a, y in zip(kinds, at, lam, strict=True)]
        hess = ca.MX(ca.diagcat(*(k.hess_sparsity for k in kinds for _ in range(k.count))), _nonzeros(hess))
        jac_f, hess_l = [slope], [lam_f * slope + ca.mtimes(jac.T, lam_g), hess]
        if plugin == "ipopt":
            jac_f, hess_l = [f, slope], [ca.triu(hess)]
        functions = {
            "nlp_f": ([x, p], [f]),
            "nlp_g": ([x, p], [g]),
            "nlp_grad_f": ([x, p], jac_f),
            "nlp_jac_g": ([x, p], [g, jac]),
            "nlp_hess_l": ([x, p, lam_f, lam_g], hess_l),
        }
        self._problem, self._plugin = dict(x=x, p=p, f=f, g=g), plugin
        self.functions = {name: ca.Function(name, *io) for name, io in functions.items()}
        self._structure: dict[str, Any] = {}
        if plugin == "fatrop":
            self._structure = dict(
                structure_detection="manual", N=N, nx=[nx] * (N + 1), nu=[first.z.numel() - nx] * N + [0],
                ng=[k.ng for k in kinds for _ in range(k.count)],
            )  # fmt: skip

    def _jacobian_sparsity(self) -> ca.Sparsity:
        """One block column a knot: the end of the piece before, then the piece and the path that begin here."""
        starts, index, here, before = [0], [], 0, 0
        for kind in self._kinds:
            own_starts, own = np.array(kind.jac_sparsity.colind()), np.array(kind.jac_sparsity.row(), int)
            ahead = kind.jac_sparsity.size1() - kind.nn - kind.ng
            for _ in range(kind.count):
                index.extend(np.where(own < ahead, before + own, here + own - ahead).tolist())
                starts.extend((starts[-1] + own_starts[1:]).tolist())
                before, here = here, here + kind.nn + kind.ng
        return ca.Sparsity(here, len(starts) - 1, starts, index)

    def solve(self, z: Array, end: Array, p: Array, *, low: Array, high: Array, options: Mapping[str, Any]) -> Result:
        """Run the solver from a start.

        Args:
            z: (N, nz) unknowns at the knots but the last.  end: (nx,) the state there.  p: (N + 1, np) parameters.
            low, high: (N, nz) bounds of z.
            options: for `casadi.nlpsol`.
        """
        solver = ca.nlpsol(
            "solver", self._plugin, self._problem,
            {"cache": self.functions, "calc_lam_p": False, "print_time": False, **self._structure, **options},
        )  # fmt: skip
        free = np.full(self.nx, np.inf)
        gap, kinds = np.zeros(self.nx), self._kinds
        bounds = [
            np.concatenate(
                [x for k, path in zip(kinds, side, strict=True) for x in ([gap] * (k.nn > 0) + [path]) * k.count]
            )
            for side in zip(*self._path_bounds, strict=True)
        ]
        out = solver(
            x0=np.append(z, end), p=p.ravel(), lbx=np.append(low, -free), ubx=np.append(high, free),
            lbg=bounds[0], ubg=bounds[1],
        )  # fmt: skip
        stats = solver.stats()
        x = np.array(out["x"])[:, 0]
        return Result(
            z=x[: -self.nx].reshape(self.N, -1),
            end=x[-self.nx :],
            cost=float(out["f"]),
            success=bool(stats["success"]),
            status=_STATUS.get(str(stats["return_status"]), str(stats["return_status"]).replace("_", " ").lower()),
            iterations=int(stats["iter_count"]),
        )
