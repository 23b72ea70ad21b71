"""A cyclic motion for CasADi's solvers: its first state travels along as part of every state, to meet the last one.

So the problem keeps its form, one knot after another, which Fatrop needs; the states are twice as long.
"""

import casadi as ca
import numpy as np

from slomo.optimize import casadi_model as cm
from slomo.optimize.casadi_nlp import Knot
from slomo.optimize.casadi_solve import Form
from slomo.optimize.cost import Task
from slomo.optimize.iterate import Iterate

Array = np.ndarray


def end_gap(task: Task, x0: ca.SX, x1: ca.SX) -> ca.SX:
    """(nx,) what `closing.end_gap` computes of a first state x0 and a last one x1."""
    angle = float(task.shift[3])
    turn = ca.DM([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    about_z = ca.SX([0, 0, np.sin(angle / 2), np.cos(angle / 2)])
    first, last = cm.State.of(x0), cm.State.of(x1)
    begin = cm.multiply(about_z, cm.multiply(ca.SX(task.q_ref[0, 3:7]), cm.exponential(first.d)))
    end = cm.multiply(ca.SX(task.q_ref[-1, 3:7]), cm.exponential(last.d))
    shift = ca.DM(task.shift[:3])
    return ca.vertcat(
        last.p - turn @ first.p - shift,
        cm.logarithm(cm.multiply(cm.conjugate(begin), end)),
        ca.vec(last.f - turn @ first.f - ca.repmat(shift, 1, first.f.size2())),
        last.v - turn @ first.v,
        last.w - first.w,
        ca.vec(last.vf - turn @ first.vf),
    )


class CyclicForm:
    """Another form, closed (see `casadi_solve.Form`): unknowns are its state, the first state, and the rest of its own.

    Args:
        form: whose unknowns begin with the state.
        task: cyclic.
    """

    def __init__(self, form: Form, task: Task):
        self._form, self.body = form, form.body
        first, middle, last = form.knots
        nx: int = last.z.numel()
        self._nx = nx
        start = ca.SX.sym("start", nx)
        nothing = np.zeros(nx)
        same = first.z[:nx] - start
        closed = end_gap(task, start, last.z)

        def longer(knot: Knot, *path: ca.SX) -> Knot:
            z = ca.vertcat(knot.z[:nx], start, knot.z[nx:])
            ahead = ca.vertcat(knot.next, start) if knot.next.numel() else knot.next
            low, high = (np.concatenate([x, *(nothing for _ in path)]) for x in (knot.low, knot.high))
            return Knot(z, knot.p, knot.cost, ahead, ca.vertcat(knot.path, *path), low, high)

        self.knots = longer(first, same), longer(middle), longer(last, closed)

    def parameters(self, task: Task, kappa: float) -> Array:
        return self._form.parameters(task, kappa)

    def bounds(self, task: Task) -> tuple[Array, Array]:
        low, high = self._form.bounds(task)
        return self._insert(low, np.full(self._nx, -np.inf)), self._insert(high, np.full(self._nx, np.inf))

    def pack(self, task: Task, it: Iterate, kappa: float) -> tuple[Array, Array]:
        z, end = self._form.pack(task, it, kappa)
        start = z[0, : self._nx].copy()
        return self._insert(z, start), np.append(end, start)

    def unpack(self, task: Task, z: Array, end: Array, kappa: float) -> Iterate:
        n = self._nx
        return self._form.unpack(task, np.delete(z, np.s_[n : 2 * n], axis=1), end[:n], kappa)

    def _insert(self, z: Array, start: Array) -> Array:
        return np.hstack([z[:, : self._nx], np.tile(start, (len(z), 1)), z[:, self._nx :]])
