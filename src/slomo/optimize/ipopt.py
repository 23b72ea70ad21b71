"""The published form of the problem: contact forces as unknowns under complementarity constraints, solved by IPOPT.

For each point, with the gap phi and the tangential velocity v_t where a step ends, the normal force gamma, the force
beta_i along each of four directions t_i that span the plane (t, -t, t', -t'), and psi, the speed of sliding:

    0 <= gamma          _|_  phi >= 0                                       contact
    0 <= beta_i         _|_  psi + t_i . v_t >= 0                           maximum dissipation
    0 <= psi            _|_  mu gamma - sum_i beta_i >= 0                   Coulomb's pyramid

(Stewart and Trinkle 1996; in trajectory optimisation Posa, Cantu and Tedrake 2014, Manchester, Doshi, Wood and
Kuindersma 2019.) Each a _|_ b is a b <= kappa, and kappa falls (N m, and W for friction). The pyramid lies inside the
cone. States, inputs, forces and, where the task asks for it, step lengths are unknowns; the cost is the task's.
"""

from collections.abc import Callable

import casadi as ca
import numpy as np

from slomo.optimize import casadi_model as cm
from slomo.optimize import constraints
from slomo.optimize.casadi_cycle import CyclicForm
from slomo.optimize.casadi_nlp import Fields, Knot
from slomo.optimize.casadi_solve import SECONDS, Plugin, run
from slomo.optimize.contact import tangents
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body, step
from slomo.optimize.iterate import Iterate
from slomo.optimize.solve import Settings, Solution
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray


def _directions(plane: ca.SX) -> ca.SX:
    """(3, 4) the directions t, -t, t', -t' of `contact.tangents`."""
    n0, n1, n2 = plane[0], plane[1], plane[2]
    s = ca.copysign(1.0, n2)
    a = -1.0 / (s + n2)
    b = n0 * n1 * a
    t = ca.vertcat(1 + s * n0 * n0 * a, s * b, -s * n0)
    other = ca.vertcat(b, s + n1 * n1 * a, -n1)
    return ca.horzcat(t, -t, other, -other)


