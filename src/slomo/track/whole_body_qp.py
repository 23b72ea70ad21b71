"""Whole-body quadratic program: from the plan of the point-foot model to torques of all joints.

At every joint tick, the joint accelerations and contact forces x = (a_j, f) that come nearest to what the plan asks,

    min  sum_i w_i |J_i a(x) + dJ_i v - a_i*|^2 + w_f |f - f*|^2
    such that  |tau(x)| <= effort,   f in the friction pyramids,   joint limits as bounds of a_j (soft),

with a(x) and tau(x) from `FloatingBase`. Tasks are weighted, not ranked (as in Escande, Mansard and Wieber 2014 they
could be; Del Prete et al. 2016 show the same program without a hierarchy). Torque limits and friction are hard, and
f = 0 with tau = 0 satisfies them, so that only the joint limits have to be soft for a solution to exist always.
Solved by DAQP (Arnstrom, Bemporad, Axehill 2022), a dual active-set method.
"""

from dataclasses import dataclass

import daqp
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.actuators import torque_limits
from slomo.track.floating_base import FloatingBase
from slomo.track.joint_space import JointCommand
from slomo.track.plan import PlanPoint
from slomo.track.posture import Posture
from slomo.track.sole import contact_points

Array = np.ndarray

SOFT = 8  # DAQP's mark of a constraint that gives way
SOLVED = (1, 2)  # DAQP's exit flags: optimal; soft constraints gave way


