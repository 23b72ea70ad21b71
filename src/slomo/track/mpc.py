"""Contact-implicit model-predictive control: the optimiser's compiled DDP over a short horizon, at every tick.

From the measured state, H knots ahead, one or two Gauss-Newton steps from the last plan (a real-time iteration; Diehl,
Bock, Schloeder 2005). Nothing is scheduled: which foot stands when follows from the cost and the contact model.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from slomo.motion import Reference
from slomo.optimize import constraints, ddp, so3
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body, minus
from slomo.optimize.iterate import Iterate, Work
from slomo.optimize.jit import compiled
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray

_REG = 1e-6  # first Levenberg-Marquardt factor of every tick: one grown in an earlier tick would freeze the plan
_DEFECT = 1.0  # l1 norm of the gaps under which an iterate that finds no further descent is a plan
_PENALTY = 1e4  # 1/m^2


@dataclass(frozen=True)
class MpcConfig:
    """Parameters of the controller; weights as in `optimize.problem.Weights`.

    Attributes:
        horizon: number of steps.  dt: s, their length.
        iterations: most Newton steps a tick.  tolerance: relative decrease of the cost that ends them.
        mu: friction coefficient to plan with.  kappa: N m, smoothing of the contact.
        effort: 1/N^2, weight of the deviation from the reference's forces.
        terminal: s, weight of the end state (as if it lasted that long).
    """

    horizon: int = 10
    dt: float = 0.025
    iterations: int = 4
    tolerance: float = 1e-6
    mu: float = 0.6
    kappa: float = 1e-3
    position: float = 1000.0
    orientation: float = 300.0
    foot: float = 300.0
    foot_height: float = 500.0
    velocity: float = 10.0
    angular_velocity: float = 2.0
    foot_velocity: float = 0.5
    effort: float = 2e-4
    acceleration: float = 0.0
    slip: float = 300.0
    slip_load: float = 2.0
    terminal: float = 0.1


@compiled
def _sample(knots, qs, vs, us, t, q, v, u):
    """State at time t between knots (N + 1,), by linear interpolation (rotations along the geodesic), and the velocity
    and input of the step that t is in, as the integrator has them. Outside of the knots it stands still."""
    N = us.shape[0]
    k, after = 0, N + 1  # the last knot that is not later, by bisection: references may be minutes long
    while after - k > 1:
        middle = (k + after) // 2
        if t >= knots[middle] - 1e-9:
            k = middle
        else:
            after = middle
    moving = 1.0 if k < N and t >= knots[0] - 1e-9 else 0.0
    n = min(k + 1, N)
    a = moving * max(t - knots[k], 0.0) / (knots[n] - knots[k]) if n > k else 0.0
    w = np.empty(3)
    so3.minus(qs[n, 3:7], qs[k, 3:7], w)
    so3.plus(qs[k, 3:7], a * w[0], a * w[1], a * w[2], q[3:7])
    for i in range(qs.shape[1]):
        if i < 3 or i >= 7:
            q[i] = (1 - a) * qs[k, i] + a * qs[n, i]
    for i in range(v.shape[0]):
        v[i] = moving * vs[n, i]
    for i in range(u.shape[0]):
        u[i] = us[min(k, N - 1), i]


@compiled
def _sample_all(knots, qs, vs, us, t, q_out, v_out, u_out):
    """`_sample` at times t (M + 1,): states at them, velocities and inputs in the middle of the step before."""
    u, v = np.empty(us.shape[1]), np.empty(vs.shape[1])
    for k in range(t.shape[0]):
        before = 0.5 * (t[k] + t[k - 1]) if k > 0 else t[0] - 0.5 * (t[1] - t[0])
        _sample(knots, qs, vs, us, before, q_out[k], v_out[k], u_out[k - 1] if k > 0 else u)
        _sample(knots, qs, vs, us, t[k], q_out[k], v, u)


@dataclass(frozen=True)
class PlanPoint:
    """The plan at one time, world frame.

    Attributes:
        position: (3,) m.  quat_xyzw: (4,).  velocity: (3,) m/s.  angular_velocity: (3,) rad/s, body frame.
        points, point_velocities: (C, 3) m, m/s.  u: (C, 3) N, of each point on the body.  lam: (C, 3) N, of the ground.
        t: s, the time.
    """

    position: Array
    quat_xyzw: Array
    velocity: Array
    angular_velocity: Array
    points: Array
    point_velocities: Array
    u: Array
    lam: Array
    t: float = 0.0


@dataclass(frozen=True)
class Plan:
    """What the controller intends from time `t` on.

    Attributes:
        t: (H + 1,) s, its knots; the first is when the state was measured.
        q (H + 1, 7 + 3 C), v (H + 1, 6 + 3 C), u (H, 3 C), lam (H, C, 3): as in `motion.Reference`.
        gains: (H, 3 C, 12 + 6 C), Riccati feedback of u on the tangent-space deviation from q, v.
        status: 0 solved, 1 the solver failed and the previous plan goes on.
        defect: l1 norm of what the dynamics lack over the horizon.
        seconds: wall time of the solve.
    """

    t: Array
    q: Array
    v: Array
    u: Array
    lam: Array
    gains: Array
    u_max: Array
    status: int
    defect: float
    seconds: float

    def at(self, t: float) -> PlanPoint:
        """The plan at time t (s), between its knots; before or after them it stands still."""
        q, v, u = np.empty(self.q.shape[1]), np.empty(self.v.shape[1]), np.empty(self.u.shape[1])
        _sample(self.t, self.q, self.v, self.u, t, q, v, u)
        return PlanPoint(
            position=q[:3],
            quat_xyzw=q[3:7],
            velocity=v[:3],
            angular_velocity=v[3:6],
            points=q[7:].reshape(-1, 3),
            point_velocities=v[6:].reshape(-1, 3),
            u=u.reshape(-1, 3),
            lam=self.lam[self._step(t)],
            t=t,
        )

    def feedback(self, t: float, q: Array, v: Array) -> Array:
        """(C, 3) N: the forces for the state that is there at time t, by the Riccati gains, within the limits."""
        qp, vp, u = np.empty(self.q.shape[1]), np.empty(self.v.shape[1]), np.empty(self.u.shape[1])
        _sample(self.t, self.q, self.v, self.u, t, qp, vp, u)
        k = self._step(t)
        a = min(max((t - self.t[k]) / (self.t[k + 1] - self.t[k]), 0.0), 1.0)
        d = np.empty(2 * len(v))
        minus(q, v, qp, (1 - a) * self.v[k] + a * self.v[k + 1], d)
        return np.clip(u + self.gains[k] @ d, -self.u_max, self.u_max).reshape(-1, 3)

    def _step(self, t: float) -> int:
        return min(max(int(np.searchsorted(self.t, t + 1e-9)) - 1, 0), len(self.u) - 1)


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
        self._task = Task(
            h=h, ground=np.tile([0.0, 0.0, 1.0, 0.0], (H + 1, C, 1)), stick=np.zeros((H, C), bool),
            q_ref=np.zeros((H + 1, nv + 1)), v_ref=np.zeros((H + 1, nv)),
            u_ref=np.zeros((H, 3 * C)), w_x=w, w_u=np.full((H, 3 * C), c.effort),
            u_low=np.tile(-model.u_max.ravel(), (H, 1)), u_high=np.tile(model.u_max.ravel(), (H, 1)),
            w_acceleration=c.acceleration, w_spin=0.0, w_slip=c.slip, slip_load=c.slip_load, cyclic=False,
            shift=np.zeros(4),
        )  # fmt: skip
        self._work = Work.make(self._new_iterate())
        r = reference
        self._t_ref, self._q_ref, self._v_ref, self._u_ref = (
            np.ascontiguousarray(x, float) for x in (r.t, r.q, r.v, r.u)
        )
        self._hold = self._standing_forces()
        self._plan: Plan | None = None

    def _standing_forces(self) -> Array:
        """(3 C,) N: the weight split over the points that stand in the reference's last state."""
        gap = self.reference.points[-1, :, 2] - self.terrain.height(self.reference.points[-1])
        near = np.exp(-np.maximum(gap, 0) / 0.01) + 1e-3
        u = np.zeros((self.model.C, 3))
        u[:, 2] = self.model.mass * self.model.g * near / near.sum()
        return u.ravel()

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
        knots = origin + c.dt * (np.floor((t - origin) / c.dt + 0.2) + np.arange(H + 1))
        knots[0] = t
        task.h[0] = knots[1] - t
        _sample_all(self._t_ref, self._q_ref, self._v_ref, self._u_ref, knots, task.q_ref, task.v_ref, task.u_ref)
        task.q_ref[:, 9::3] += shift
        task.u_ref[knots[1:] > self.reference.t[-1] + 1e-9] = self._hold
        last = self._plan
        it = self._new_iterate()
        if last is not None:
            # The last plan as far as it reaches; what follows stays at the reference.
            n = int(np.searchsorted(knots, last.t[-1] + 1e-9)) - 1
            if n > 0:
                _sample_all(last.t, last.q, last.v, last.u, knots[: n + 1], it.qs[: n + 1], it.vs[: n + 1], it.us[:n])
        it.qs[0], it.vs[0] = q, v
        task.ground[:] = self.terrain.planes(it.qs[:, 7:].reshape(H + 1, C, 3))
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
