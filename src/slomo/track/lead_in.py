"""How a motion is entered from standing still.

A reference may begin at speed, with feet in the air and its centre of mass beside the feet, and no robot can. The
lead-in stands near the reference's first pose with every foot on the ground and bearing weight, then moves into it,
gathers its velocity and lifts the feet that begin in the air. Every leg reaches its foot: the body stands lower, and
where a stride is too long for that, one foot steps to where it begins. It is a kinematic blend with forces of
near-static balance, for the controller to follow; it comes before t = 0.
"""

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray

SWING = 0.3  # s, in which a foot that begins in the air leaves the ground
LEAST = 0.6  # of an even share of the weight, what each foot bears in the stand
IN_AIR = 0.005  # m, height from which a foot counts as in the air
CROUCH = 0.1  # of the longest leg, by how much the body stands lower rather than have a foot step


def with_lead_in(
    reference: Reference, model: PointFootModel, *, standing: Array, terrain: Terrain, settle: float, blend: float
) -> Reference:
    """The reference with `settle` + `blend` (s) before its start, at negative times, in steps of its first h.

    Args:
        standing: (C, 3) m, base frame, where the points are when the robot just stands. Feet that begin in the air, or
            too far from the body to stand there, come from there.
    """
    lifted = _lifted(model, reference.points[0], terrain)
    most = CROUCH * float(model.leg_max.max())
    for _ in range(model.C):
        lead = _Lead(reference, model, lifted, standing=standing, terrain=terrain, settle=settle, blend=blend)
        lower = lead.lower()
        stays = ~lifted & ~model.is_hand
        worst = int(np.where(stays, lower, 0).argmax())
        foot = _foot(model, worst)
        if lower[worst] <= most or not stays[~foot].any():
            break
        lifted = lifted | foot
    lead.sink(min(float(lower.max()), most))
    lead.carry_hands(reference)
    h, t, q, v, points, stance = lead.h, lead.t, lead.q, lead.v, lead.points, lead.stance
    n = len(t)

    acceleration = np.gradient(v[:, :3], h, axis=0)
    u = np.array([balance(model, q[k, :3], points[k], stance[k], acceleration[k]) for k in range(n)])
    lam = np.where(stance[..., None], u + [0, 0, model.g] * model.foot_mass[:, None], 0.0)
    return Reference(
        t=np.concatenate([reference.t[0] + t, reference.t]),
        h=np.concatenate([np.full(n, h), reference.h]),
        q=np.vstack([q, reference.q]),
        v=np.vstack([v, reference.v]),
        u=np.vstack([u.reshape(n, -1), reference.u]),
        lam=np.concatenate([lam, reference.lam]),
        point_names=reference.point_names,
        robot_digest=reference.robot_digest,
    )


class _Lead:
    """The lead-in's configurations, with `lifted` (C,) the feet that come from where the robot just stands.

    Attributes:
        h: s.  t: (n,) s.  q: (n, 7 + 3 C), v: (n, 6 + 3 C), and points, speeds (n, C, 3), which are views into them.
        stance: (n, C) bool.  fade: (n,) from 1 in the stand to 0, smooth; fade_speed: its derivative, 1/s.
    """

    def __init__(
        self,
        reference: Reference,
        model: PointFootModel,
        lifted: Array,
        *,
        standing: Array,
        terrain: Terrain,
        settle: float,
        blend: float,
    ):
        self.model = model
        h, T0 = float(reference.h[0]), settle + blend
        n = max(2, int(np.ceil(T0 / h)))
        t = np.arange(-n, 0) * h
        q0, v0 = reference.q[0], reference.v[0]
        q, v = np.tile(q0, (n, 1)), np.zeros((n, len(v0)))

        # Body: x(s) = x0 + v0 T (s^3 - 1) / 3 ends at x0 with v0, and starts at rest without a jump of acceleration.
        # Height and orientation must also start where they end: z(s) = z0 + vz T (s^3 - s^2).
        s = np.clip(1 + t / blend, 0, 1)
        there, back, speed_back = (s**3 - 1) * blend / 3, (s**3 - s**2) * blend, 3 * s**2 - 2 * s
        self.fade, self.fade_speed = 1 - s**3 * (10 - 15 * s + 6 * s**2), -30 * s**2 * (1 - s) ** 2 / blend
        q[:, :2] += there[:, None] * v0[:2]
        q[:, 2] += back * v0[2]
        q[:, 3:7] = (Rotation.from_quat(q0[3:7]) * Rotation.from_rotvec(back[:, None] * v0[3:6])).as_quat()
        v[:, :2], v[:, 2:6] = (s**2)[:, None] * v0[:2], speed_back[:, None] * v0[2:6]
        q[:, 3:7] *= np.where(q[:, 3:7] @ q0[3:7] < 0, -1.0, 1.0)[:, None]

        points, speeds = q[:, 7:].reshape(n, -1, 3), v[:, 6:].reshape(n, -1, 3)
        stance = np.tile(~model.is_hand, (n, 1))
        s = np.clip(1 + t / SWING, 0, 1)
        arrive, speed = s**2 * (3 - 2 * s), 6 * s * (1 - s) / SWING
        late, late_speed = (s**3 - s**2) * SWING, 3 * s**2 - 2 * s
        p0, w0 = reference.points[0], v0[6:].reshape(-1, 3)
        for c in np.flatnonzero(lifted).tolist():
            ground, end = _ground(model, c, lifted, (q[0] + q0) / 2, p0, standing, terrain), p0[c]
            points[:, c] = ground + arrive[:, None] * (end - ground)
            speeds[:, c] = speed[:, None] * (end - ground)
            points[:, c, :2] += late[:, None] * w0[c, :2]
            speeds[:, c, :2] += late_speed[:, None] * w0[c, :2]
            points[:, c, 2] = np.maximum(points[:, c, 2], terrain.height(points[:, c]))
            stance[:, c] = s <= 0
        self.h, self.t, self.q, self.v, self.points, self.speeds, self.stance = h, t, q, v, points, speeds, stance
        # The body stands where every foot bears weight, and comes from there, from rest to rest.
        self._shift(np.append(_into_balance(model, q[0, :3], points[0]), 0.0))

    def _shift(self, by: Array) -> None:
        """Stand off the way by `by` (3,) m."""
        self.q[:, :3] += self.fade[:, None] * by
        self.v[:, :3] += self.fade_speed[:, None] * by

    def lower(self) -> Array:
        """(C,) m: how much lower the body had to stand so that each leg reaches its foot; inf where no height does."""
        early = self.fade > 0.5
        roots = self.q[early, None, :3] + np.einsum(
            "nij,cj->nci", Rotation.from_quat(self.q[early, 3:7]).as_matrix(), self.model.leg_roots
        )
        along = roots - self.points[early]
        aside = self.model.leg_max**2 - np.sum(along[..., :2] ** 2, axis=-1)
        need = np.where(aside > 0, along[..., 2] - np.sqrt(np.maximum(aside, 0)), np.inf) / self.fade[early, None]
        return np.where(self.model.is_hand, 0.0, np.maximum(need, 0).max(0))

    def sink(self, by: float) -> None:
        """Stand lower by so much (m)."""
        self._shift(np.array([0.0, 0.0, -by]))

    def carry_hands(self, reference: Reference) -> None:
        """Hands are where the reference begins as the body has them, and gather their speed in the last `SWING`."""
        q0, v0 = reference.q[0], reference.v[0]
        R, R0 = Rotation.from_quat(self.q[:, 3:7]), Rotation.from_quat(q0[3:7])
        s = np.clip(1 + self.t / SWING, 0, 1)
        for c in np.flatnonzero(self.model.is_hand):
            rel = R0.inv().apply(reference.points[0, c] - q0[:3])
            speed = R0.inv().apply(v0[6 + 3 * c : 9 + 3 * c] - v0[:3]) - np.cross(v0[3:6], rel)
            path = self.q[:, :3] + R.apply(rel + ((s**3 - s**2) * SWING)[:, None] * speed)
            self.points[:, c] = path
            self.speeds[:, c] = np.gradient(path, self.h, axis=0)