class ComplementarityForm:
    """Unknowns of a knot: state, inputs, and gamma (C), beta (4 C), psi (C) (see `casadi_solve.Form`)."""

    def __init__(self, model: PointFootModel, task: Task):
        C, nu = model.C, task.u_ref.shape[1]
        self.body, self.names = Body.of(model), Fields(dict(x=12 + 6 * C, u=nu, gamma=C, beta=4 * C, psi=C))
        z, unknown = self.names.symbols("z")
        p, part = cm.fields(C, nu).symbols("p")
        x, u = unknown["x"], unknown["u"]
        h = u[3 * C] if nu > 3 * C else part["h"]
        planes = [part["ground"][4 * c : 4 * c + 4] for c in range(C)]
        along = [_directions(plane) for plane in planes]
        beta = [unknown["beta"][4 * c : 4 * c + 4] for c in range(C)]
        lam = ca.horzcat(*(planes[c][:3] * unknown["gamma"][c] + along[c] @ beta[c] for c in range(C)))
        x_next = cm.advance(model, x, u, lam, h, part["quat_ref"], part["quat_next"])
        after = cm.State.of(x_next)
        legs, low, high = cm.limits(model, x, part["quat_ref"])
        positive, products = [], []
        for c in range(C):
            gamma, psi = unknown["gamma"][c], unknown["psi"][c]
            phi = cm.gap(planes[c], after.f[:, c])
            sliding = psi + along[c].T @ after.vf[:, c]
            room = model.mu * gamma - ca.sum1(beta[c])
            positive += [phi, sliding, room]
            products += [gamma * phi, beta[c] * sliding, psi * room]
        path = ca.vertcat(legs, *positive, *(y - part["kappa"] for y in products))
        many = 6 * C
        low_path = np.concatenate([low, np.zeros(many), np.full(many, -np.inf)])
        high_path = np.concatenate([high, np.full(many, np.inf), np.zeros(many)])
        state = cm.state_cost(x, part)
        cost = state + cm.input_cost(model, task, x, x_next, u, lam, part)
        here = cm.State.of(x).f
        above = ca.vertcat(*(cm.gap(part["ground_here"][4 * c : 4 * c + 4], here[:, c]) for c in range(C)))
        self.knots = (
            Knot(
                z, p, cost, x_next, ca.vertcat(path, above),
                np.append(low_path, np.zeros(C)), np.append(high_path, np.full(C, np.inf)),
            ),
            Knot(z, p, cost, x_next, path, low_path, high_path),
            Knot(x, p, state, ca.SX(0, 1), legs, low, high),
        )  # fmt: skip

    def parameters(self, task: Task, kappa: float) -> Array:
        return cm.parameters(task, kappa)

    def bounds(self, task: Task) -> tuple[Array, Array]:
        N = len(task.u_low)
        return (
            self.names.fill(N, x=-np.inf, u=task.u_low),
            self.names.fill(N, x=np.inf, u=task.u_high, gamma=np.inf, beta=np.inf, psi=np.inf),
        )

    def pack(self, task: Task, it: Iterate, kappa: float) -> tuple[Array, Array]:
        """The forces are those of the smooth contact."""
        N, C = task.stick.shape
        gamma, beta, psi = np.zeros((N, C)), np.zeros((N, C, 4)), np.zeros((N, C))
        q1, v1, lam = np.empty(it.qs.shape[1]), np.empty(it.vs.shape[1]), np.empty((C, 3))
        for k in range(N):
            h = it.us[k, 3 * C] if it.us.shape[1] > 3 * C else task.h[k]
            ground = task.ground[k + 1]
            step(self.body, h, kappa, ground, task.stick[k], it.qs[k], it.vs[k], it.us[k], q1, v1, lam)
            for c in range(C):
                t = np.array(tangents(*ground[c, :3]))
                gamma[k, c] = ground[c, :3] @ lam[c]
                force, speed = t @ lam[c], t @ v1[6 + 3 * c : 9 + 3 * c]
                beta[k, c] = np.maximum([force[0], -force[0], force[1], -force[1]], 0.0)
                psi[k, c] = np.abs(speed).max()
        x = cm.to_tangent(task, it.qs, it.vs)
        return self.names.fill(N, x=x[:-1], u=it.us, gamma=gamma, beta=beta, psi=psi), x[-1]

    def unpack(self, task: Task, z: Array, end: Array, kappa: float) -> Iterate:
        n, (N, C) = self.names, task.stick.shape
        qs, vs = cm.from_tangent(task, np.vstack([z[:, n["x"]], end]))
        us = np.clip(z[:, n["u"]], task.u_low, task.u_high)
        it = Iterate.at(qs, vs, us, C=C, M=constraints.number(self.body))
        gamma, beta = z[:, n["gamma"]], z[:, n["beta"]].reshape(N, C, 4)
        for k, c in np.ndindex(N, C):
            plane, b = task.ground[k + 1, c], beta[k, c]
            t = np.array(tangents(*plane[:3]))
            it.lam[k, c] = plane[:3] * gamma[k, c] + (b[0] - b[1]) * t[0] + (b[2] - b[3]) * t[1]
        return it


def solve_ipopt(
    model: PointFootModel,
    task: Task,
    start: Iterate,
    *,
    terrain: Terrain,
    settings: Settings | None = None,
    report: Callable[[float, str], None] = lambda fraction, message: None,
    seconds: float = SECONDS,
) -> Solution:
    """`solve.solve` in the published form: same arguments, same kind of result, and an end after `seconds`.

    `settings.kappas` are the products that complementarity leaves. Dynamics hold to 1e-8 where it converges; an iterate
    that did not converge satisfies nothing in particular.

    Raises:
        UsageError: points that may not slide.
    """
    s = settings or Settings()

    def options(iterations: int, remaining: float) -> dict[str, object]:
        return {
            "ipopt": {
                "print_level": 0, "sb": "yes", "linear_solver": "mumps", "max_iter": iterations, "tol": 1e-6,
                "constr_viol_tol": 1e-8, "max_wall_time": float(remaining), "bound_relax_factor": 1e-10,
            }
        }  # fmt: skip

    plugin = Plugin("ipopt", "IPOPT", options, seconds)
    form = ComplementarityForm(model, task)
    form = CyclicForm(form, task) if task.cyclic else form
    return run(form, plugin, task, start, terrain=terrain, settings=s, report=report)