@dataclass(frozen=True)
class QpConfig:
    """Weights (of accelerations: 1 is the body's) and gains (1/s^2, 1/s) of the tasks.

    Attributes:
        body, turn: linear and angular acceleration of the body, as planned.
        stance: feet on the ground stay; stance_kd: 1/s, how their motion dies out.
        swing, swing_kp, swing_kd: feet in the air follow the plan.
        hand: hands do, with the same gains.
        posture, posture_kp, posture_kd: all joints, towards the reference's angles.
        force: of forces as accelerations (f / robot mass), towards the planned ones.
        loaded: share of the weight above which a planned force makes a contact.
        near: m over the ground, up to which a foot can be in contact.
        margin: s, within which a joint may come to a stop at its limit.
        hold: s, after which the motor PD's targets are where the accelerations lead.
        frequency: rad/s, and damping: of the motor PD of a joint alone: kp = I w^2, kd = 2 damping I w.
    """

    body: float = 1.0
    turn: float = 0.3
    stance: float = 10.0
    stance_kd: float = 20.0
    swing: float = 0.3
    swing_kp: float = 300.0
    swing_kd: float = 25.0
    hand: float = 0.03
    posture: float = 1e-3
    trunk: float = 0.3
    posture_kp: float = 100.0
    posture_kd: float = 20.0
    force: float = 1e-3
    balance: float = 0.5
    loaded: float = 0.02
    near: float = 0.012
    still: float = 0.1
    margin: float = 0.05
    hold: float = 0.01
    frequency: float = 20.0
    damping: float = 1.0


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
    """

    def __init__(
        self,
        robot: Robot,
        reference: Reference,
        *,
        terrain: Terrain,
        mu: float,
        config: QpConfig | None = None,
    ):
        self.robot, self.terrain, self.config = robot, terrain, config or QpConfig()
        self.mu = mu / np.sqrt(2)  # the pyramid within the cone
        self.body = FloatingBase(robot, robot.rotor_inertia)
        self.model = PointFootModel.from_robot(robot)
        self.posture = Posture(robot, reference)
        self._reference = reference
        self._base = robot.model.getFrameId(robot.base)
        self._points = [robot.model.getFrameId(name) for name in robot.foot_names]
        self._hand = np.array([limb.is_hand for limb in robot.limbs])
        self._contacts = contact_points(robot)
        self._soles = [(p, self._across(*p)) for p in robot.pairs]
        self._determined = len(robot.joint_names) == 3 * len(robot.limbs)
        self._raise = np.array([0.0, 0.0, robot.foot_radius])
        data = self.body.model.createData()
        inertia = np.diag(pin.crba(self.body.model, data, robot.q_nominal))[6:]
        c = self.config
        self._posture_weight = np.where(self._carried(), c.trunk, c.posture)
        self.kp, self.kd = inertia * c.frequency**2, 2 * c.damping * inertia * c.frequency
        self.reset()

    def reset(self) -> None:
        """Forget the last torques."""
        self._tau = np.zeros(len(self.robot.effort))
        self._acceleration = np.zeros_like(self._tau)
        self.failures = 0

    def _across(self, toe: int, heel: int) -> Array:
        """(3,) m, from a sole's middle line to its left edge, in its foot frame."""
        for p in self._contacts:
            if p.limb == toe:
                return p.offset
        raise AssertionError(heel)

    def command(self, now: PlanPoint, ahead: PlanPoint, *, u: Array, q: Array, v: Array) -> JointCommand:
        """Torques for the state (q, v), and joint targets.

        Args:
            now, ahead: the plan now, and a little later, at which the joint targets aim.
            u: (C, 3) N, world, forces of the feet on the body, with feedback.
            q: (nq,) and v: (nv,), the whole robot in Pinocchio's convention.
        """
        if not self._solve(now, ahead, u, q, v):
            self.failures += 1
        if self._determined:
            joints, speeds = self.posture.towards(ahead)
        else:
            h, a = self.config.hold, self._acceleration
            joints, speeds = q[7:] + h * v[6:] + h * h / 2 * a, v[6:] + h * a
        return JointCommand(joints, speeds, self._tau, self.kp, self.kd)

    def _balance(self, t: float, position: Array, velocity: Array) -> Array:
        """(2,) m/s^2, what a sole's width can do for the balance, of which a plan with feet without width knows nothing.

        Feedback of the divergent component of motion x + v / w (Takenaka 2009; Englsberger 2015), with w^2 = g / height,
        towards the reference's.
        """
        r, k = self._reference, int(np.clip(np.searchsorted(self._reference.t, t) - 1, 0, len(self._reference.t) - 2))
        s = (t - r.t[k]) / (r.t[k + 1] - r.t[k])
        wanted = (1 - s) * r.q[k, :2] + s * r.q[k + 1, :2]
        w = np.sqrt(self.model.g / self.robot.standing_height)
        ahead = position[:2] - wanted + (velocity[:2] - r.v[k + 1, :2]) / w
        return -self.config.balance * w * w * ahead

    def _carried(self) -> Array:
        """(nj,) bool: joints of the trunk, which carry more than one limb."""
        model = self.robot.model
        ends = {model.frames[f].parentJoint for f in self._points}
        return np.array([sum(j in model.supports[end] for end in ends) > 1 for j in range(2, model.njoints)])

    def _solve(self, now: PlanPoint, ahead: PlanPoint, u: Array, q: Array, v: Array) -> bool:
        c, body = self.config, self.body
        body.update(q, v)
        weight = self.robot.mass * self.model.g
        positions = np.array([body.placement(f).translation for f in self._points]) - self._raise
        velocities = np.array([body.velocity(f)[:3] for f in self._points])
        ground = self.terrain.planes(positions)
        gap = np.sum(ground[:, :3] * positions, axis=1) - ground[:, 3]
        stays = np.linalg.norm(ahead.points - now.points, axis=1) < c.still * max(ahead.t - now.t, 1e-3)
        stance = ((now.lam[:, 2] > c.loaded * weight) | stays) & (gap < c.near) & ~self._hand
        contacts = [p for p in self._contacts if stance[p.limb]]
        a0, A, t0, T = body.affine(contacts)
        nj, n = body.nj, A.shape[1]

        rows: list[tuple[Array, Array, Array]] = []  # Jacobian (k, nv), what a = a* - drift (k,), weights (k,)
        # The body, by the point-foot model's equations.
        T_world_base = body.placement(self._base)
        R = T_world_base.rotation
        arms = positions + self._raise - T_world_base.translation
        omega = R.T @ body.velocity(self._base)[3:]
        inertia = self.model.inertia
        linear = u.sum(axis=0) / self.model.mass - [0, 0, self.model.g]
        linear[:2] += self._balance(now.t, T_world_base.translation, body.velocity(self._base))
        angular = R @ np.linalg.solve(inertia, R.T @ np.cross(arms, u).sum(axis=0) - np.cross(omega, inertia @ omega))
        want = np.concatenate([linear, angular]) - body.drift(self._base)
        rows.append((body.jacobian(self._base), want, np.repeat([c.body, c.turn], 3)))
        # Feet and hands.
        accelerations = (ahead.point_velocities - now.point_velocities) / max(ahead.t - now.t, 1e-3)
        for i, f in enumerate(self._points):
            if stance[i]:
                want, w = -c.stance_kd * velocities[i], c.stance
            else:
                w = c.hand if self._hand[i] else c.swing
                want = (
                    accelerations[i]
                    + c.swing_kp * (now.points[i] - positions[i])
                    + c.swing_kd * (now.point_velocities[i] - velocities[i])
                )
            rows.append((body.jacobian(f)[:3], want - body.drift(f)[:3], np.full(3, w)))
        for (toe, heel), across in self._soles:
            along = positions[toe] - positions[heel]
            length = np.linalg.norm(along)
            along /= length
            J = along @ body.jacobian(self._points[toe])[3:]
            f = self._points[toe]
            tilt = (body.placement(f).rotation @ across) @ ground[toe, :3] / np.linalg.norm(across)
            want = -c.swing_kp * tilt - c.swing_kd * (along @ body.velocity(f)[3:]) - along @ body.drift(f)[3:]
            # As if the sole's edges, and in the air something as far aside as its ends, had to be where they should.
            standing = stance[toe] or stance[heel]
            w = c.stance * float(across @ across) if standing else c.swing * length**2
            rows.append((J[None], np.array([want]), np.array([w])))

        self._w0 = np.concatenate([r[1] for r in rows])
        J, want, w = (np.concatenate([r[k] for r in rows]) for k in range(3))
        G = J @ A
        g = want - J @ a0
        H = (G * w[:, None]).T @ G
        f0 = -(G * w[:, None]).T @ g
        # Posture and forces have diagonal Hessians.
        q_ref, v_ref = self.posture.at(now.t)
        posture = c.posture_kp * (q_ref - q[7:]) + c.posture_kd * (v_ref - v[6:])
        H[range(nj), range(nj)] += self._posture_weight
        f0[:nj] -= self._posture_weight * posture
        share = np.bincount([p.limb for p in contacts], minlength=len(self._points))
        planned = u + np.outer(self.model.foot_mass, [0, 0, self.model.g])
        force = np.array([planned[p.limb] / share[p.limb] for p in contacts]).reshape(-1)
        w_f = c.force / self.robot.mass**2
        H[range(nj, n), range(nj, n)] += w_f
        f0[nj:] -= w_f * force

        lower, upper = self._acceleration_bounds(q[7:], v[6:])
        cone = self._friction(contacts, ground, nj)
        big = np.full(3 * len(contacts), 1e6)
        weakest, strongest = torque_limits(self.robot, v[6:])
        high = np.concatenate([upper, big, strongest - t0, np.full(len(cone), 1e6)])
        low = np.concatenate([lower, -big, weakest - t0, np.zeros(len(cone))])
        sense = np.zeros(len(high), np.int32)
        sense[:nj] = SOFT
        try:
            x, _, flag, _ = daqp.solve(H, f0, np.vstack([T, cone]), high, low, sense)
        except ValueError:
            return False
        if flag not in SOLVED or not np.all(np.isfinite(x)):
            return False
        self.solution = dict(
            a=a0 + A @ x, f=x[nj:].reshape(-1, 3), contacts=contacts, a_err=(J @ (a0 + A @ x) - self._w0)[:6]
        )
        self._tau, self._acceleration = np.clip(t0 + T @ x, weakest, strongest), x[:nj]
        return True

    def _friction(self, contacts, ground: Array, nj: int) -> Array:
        """(5 K, n) rows that are not negative for forces within the pyramids about the ground's normals."""
        out = np.zeros((5 * len(contacts), nj + 3 * len(contacts)))
        for k, p in enumerate(contacts):
            n = ground[p.limb, :3]
            x = np.array([1.0, 0.0, 0.0]) - n[0] * n
            x /= np.linalg.norm(x)
            y = np.cross(n, x)
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
