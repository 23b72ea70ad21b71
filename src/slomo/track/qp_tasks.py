"""What the whole-body QP is asked to do: accelerations of body, feet, hands and joints, and contact forces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.floating_base import FloatingBase
from slomo.track.plan import PlanPoint
from slomo.track.posture import Posture
from slomo.track.sole import ContactPoint, contact_points

Array = np.ndarray


@dataclass(frozen=True)
class QpConfig:
    """Weights (of accelerations: 1 is the body's) and gains (1/s^2, 1/s) of the tasks.

    Attributes:
        body, turn: linear and angular acceleration of the body, as planned.
        balance: feedback of soles that have a width, see `Tasks.balance`.
        stance: feet on the ground stay; stance_kd: 1/s, how their motion dies out.
        landing: feet in the air that should bear load come down; landing_frequency: rad/s, how fast, critically damped.
        swing, swing_kp, swing_kd: feet in the air follow the plan.
        hand: hands do, with the same gains.
        posture, posture_kp, posture_kd: joints, towards the reference's angles.  trunk: weight of those that carry
            more than one limb.
        force: of forces as accelerations (f / robot mass), towards the planned ones.
        loaded: share of the weight above which a planned force makes a contact.
        still: m/s, slower than which a planned foot on the ground makes one.
        near: m over the ground, up to which a foot can be in contact.
        margin: s, within which a joint may come to a stop at its limit.
        hold: s, after which the motor PD's targets are where the accelerations lead.
        frequency: rad/s, and damping: of the motor PD of a joint alone: kp = I w^2, kd = 2 damping I w.
    """

    body: float = 1.0
    turn: float = 0.3
    balance: float = 0.3
    stance: float = 10.0
    stance_kd: float = 20.0
    landing: float = 3.0
    landing_frequency: float = 30.0
    swing: float = 0.3
    swing_kp: float = 300.0
    swing_kd: float = 40.0
    hand: float = 0.03
    posture: float = 1e-3
    trunk: float = 0.3
    posture_kp: float = 100.0
    posture_kd: float = 20.0
    force: float = 1e-3
    loaded: float = 0.02
    still: float = 0.1
    near: float = 0.012
    margin: float = 0.05
    hold: float = 0.01
    frequency: float = 20.0
    damping: float = 1.0


@dataclass(frozen=True)
class View:
    """The points as they are: positions, velocities (C, 3) m, m/s in the reference's world; ground (C, 4) planes under
    them (`Terrain.planes`); stance (C,) bool; late (C,) bool, that should bear load and are in the air; the contacts of
    those that stand."""

    positions: Array
    velocities: Array
    ground: Array
    stance: Array
    late: Array
    contacts: list[ContactPoint]


class Tasks:
    """Tasks of one robot along one reference (with its lead-in); `body` is updated by the caller."""

    def __init__(
        self,
        robot: Robot,
        reference: Reference,
        body: FloatingBase,
        posture: Posture,
        *,
        terrain: Terrain,
        config: QpConfig,
    ):
        self.robot, self.reference, self.body, self.terrain, self.config = robot, reference, body, terrain, config
        self.model = PointFootModel.from_robot(robot)
        self._posture = posture
        self._base = robot.model.getFrameId(robot.base)
        self._points = [robot.model.getFrameId(name) for name in robot.foot_names]
        self._contacts = contact_points(robot)
        across = {p.limb: p.offset for p in reversed(self._contacts)}
        self._soles = [(toe, heel, across[toe]) for toe, heel in robot.pairs]
        self._raise = np.array([0.0, 0.0, robot.foot_radius])
        self._posture_weight = np.where(_carry_limbs(robot, self._points), config.trunk, config.posture)

    def look(self, now: PlanPoint, ahead: PlanPoint) -> View:
        """Where the points are, and which of them stand: near the ground, and loaded or at rest in the plan."""
        c, body = self.config, self.body
        positions = np.array([body.placement(f).translation for f in self._points]) - self._raise
        velocities = np.array([body.velocity(f)[:3] for f in self._points])
        ground = self.terrain.planes(positions)
        gap = np.sum(ground[:, :3] * positions, axis=1) - ground[:, 3]
        loaded = now.lam[:, 2] > c.loaded * self.robot.mass * self.model.g
        stays = np.linalg.norm(ahead.points - now.points, axis=1) < c.still * _between(now, ahead)
        stance = (loaded | stays) & (gap < c.near) & ~self.model.is_hand
        late = loaded & ~stance & ~self.model.is_hand
        return View(positions, velocities, ground, stance, late, [p for p in self._contacts if stance[p.limb]])

    def motion(self, view: View, now: PlanPoint, ahead: PlanPoint, u: Array) -> tuple[Array, Array, Array]:
        """Jacobians (k, nv), the accelerations J a that are wanted (k,), less what velocities make, weights (k,)."""
        rows = [self._of_body(view, now.t, u), *self._of_points(view, now, ahead), *self._of_soles(view)]
        J, want, w = zip(*rows, strict=True)
        return np.concatenate(J), np.concatenate(want), np.concatenate(w)

    def _of_body(self, view: View, t: float, u: Array) -> tuple[Array, Array, Array]:
        """The body accelerates as the point-foot model does under the leg forces u (C, 3)."""
        body, model = self.body, self.model
        T_world_base = body.placement(self._base)
        R, velocity = T_world_base.rotation, body.velocity(self._base)
        arms = view.positions + self._raise - T_world_base.translation
        omega = R.T @ velocity[3:]
        linear = u.sum(axis=0) / model.mass - [0, 0, model.g]
        linear[:2] += self.balance(t, T_world_base.translation[:2], velocity[:2])
        turning = R.T @ np.cross(arms, u).sum(axis=0) - np.cross(omega, model.inertia @ omega)
        angular = R @ np.linalg.solve(model.inertia, turning)
        want = np.concatenate([linear, angular]) - body.drift(self._base)
        return body.jacobian(self._base), want, np.repeat([self.config.body, self.config.turn], 3)

    def balance(self, t: float, position: Array, velocity: Array) -> Array:
        """(2,) m/s^2, what the width of soles can do for the balance, of which a plan for points knows nothing.

        The divergent component of motion x + v / w, with w^2 = g / height, is led back to the reference's (Takenaka et
        al. 2009; Englsberger et al. 2015). Nothing for feet that are points.
        """
        if not self._soles:
            return np.zeros(2)
        r, g = self.reference, self.model.g
        k = int(np.clip(np.searchsorted(r.t, t) - 1, 0, len(r.t) - 2))
        s = np.clip((t - r.t[k]) / (r.t[k + 1] - r.t[k]), 0, 1)
        wanted = (1 - s) * r.q[k, :2] + s * r.q[k + 1, :2]
        w = np.sqrt(g / self.robot.standing_height)
        return -self.config.balance * w**2 * (position - wanted + (velocity - r.v[k + 1, :2]) / w)

    def _of_points(self, view: View, now: PlanPoint, ahead: PlanPoint) -> list[tuple[Array, Array, Array]]:
        """Standing feet stay, the other points follow the plan."""
        c, rows = self.config, []
        accelerations = (ahead.point_velocities - now.point_velocities) / _between(now, ahead)
        for i, f in enumerate(self._points):
            if view.stance[i]:
                want, w = -c.stance_kd * view.velocities[i], c.stance
            elif view.late[i]:
                n, d = view.ground[i, :3], c.landing_frequency
                down = d * d * (n @ view.positions[i] - view.ground[i, 3])
                want, w = -2 * d * view.velocities[i] - down * n, c.landing
            else:
                w = c.hand if self.model.is_hand[i] else c.swing
                off, slow = now.points[i] - view.positions[i], now.point_velocities[i] - view.velocities[i]
                want = accelerations[i] + c.swing_kp * off + c.swing_kd * slow
            rows.append((self.body.jacobian(f)[:3], want - self.body.drift(f)[:3], np.full(3, w)))
        return rows

    def _of_soles(self, view: View) -> list[tuple[Array, Array, Array]]:
        """Soles lie flat sideways: as if their edges (in the air, something as far aside as their ends) were points."""
        c, body, rows = self.config, self.body, []
        for toe, heel, across in self._soles:
            f = self._points[toe]
            along = view.positions[toe] - view.positions[heel]
            length, width = np.linalg.norm(along), np.linalg.norm(across)
            along = along / length
            tilt = (body.placement(f).rotation @ across) @ view.ground[toe, :3] / width
            standing = view.stance[toe] or view.stance[heel]
            want = -c.swing_kp * tilt - c.swing_kd * (along @ body.velocity(f)[3:]) - along @ body.drift(f)[3:]
            w = c.stance * width**2 if standing else c.swing * length**2
            rows.append(((along @ body.jacobian(f)[3:])[None], np.array([want]), np.array([w])))
        return rows

    def posture(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Weights (nj,) and accelerations (nj,) rad/s^2 of joints at q, v (nj,) towards the reference's."""
        wanted, speed = self._posture.at(t)
        return self._posture_weight, self.config.posture_kp * (wanted - q) + self.config.posture_kd * (speed - v)

    def forces(self, contacts: Sequence[ContactPoint], u: Array) -> Array:
        """(K, 3) N, world: the planned force of each limb, which also carries its point, shared by its contacts."""
        share = np.bincount([p.limb for p in contacts], minlength=len(u))
        planned = u + np.outer(self.model.foot_mass, [0, 0, self.model.g])
        return np.array([planned[p.limb] / share[p.limb] for p in contacts]).reshape(-1, 3)


def _between(now: PlanPoint, ahead: PlanPoint) -> float:
    """s."""
    return max(ahead.t - now.t, 1e-3)


def _carry_limbs(robot: Robot, points: Sequence[int]) -> Array:
    """(nj,) bool: joints of the trunk, which carry more than one limb."""
    model = robot.model
    ends = {model.frames[f].parentJoint for f in points}
    return np.array([sum(j in model.supports[end] for end in ends) > 1 for j in range(2, model.njoints)])