def _lifted(model: PointFootModel, points: Array, terrain: Terrain) -> Array:
    """(C,) bool, which feet (or toes, or heels) at points (C, 3) begin in the air."""
    return (points[:, 2] - terrain.height(points) > IN_AIR) & ~model.is_hand


def _foot(model: PointFootModel, c: int) -> Array:
    """(C,) bool, the points on the foot of point c."""
    foot = np.arange(model.C) == c
    for pair in model.pairs:
        foot[pair] |= c in pair
    return foot


def _ground(
    model: PointFootModel, c: int, lifted: Array, body: Array, points: Array, standing: Array, terrain: Terrain
) -> Array:
    """(3,) m, where lifted point c comes from: a heel (or toe) whose other end stays, from flat on the ground beside
    it, for on toes alone nobody stands; a whole foot from where it is when the robot just stands."""
    for p, pair in enumerate(model.pairs):
        if c in pair and not lifted[pair].all():
            other = points[pair[0] if c == pair[1] else pair[1]]
            along = points[c, :2] - other[:2]
            xy = other[:2] + model.pair_length[p] / np.linalg.norm(along) * along
            return np.append(xy, terrain.height(xy))
    return _stand_at(body, standing[c], terrain)


def _stand_at(body: Array, foot: Array, terrain: Terrain) -> Array:
    """(3,) m, on the ground under `foot` (3,) m of the base frame, for a body (7,) turned about the vertical only."""
    heading = Rotation.from_euler("Z", Rotation.from_quat(body[3:7]).as_euler("ZYX")[0])
    p = body[:3] + heading.apply(foot)
    return np.append(p[:2], terrain.height(p))


def _into_balance(model: PointFootModel, body: Array, points: Array) -> Array:
    """(2,) m: by how much the body (3,) is to move so that every foot at points (C, 3) bears at least `LEAST`.

    The shares w of the weight are those that bring sum w_c p_c nearest to where the centre of mass is.
    """
    feet = ~model.is_hand
    mass = model.total_mass
    com = (model.mass * body[:2] + model.foot_mass @ points[:, :2]) / mass
    p, least = points[feet, :2], LEAST / feet.sum()
    rest = 1 - LEAST
    strong = 1e3  # the shares' sum against metres
    A = np.vstack([p.T - com[:, None], np.full(feet.sum(), strong)])
    b = np.append(-least * (p - com).sum(axis=0), strong * rest)
    w = nnls(A, b)[0] + least
    return (w @ p - com) * mass / model.mass


def balance(model: PointFootModel, body: Array, points: Array, stance: Array, acceleration: Array) -> Array:
    """(C, 3) N: least forces that carry the body without turning it; feet in the air hang on it. None in flight."""
    gravity = np.array([0.0, 0.0, model.g])
    u = -np.outer(np.where(stance, 0.0, model.foot_mass), gravity)
    if not stance.any():
        return np.zeros_like(u)
    arms = points - body
    wrench = np.concatenate([model.mass * (acceleration + gravity) - u.sum(axis=0), -np.cross(arms, u).sum(axis=0)])
    grasp = np.hstack([np.vstack([np.eye(3), _skew(r)]) for r in arms[stance]])
    u[stance] = np.linalg.lstsq(grasp, wrench, rcond=None)[0].reshape(-1, 3)
    return u


def _skew(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
