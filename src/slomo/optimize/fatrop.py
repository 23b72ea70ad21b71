"""The smooth-contact problem solved by Fatrop, as a check of the compiled solver.

Fatrop (Vanroye, Sathya, De Schutter, Decre, "FATROP: A fast constrained optimal control problem solver for robot
trajectory optimization and control", 2023) is an interior-point method with exact Hessians: limits of legs, inputs and
points are hard constraints here, where `ddp` has an augmented Lagrangian. Same task, same start, same homotopy.
"""

from collections.abc import Callable

import casadi as ca
import numpy as np

from slomo.optimize import casadi_model as cm
from slomo.optimize import constraints
from slomo.optimize.casadi_cycle import CyclicForm
from slomo.optimize.casadi_nlp import Knot
from slomo.optimize.casadi_solve import SECONDS, Plugin, run
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body, step
from slomo.optimize.iterate import Iterate
from slomo.optimize.solve import Settings, Solution
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray


def smooth_step(model: PointFootModel, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Next state and contact forces (3, C) of the smooth contact. p: the parts of `casadi_model.fields`."""
    s = cm.State.of(x)
    h = u[3 * model.C] if u.numel() > 3 * model.C else p["h"]
    lam = [
        cm.smooth_contact(
            p["ground"][4 * c : 4 * c + 4], s.f[:, c], s.vf[:, c], u[3 * c : 3 * c + 3],
            m=model.foot_mass[c], h=h, mu=model.mu, g=model.g, kappa=p["kappa"],
        )
        for c in range(model.C)
    ]  # fmt: skip
    lam = ca.horzcat(*lam)
    return cm.advance(model, x, u, lam, h, p["quat_ref"], p["quat_next"]), lam


class SmoothForm:
    """Unknowns of a knot: the state and the inputs (see `casadi_solve.Form`)."""

    def __init__(self, model: PointFootModel, task: Task):
        self.body, self._nx = Body.of(model), 12 + 6 * model.C
        names = cm.fields(model.C, task.u_ref.shape[1])
        p, part = names.symbols("p")
        x, u = ca.SX.sym("x", self._nx), ca.SX.sym("u", task.u_ref.shape[1])
        x_next, lam = smooth_step(model, x, u, part)
        legs, low, high = cm.limits(model, x, part["quat_ref"])
        state = cm.state_cost(x, part)
        cost = state + cm.input_cost(model, task, x, x_next, u, lam, part)
        middle = Knot(ca.vertcat(x, u), p, cost, x_next, legs, low, high)
        # Any start, but with its points not under the ground; later on contact keeps them above.
        points, C = cm.State.of(x).f, model.C
        above = ca.vertcat(*(cm.gap(part["ground_here"][4 * c : 4 * c + 4], points[:, c]) for c in range(C)))
        first = Knot(
            middle.z, p, cost, x_next, ca.vertcat(middle.path, above),
            np.append(middle.low, np.zeros(C)), np.append(middle.high, np.full(C, np.inf)),
        )  # fmt: skip
        self.knots = first, middle, Knot(x, p, state, ca.SX(0, 1), legs, low, high)

    def parameters(self, task: Task, kappa: float) -> Array:
        return cm.parameters(task, kappa)

    def bounds(self, task: Task) -> tuple[Array, Array]:
        free = np.full((len(task.u_low), self._nx), np.inf)
        return np.hstack([-free, task.u_low]), np.hstack([free, task.u_high])

    def pack(self, task: Task, it: Iterate, kappa: float) -> tuple[Array, Array]:
        x = cm.to_tangent(task, it.qs, it.vs)
        return np.hstack([x[:-1], it.us]), x[-1]

    def unpack(self, task: Task, z: Array, end: Array, kappa: float) -> Iterate:
        qs, vs = cm.from_tangent(task, np.vstack([z[:, : self._nx], end]))
        C = task.ground.shape[1]
        us = np.clip(z[:, self._nx :], task.u_low, task.u_high)
        it = Iterate.at(qs, vs, us, C=C, M=constraints.number(self.body))
        q1, v1 = np.empty(qs.shape[1]), np.empty(vs.shape[1])
        for k in range(len(z)):
            h = it.us[k, 3 * C] if it.us.shape[1] > 3 * C else task.h[k]
            ground = task.ground[k + 1]
            step(self.body, h, kappa, ground, task.stick[k], it.qs[k], it.vs[k], it.us[k], q1, v1, it.lam[k])
        return it


def solve_fatrop(
    model: PointFootModel,
    task: Task,
    start: Iterate,
    *,
    terrain: Terrain,
    settings: Settings | None = None,
    report: Callable[[float, str], None] = lambda fraction, message: None,
    seconds: float = SECONDS,
) -> Solution:
    """`solve.solve` by Fatrop: same arguments, same kind of result, and an end after about `seconds`.

    The cost is the task's alone, without penalties. Dynamics hold to 1e-8, not to rounding.

    Raises:
        UsageError: points that may not slide.
    """
    s = settings or Settings()

    def options(iterations: int, remaining: float) -> dict[str, object]:
        # Its dual residual stalls a little above 1e-8 where toes and heels stand; the dynamics are held to that.
        own = dict(max_iter=iterations, tolerance=1e-6, constr_viol_tol=1e-8, print_level=0)
        return {"fatrop": own}

    plugin = Plugin("fatrop", "Fatrop", options, seconds)
    form = SmoothForm(model, task)
    form = CyclicForm(form, task) if task.cyclic else form
    return run(form, plugin, task, start, terrain=terrain, settings=s, report=report)
