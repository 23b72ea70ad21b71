"""Convex model-predictive control with the reference's contact schedule: a baseline.

Di Carlo et al., "Dynamic locomotion in the MIT Cheetah 3 through convex model-predictive control" (IROS 2018): one
rigid body, small roll and pitch, heading of the reference, lever arms of feet where they will be from a body that moves
as the reference does, so that forces enter linearly,

    Theta' = R_z^T w,   p' = v,   I w' = sum_c r_c x f_c,   m v' = sum_c f_c + m g     (their eq. 17),

and a QP over the forces of the feet that the reference has on the ground, in friction pyramids. Feet stand where they
are; swinging feet go where the reference has them relative to the body, corrected by the capture point (Raibert 1986).
"""

import time
from dataclasses import replace

import clarabel
import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain
from slomo.track.mpc import MpcConfig
from slomo.track.plan import Plan, sample_all
from slomo.track.schedule import Schedule

Array = np.ndarray

_SOLVED = ("Solved", "AlmostSolved")
# Times the MPC's time step: ten of them are a cycle of a gait, as in the paper. It cannot change when feet land and so
# has to see it coming; in half of that a Go1 falls on the cat's walk.
STRETCH = 2.0


class ConvexMpc:
    """A planner like `mpc.Mpc`, with its number of steps and its weights of body and forces, and longer steps.

    Args: as of `mpc.Mpc`.
    """

    def __init__(self, model: PointFootModel, reference: Reference, *, terrain: Terrain, config: MpcConfig):
        self.model, self.reference, self.config = model, reference, config
        self._mass = np.append(model.mass, model.foot_mass)  # of body and points
        arms = (reference.points - reference.q[:, None, :3]).mean(axis=0)
        square = np.einsum("ci,ci->c", arms, arms)[:, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None, :]
        self._inertia = model.inertia + np.einsum("c,cij->ij", model.foot_mass, square)
        c = config
        self._w_x = np.repeat([c.orientation, c.position, c.angular_velocity, c.velocity], 3).astype(float)
        self._schedule = Schedule(reference, terrain)
        self._settings = clarabel.DefaultSettings()
        self._settings.verbose = False
        self.reset()

    def reset(self) -> None:
        """Forget the last plan and where feet have lifted off."""
        self._plan: Plan | None = None
        self._lift = np.zeros((self.model.C, 3))

    def warm_up(self) -> float:
        """As `mpc.Mpc.warm_up`."""
        start = time.perf_counter()
        plan = self.step(float(self.reference.t[0]), self.reference.q[0], self.reference.v[0])
        plan.feedback(float(plan.t[0]), plan.q[0], plan.v[0])
        self.reset()
        return time.perf_counter() - start

    def step(self, t: float, q: Array, v: Array, *, shift: Array | float = 0.0) -> Plan:
        """Plan from the measured state; arguments as of `mpc.Mpc.step`."""
        start = time.perf_counter()
        if self._plan is not None and not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            return self._keep(start)
        c, C, r = self.config, self.model.C, self.reference
        H, h = c.horizon, STRETCH * c.dt
        knots = t + h * np.arange(H + 1)
        q_ref, v_ref, u_ref = np.empty((H + 1, 7 + 3 * C)), np.empty((H + 1, 6 + 3 * C)), np.empty((H, 3 * C))
        sample_all(r.t, r.q, r.v, r.u, knots, q_ref, v_ref, u_ref)
        q_ref[:, 9::3] += shift
        stance = self._schedule.stance(knots[:-1] + h / 2)
        forces_ref = self._schedule.forces(knots[:-1] + h / 2)

        x_ref, x0 = self._body_states(q_ref, v_ref, q_ref[0, 3:7]), self._body_states(q[None], v[None], q_ref[0, 3:7])
        feet = self._feet(t, knots, q, x0[0], x_ref[0], q_ref)
        # From where the body is, not from the reference: a body that has come off its place over standing feet has
        # other arms, and forces that balance on the reference's tip it over.
        arms = (feet - (x_ref + x0 - x_ref[0])[:, None, 3:6])[:-1]
        problem = _condensed(x0[0], x_ref[:, 2], arms, self._mass.sum(), self._inertia, self.model.g, h)
        forces = self._solve(problem, x_ref[1:], forces_ref, stance)
        if forces is None:
            return self._keep(start)

        x = np.vstack([x0, (problem[0] + problem[1] @ forces.ravel()).reshape(H, 12)])
        q_plan, v_plan = q_ref.copy(), v_ref.copy()
        # The body is where the whole's centre of mass is, apart from how the points hang on it in the reference.
        q_plan[:, :3] += x[:, 3:6] - x_ref[:, 3:6]
        v_plan[:, :3] += x[:, 9:12] - x_ref[:, 9:12]
        R = Rotation.from_euler("ZYX", x[:, 2::-1])
        q_plan[:, 3:7], v_plan[:, 3:6] = R.as_quat(), R.inv().apply(x[:, 6:9])
        q_plan[:, 7:] = feet.reshape(H + 1, -1)
        v_plan[1:, 6:] = np.diff(q_plan[:, 7:], axis=0) / h
        # Not the measured feet: made anew at every tick, the way from there would never leave them.
        q_plan[0, :7], v_plan[0] = q[:7], v
        # What a foot does to the body: the ground's force less its own weight, or in the air what swings it.
        gravity = self.model.foot_mass[:, None] * [0.0, 0.0, -self.model.g]
        swing = np.where(stance[..., None], 0.0, u_ref.reshape(H, C, 3) - gravity)
        u = forces + gravity + swing
        self._plan = Plan(
            t=knots, q=q_plan, v=v_plan, u=u.reshape(H, -1), lam=forces, gains=np.zeros((H, 3 * C, 12 + 6 * C)),
            u_max=self.model.u_max.ravel(), status=0, defect=0.0, seconds=time.perf_counter() - start,
        )  # fmt: skip
        return self._plan

    def _keep(self, start: float) -> Plan:
        """The last plan goes on."""
        assert self._plan is not None
        self._plan = replace(self._plan, status=1, seconds=time.perf_counter() - start)
        return self._plan

    def _body_states(self, q: Array, v: Array, near: Array) -> Array:
        """(K, 12) roll, pitch, yaw; centre of mass of the whole; angular velocity (world); velocity of that centre.

        q: (K, 7 + 3 C), v: (K, 6 + 3 C).  near: quat_xyzw to whose heading the first yaw is the next.
        """
        R, n = Rotation.from_quat(q[:, 3:7]), len(q)
        yaw, pitch, roll = R.as_euler("ZYX").T
        about = Rotation.from_quat(near).as_euler("ZYX")[0]
        yaw = np.unwrap(np.append(about, yaw))[1:]
        share = self._mass / self._mass.sum()
        p = np.concatenate([q[:, None, :3], q[:, 7:].reshape(n, -1, 3)], axis=1)
        w = np.concatenate([v[:, None, :3], v[:, 6:].reshape(n, -1, 3)], axis=1)
        centre, speed = (np.einsum("c,kci->ki", share, x) for x in (p, w))
        return np.concatenate([np.stack([roll, pitch, yaw], axis=1), centre, R.apply(v[:, 3:6]), speed], axis=1)

    def _feet(self, t: float, knots: Array, q: Array, x: Array, x_ref: Array, q_ref: Array) -> Array:
        """(H + 1, C, 3) m where the feet should be: standing ones stay, swinging ones move to where they land.

        The landing place is off the reference by the body's displacement and sqrt(height / g) times its excess speed.
        """
        now, want = q[7:].reshape(-1, 3), q_ref[:, 7:].reshape(len(knots), -1, 3)
        standing = self._schedule.stance(np.array([t]))[0]
        # Along the ground only: a foot that is late to land goes on down.
        self._lift[standing, :2] = (now - want[0])[standing, :2]
        height = max(float(x_ref[5] - want[0, :, 2].min()), 0.05)
        land = (x - x_ref)[3:6] + np.sqrt(height / self.model.g) * (x - x_ref)[9:12]
        land[2] = 0.0
        # Share of the way from where it stood to where it lands, 1 once it has landed after having swung.
        s = self._schedule.progress(t, knots)[..., None]
        return want + (1 - s) * self._lift + s * land

    def _solve(self, problem: tuple[Array, Array], x_ref: Array, forces_ref: Array, stance: Array) -> Array | None:
        """(H, C, 3) N, or None where the solver failed: least deviation from the reference within the pyramids."""
        free, S = problem
        c, H = self.config, len(x_ref)
        used = np.flatnonzero(np.repeat(stance.ravel(), 3))
        forces = np.zeros(stance.size * 3)
        if not len(used):
            return forces.reshape(*stance.shape, 3)
        S = S[:, used]
        dt = STRETCH * c.dt
        h = np.full(H, dt)
        h[-1] += c.terminal
        w = (h[:, None] * self._w_x).ravel()
        effort = dt * c.effort / (self._mass.sum() * self.model.g) ** 2
        P = S.T @ (w[:, None] * S) + effort * np.eye(len(used))
        g = S.T @ (w * (free - x_ref.ravel())) - effort * forces_ref.ravel()[used]
        # Inside of the cone: one about it would allow 1.4 times the friction along its edges.
        n, mu = len(used) // 3, c.mu / np.sqrt(2)
        pyramid = np.array([[1, 0, -mu], [-1, 0, -mu], [0, 1, -mu], [0, -1, -mu], [0, 0, -1.0], [0, 0, 1.0]])
        limit = np.zeros((n, 6))
        limit[:, 5] = np.tile(self.model.u_max[:, 2], (H, 1))[stance]
        A = sparse.kron(sparse.eye(n), pyramid, format="csc")
        cones = [clarabel.NonnegativeConeT(6 * n)]
        solver = clarabel.DefaultSolver(sparse.csc_matrix(np.triu(P)), g, A, limit.ravel(), cones, self._settings)
        solution = solver.solve()
        if str(solution.status) not in _SOLVED:
            return None
        forces[used] = solution.x
        return forces.reshape(*stance.shape, 3)


