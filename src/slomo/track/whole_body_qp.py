"""Whole-body quadratic program: from the plan of the point-foot model to torques of all joints.

At every joint tick, the joint accelerations and contact forces x = (a_j, f) that come nearest to what the plan asks,

    min  sum_i w_i |J_i a(x) + dJ_i v - a_i*|^2 + w_f |f - f*|^2
    such that  torques within what the motors have at this speed,   f in the friction pyramids,
               joint ranges and speeds as bounds of a_j, which give way,

with a(x) and tau(x) from `FloatingBase`. Tasks are weighted, not ranked (Del Prete et al. 2016, "Implementing torque
control with high-ratio gear boxes and without joint-torque sensors", section 2). f = 0 with tau = 0 satisfies all that
is hard, so there is always a solution. Solved by DAQP (Arnstrom, Bemporad, Axehill 2022), a dual active-set method.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.motion import Reference
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.actuators import torque_limits
from slomo.track.floating_base import FloatingBase
from slomo.track.joint_space import JointCommand
from slomo.track.plan import PlanPoint
from slomo.track.posture import Posture
from slomo.track.qp_tasks import QpConfig, Tasks
from slomo.track.sole import ContactPoint

Array = np.ndarray

SOFT = 8  # DAQP's mark of a constraint that gives way
SOLVED = (1, 2)  # DAQP's exit flags: optimal; soft constraints gave way
FREE = 1e6  # N, no bound


@dataclass(frozen=True)
class Solution:
    """a: (nv,) m/s^2, rad/s^2, root in its own frame.  tau: (nj,) N m.  f: (K, 3) N, world, at K contacts."""

    a: Array
    tau: Array
    f: Array
    contacts: tuple[ContactPoint, ...]


class WholeBodyQp:
    """Joint layer: `command` at the joint rate.

    Args:
        robot: the robot.
        reference: with the lead-in; its joint angles are the posture.
        terrain: ground under the feet's frames, in the reference's world.
        mu: friction coefficient to reckon with.
        config: weights and gains.

    Attributes:
        failures: ticks without a solution, at which the last torques went on.
        kp: (nj,) N m/rad.  kd: (nj,) N m s/rad, of the motor PD.
    """

    def __init__(
        self, robot: Robot, reference: Reference, *, terrain: Terrain, mu: float, config: QpConfig | None = None
    ):
        self.robot, self.config = robot, config or QpConfig()
        self.mu = mu / np.sqrt(2)  # the pyramid within the cone
        self.body = FloatingBase(robot, robot.rotor_inertia)
        self.posture = Posture(robot, reference)
        self.tasks = Tasks(robot, reference, self.body, self.posture, terrain=terrain, config=self.config)
        self._determined = len(robot.joint_names) == 3 * len(robot.limbs)
        inertia = np.diag(pin.crba(self.body.model, self.body.model.createData(), robot.q_nominal))[6:]
        w, damping = self.config.frequency, self.config.damping
        self.kp, self.kd = inertia * w**2, 2 * damping * inertia * w
        self.reset()

    def reset(self) -> None:
        """Forget the last torques."""
        nj = len(self.robot.effort)
        self._last = Solution(np.zeros(6 + nj), np.zeros(nj), np.zeros((0, 3)), ())
        self.failures = 0

    def command(self, now: PlanPoint, ahead: PlanPoint, *, u: Array, q: Array, v: Array) -> JointCommand:
        """Torques for the state (q, v), and joint targets.

        The motor PD aims at the plan's joints where the feet determine them, as in quadrupeds; else, at where the
        solution's accelerations lead.

        Args:
            now, ahead: the plan now, and a little later, at which the joint targets aim.
            u: (C, 3) N, world, forces of the feet on the body, with feedback.
            q: (nq,) and v: (nv,), the whole robot in Pinocchio's convention.
        """
        solution = self.solve(now, ahead, u=u, q=q, v=v)
        if solution is None:
            self.failures += 1
        else:
            self._last = solution
        if self._determined:
            joints, speeds = self.posture.towards(ahead)
        else:
            h, a = self.config.hold, self._last.a[6:]
            joints, speeds = q[7:] + h * v[6:] + h * h / 2 * a, v[6:] + h * a
        return JointCommand(joints, speeds, self._last.tau, self.kp, self.kd)

    def solve(self, now: PlanPoint, ahead: PlanPoint, *, u: Array, q: Array, v: Array) -> Solution | None:
        """The program's solution, arguments as of `command`; None where DAQP finds none, as for states not finite."""
        c, body = self.config, self.body
        body.update(q, v)
        view = self.tasks.look(now, ahead)
        contacts = view.contacts
        a0, A, t0, T = body.affine(contacts)
        nj, n = body.nj, A.shape[1]

        J, want, w = self.tasks.motion(view, now, ahead, u)
        G, g = J @ A, want - J @ a0
        H = (G * w[:, None]).T @ G
        linear = -(G * w[:, None]).T @ g
        # Posture and forces have diagonal Hessians.
        weight, posture = self.tasks.posture(now.t, q[7:], v[6:])
        H[range(nj), range(nj)] += weight
        linear[:nj] -= weight * posture
        w_f = c.force / self.robot.mass**2
        H[range(nj, n), range(nj, n)] += w_f
        linear[nj:] -= w_f * self.tasks.forces(contacts, u).ravel()

        lower, upper = self._acceleration_bounds(q[7:], v[6:])
        weakest, strongest = torque_limits(self.robot, v[6:])
        cone = self._friction(contacts, view.ground, nj)
        free = np.full(n - nj, FREE)
        high = np.concatenate([upper, free, strongest - t0, np.full(len(cone), FREE)])
        low = np.concatenate([lower, -free, weakest - t0, np.zeros(len(cone))])
        sense = np.zeros(len(high), np.int32)
        sense[:nj] = SOFT
        if not (np.all(np.isfinite(H)) and np.all(np.isfinite(linear)) and np.all(np.isfinite(high - low))):
            return None
        x, _, flag, _ = daqp.solve(H, linear, np.vstack([T, cone]), high, low, sense)
        if flag not in SOLVED:
            return None
        tau = np.clip(t0 + T @ x, weakest, strongest)
        return Solution(a0 + A @ x, tau, x[nj:].reshape(-1, 3), tuple(contacts))

    def _friction(self, contacts: Sequence[ContactPoint], ground: Array, nj: int) -> Array:
        """(5 K, n) rows that are not negative for forces within the pyramids about the normals of `ground` (C, 4)."""
        out = np.zeros((5 * len(contacts), nj + 3 * len(contacts)))
        for k, p in enumerate(contacts):
            n = ground[p.limb, :3]
            x = np.array([1.0, 0.0, 0.0]) - n[0] * n
            x /= np.linalg.norm(x)
            y = np.array([n[1] * x[2] - n[2] * x[1], n[2] * x[0] - n[0] * x[2], n[0] * x[1] - n[1] * x[0]])
            out[5 * k : 5 * k + 5, nj + 3 * k : nj + 3 * k + 3] = [
                n, self.mu * n - x, self.mu * n + x, self.mu * n - y, self.mu * n + y
            ]  # fmt: skip
        return out

    def _acceleration_bounds(self, q: Array, v: Array) -> tuple[Array, Array]:
        """(nj,) rad/s^2, lower and upper: such that within `margin` no joint is beyond its range or speed."""
        m, robot = self.config.margin, self.robot
        upper = np.minimum((robot.velocity - v) / m, 2 * (robot.upper - q - m * v) / m**2)
        lower = np.maximum((-robot.velocity - v) / m, 2 * (robot.lower - q - m * v) / m**2)
        return np.minimum(lower, upper), np.maximum(lower, upper)
