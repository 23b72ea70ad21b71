"""Contact-implicit model-predictive control: the optimiser's compiled DDP over a short horizon, at every tick.

From the measured state, H knots ahead, one or two Gauss-Newton steps from the last plan (a real-time iteration; Diehl,
Bock, Schloeder 2005). Nothing is scheduled: which foot stands when follows from the cost and the contact model.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from slomo.errors import UsageError
from slomo.motion import Reference
from slomo.optimize import constraints, ddp
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body
from slomo.optimize.iterate import Iterate, Work
from slomo.optimize.linear_body import NONLINEAR, LinearBody, linearize_reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain
from slomo.track.plan import Plan, sample_all

Array = np.ndarray

_REG = 1e-6  # first Levenberg-Marquardt factor of every tick: one grown in an earlier tick would freeze the plan
_DEFECT = 1.0  # l1 norm of the gaps under which an iterate that finds no further descent is a plan
_PENALTY = 1e4  # 1/m^2
MODELS = ("ncp", "lcp")


@dataclass(frozen=True)
class MpcConfig:
    """Parameters of the controller; weights are those of the squared deviation from the reference, as in
    `optimize.problem.Weights`.

    Attributes:
        mpc_model: what it plans with. "ncp": the nonlinear dynamics (a nonlinear complementarity problem). "lcp": the
            body linearised about the reference, only contact left as it is.
        horizon: number of steps.  dt: s, length of a step of the plan.
        iterations: most Newton steps a tick.  tolerance: relative decrease of the cost that ends them.
        mu: friction coefficient to plan with.  kappa: N m, smoothing of the contact.
        position: 1/m^2, weight of the body's position.  orientation: 1/rad^2, weight of the body's orientation.
        foot: 1/m^2, weight of the feet's places along the ground.  foot_height: 1/m^2, weight of the feet's heights.
        velocity: s^2/m^2, weight of the body's velocity.
        angular_velocity: s^2/rad^2, weight of the body's angular velocity.
        foot_velocity: s^2/m^2, weight of the feet's velocities.
        effort: of the deviation from the reference's forces, as shares of the robot's weight.
        acceleration: s^4/m^2, weight of the body's acceleration.
        slip: s^2/m^2, weight of the speed of loaded feet along the ground.
        slip_load: share of the robot's weight, normal force from which slip counts half.
        terminal: s, weight of the end state (as if it lasted that long).
        stride: how far, as a share of the body's height, its capture point may be off before the feet go there.
    """

    mpc_model: str = "ncp"
    horizon: int = 10
    dt: float = 0.025
    iterations: int = 2
    tolerance: float = 1e-6
    mu: float = 0.6
    kappa: float = 1e-3
    position: float = 1000.0
    orientation: float = 300.0
    foot: float = 1000.0
    foot_height: float = 500.0
    velocity: float = 10.0
    angular_velocity: float = 2.0
    foot_velocity: float = 0.5
    effort: float = 3.3
    acceleration: float = 0.0
    slip: float = 300.0
    slip_load: float = 0.0156
    terminal: float = 0.1
    stride: float = 0.1


class Mpc:
    """Tracks a reference with the point-foot model.

    Args:
        model: of the robot; its `mu` is replaced by the config's.
        reference: what to track, in the world in which `terrain` is.
        terrain: ground under the points.
    """

    def __init__(
        self, model: PointFootModel, reference: Reference, *, terrain: Terrain, config: MpcConfig | None = None
    ):
        self.config = c = config or MpcConfig()
        if c.mpc_model not in MODELS:
            raise UsageError(f"no model {c.mpc_model!r}", where="track.mpc_model", valid=MODELS)
        self.model = replace(model, mu=c.mu)
        self.terrain = terrain
        self.reference = reference
        H, C = c.horizon, model.C
        nv = 6 + 3 * C
        self._body = Body.of(self.model)
        w = np.empty((H + 1, 2 * nv))
        w[:, :3], w[:, 3:6] = c.position, c.orientation
        w[:, 6:nv] = np.tile([c.foot, c.foot, c.foot_height], C)
        w[:, nv : nv + 3], w[:, nv + 3 : nv + 6], w[:, nv + 6 :] = c.velocity, c.angular_velocity, c.foot_velocity
        h = np.append(np.full(H, c.dt), c.terminal)
        weight = model.total_mass * model.g
        self._task = Task(
            h=h, ground=np.tile([0.0, 0.0, 1.0, 0.0], (H + 1, C, 1)), stick=np.zeros((H, C), bool),
            q_ref=np.zeros((H + 1, nv + 1)), v_ref=np.zeros((H + 1, nv)),
            u_ref=np.zeros((H, 3 * C)), w_x=w, w_u=np.full((H, 3 * C), c.effort / weight**2),
            u_low=np.tile(-model.u_max.ravel(), (H, 1)), u_high=np.tile(model.u_max.ravel(), (H, 1)),
            w_acceleration=c.acceleration, w_spin=0.0, w_slip=c.slip, slip_load=c.slip_load * weight, cyclic=False,
            shift=np.zeros(4), linear=NONLINEAR if c.mpc_model == "ncp" else LinearBody.zeros(H, C),
        )  # fmt: skip
        self._feet = np.flatnonzero(np.isfinite(model.clearance))  # not the hands
        self._work = Work.make(self._new_iterate())
        r = reference
        self._t_ref, self._q_ref, self._v_ref, self._u_ref = (
            np.ascontiguousarray(x, float) for x in (r.t, r.q, r.v, r.u)
        )
        self._hold = self._standing_forces()
        self._along = self._linearized() if c.mpc_model == "lcp" else NONLINEAR
        self._plan: Plan | None = None

    def _standing_forces(self) -> Array:
        """(3 C,) N: the weight split over the points that stand in the reference's last state."""
        gap = self.reference.points[-1, :, 2] - self.terrain.height(self.reference.points[-1])
        near = np.exp(-np.maximum(gap, 0) / 0.01) + 1e-3
        u = np.zeros((self.model.C, 3))
        u[:, 2] = self.model.mass * self.model.g * near / near.sum()
        return u.ravel()

    def _sample_reference(self, knots: Array, q: Array, v: Array, u: Array) -> None:
        """The reference at knots (M + 1,), as `plan.sample_all` has it; after its end it stands."""
        sample_all(self._t_ref, self._q_ref, self._v_ref, self._u_ref, knots, q, v, u)
        u[knots[1:] > self.reference.t[-1] + 1e-9] = self._hold

    def _linearized(self) -> LinearBody:
        """Matrices along the whole reference in steps of dt, and one step more, in which it stands."""
        dt, origin = self.config.dt, self.reference.t[0]
        M = int(np.ceil((self.reference.t[-1] - origin) / dt - 1e-9)) + 1
        along = LinearBody.zeros(M, self.model.C)
        self._sample_reference(origin + dt * np.arange(M + 1), along.q, along.v, along.u)
        linearize_reference(self._body, np.full(M, dt), along, 0, M)
        return along

    def _linearize(self, first: int) -> None:
        """The task's matrices, where `first` is its first knot's place in the grid: those made beforehand, and those of
        the first step, which is shorter."""
        task, linear, along = self._task, self._task.linear, self._along
        steps = np.minimum(first + np.arange(len(linear.c)), len(along.c) - 1)
        for name in ("A", "B", "c"):
            np.take(getattr(along, name), steps, axis=0, out=getattr(linear, name))
        linear.q[:], linear.v[:], linear.u[:] = task.q_ref, task.v_ref, task.u_ref
        linearize_reference(self._body, task.h, linear, 0, 1)

    def _catch(self, q: Array, v: Array) -> None:
        """Move the feet's wanted places under a body that has been pushed off the reference.

        No step to the side is worth its cost within a short horizon as long as the feet are wanted where they were. So
        they are wanted where they can stop the body: off by its displacement and sqrt(height / g) times its excess
        speed (the capture point of Pratt et al. 2006; where Raibert placed feet), less a dead zone, in which small
        errors leave them in their places. When they go there is still the solver's choice.
        """
        task = self._task
        away, excess = q[:2] - task.q_ref[0, :2], v[:2] - task.v_ref[0, :2]
        height = max(q[2] - float(task.q_ref[0, 9::3].min()), 0.0)
        step = away + np.sqrt(height / self.model.g) * excess
        step *= max(0.0, 1 - self.config.stride * height / max(float(np.linalg.norm(step)), 1e-9))
        for c in self._feet:
            task.q_ref[:, 7 + 3 * c : 9 + 3 * c] += step

    def _new_iterate(self) -> Iterate:
        task = self._task
        return Iterate.at(task.q_ref, task.v_ref, task.u_ref, C=self.model.C, M=constraints.number(self._body))

    def reset(self) -> None:
        """Forget the last plan; the next step starts from the reference."""
        self._plan = None

    def warm_up(self) -> float:
        """Compile or load everything that `step` calls, so that no tick pays for it; returns the seconds."""
        start = time.perf_counter()
        for _ in range(2):
            plan = self.step(float(self.reference.t[0]), self.reference.q[0], self.reference.v[0])
            plan.feedback(float(plan.t[0]), plan.q[0], plan.v[0])
        self.reset()
        return time.perf_counter() - start

    def step(self, t: float, q: Array, v: Array, *, shift: Array | float = 0.0) -> Plan:
        """Plan from the measured state.

        Args:
            t: s, on the reference's clock.  q: (7 + 3 C,), v: (6 + 3 C,) as in `motion.Reference`.
            shift: (C,) m, how much higher the ground under each point is found to be than the terrain says; the
                reference's points go up with it.
        """
        start = time.perf_counter()
        c, task = self.config, self._task
        H, C = c.horizon, self.model.C
        # Knots stay where they are from tick to tick, and the first step is what is left of the one under way: a
        # contact planned at a knot comes nearer, instead of being put off by a little at every tick. The last fifth of
        # a step joins the next one, because the model is stiff in very short steps.
        origin = float(self.reference.t[0])
        first = int(np.floor((t - origin) / c.dt + 0.2))
        knots = origin + c.dt * (first + np.arange(H + 1))
        knots[0] = t
        task.h[0] = knots[1] - t
        self._sample_reference(knots, task.q_ref, task.v_ref, task.u_ref)
        if c.mpc_model == "lcp":
            self._linearize(first)
        task.q_ref[:, 9::3] += shift
        self._catch(q, v)
        last = self._plan
        it = self._new_iterate()
        if last is not None:
            # The last plan as far as it reaches; what follows stays at the reference.
            n = int(np.searchsorted(knots, last.t[-1] + 1e-9)) - 1
            if n > 0:
                sample_all(last.t, last.q, last.v, last.u, knots[: n + 1], it.qs[: n + 1], it.vs[: n + 1], it.us[:n])
        it.qs[0], it.vs[0] = q, v
        # The LCP's gaps are about the reference, as all else in it.
        under = it.qs if c.mpc_model == "ncp" else task.q_ref
        task.ground[:] = self.terrain.planes(under[:, 7:].reshape(H + 1, C, 3))
        task.ground[:, :, 3] += shift * task.ground[:, :, 2]
        status, _, _, defect, _ = ddp.solve(
            self._body, task, c.kappa, it, _PENALTY, False, c.iterations, c.tolerance, 1e-7, _REG, self._work
        )
        failed = status == ddp.NOT_FINITE or (status == ddp.STUCK and not defect < _DEFECT)
        if failed and last is not None:
            plan = replace(last, status=1, seconds=time.perf_counter() - start)
        else:
            plan = Plan(
                t=knots, q=it.qs, v=it.vs, u=it.us, lam=it.lam, gains=self._work.K.copy(), status=int(failed),
                u_max=self.model.u_max.ravel(), defect=float(defect), seconds=time.perf_counter() - start,
            )  # fmt: skip
        self._plan = plan
        return plan