def _condensed(
    x0: Array, yaw: Array, arms: Array, mass: float, inertia: Array, g: float, h: float
) -> tuple[Array, Array]:
    """States after each step as a linear function of all forces: (12 H,) without any, and (12 H, 3 C H).

    Args:
        x0: (12,) first state.  yaw: (H + 1,) rad, of the reference.  arms: (H, C, 3) m, world, from centre to feet.
        inertia: (3, 3) kg m^2, body frame.  h: s.
    """
    H, C = arms.shape[:2]
    x, S = x0.copy(), np.zeros((12, 3 * C * H))
    free, gain = np.empty((H, 12)), np.zeros((H, 12, 3 * C * H))
    for k in range(H):
        Rz = Rotation.from_euler("z", yaw[k]).as_matrix()
        A, B = np.eye(12), np.empty((12, 3 * C))
        A[0:3, 6:9], A[3:6, 9:12] = h * Rz.T, h * np.eye(3)
        turn = np.linalg.solve(Rz @ inertia @ Rz.T, np.hstack([_skew(r) for r in arms[k]]))
        push = np.tile(np.eye(3) / mass, C)
        B[0:3], B[3:6], B[6:9], B[9:12] = h * h / 2 * Rz.T @ turn, h * h / 2 * push, h * turn, h * push
        x = A @ x
        x[5] -= g * h * h / 2
        x[11] -= g * h
        S = A @ S
        S[:, 3 * C * k : 3 * C * (k + 1)] += B
        free[k], gain[k] = x, S
    return free.ravel(), gain.reshape(12 * H, -1)


def _skew(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
