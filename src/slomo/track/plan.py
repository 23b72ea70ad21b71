"""What a planner hands to the joints: a motion of the point-foot model over the next steps, with its feedback."""

from dataclasses import dataclass

import numpy as np

from slomo.optimize import so3
from slomo.optimize.dynamics import minus
from slomo.optimize.jit import compiled

Array = np.ndarray


@compiled
def sample(knots, qs, vs, us, t, q, v, u):
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
def sample_all(knots, qs, vs, us, t, q_out, v_out, u_out):
    """`sample` at times t (M + 1,): states at them, velocities and inputs in the middle of the step before."""
    u, v = np.empty(us.shape[1]), np.empty(vs.shape[1])
    for k in range(t.shape[0]):
        before = 0.5 * (t[k] + t[k - 1]) if k > 0 else t[0] - 0.5 * (t[1] - t[0])
        sample(knots, qs, vs, us, before, q_out[k], v_out[k], u_out[k - 1] if k > 0 else u)
        sample(knots, qs, vs, us, t[k], q_out[k], v, u)


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
        sample(self.t, self.q, self.v, self.u, t, q, v, u)
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
        sample(self.t, self.q, self.v, self.u, t, qp, vp, u)
        k = self._step(t)
        a = min(max((t - self.t[k]) / (self.t[k + 1] - self.t[k]), 0.0), 1.0)
        d = np.empty(2 * len(v))
        minus(q, v, qp, (1 - a) * self.v[k] + a * self.v[k + 1], d)
        return np.clip(u + self.gains[k] @ d, -self.u_max, self.u_max).reshape(-1, 3)

    def _step(self, t: float) -> int:
        return min(max(int(np.searchsorted(self.t, t + 1e-9)) - 1, 0), len(self.u) - 1)
