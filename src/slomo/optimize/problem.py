"""From robot-sized key points to what the solver is asked for: targets, weights, ground, and a start."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion
from slomo.optimize import constraints
from slomo.optimize.cost import Task
from slomo.optimize.dynamics import Body
from slomo.optimize.iterate import Iterate
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray


@dataclass(frozen=True)
class Weights:
    """Weights of the cost (see `cost`), per second of motion.

    Attributes:
        position: 1/m^2, body.  orientation: 1/rad^2.  foot: 1/m^2, horizontal.  foot_height: 1/m^2.
        velocity: s^2/m^2, of the body.  angular_velocity: s^2/rad^2.  foot_velocity: s^2/m^2.
        effort: of forces as shares of the robot's weight.  acceleration: s^4/m^2, of the body.
        spin: of the body's angular acceleration in units of g over the longest limb: whole robots have no such torques.
        slip: s^2/m^2.  slip_load: share of the robot's weight, normal force from which slip counts half.
    """

    position: float = 1000.0
    orientation: float = 200.0
    foot: float = 500.0
    foot_height: float = 3000.0
    velocity: float = 1.0
    angular_velocity: float = 0.5
    foot_velocity: float = 0.3
    effort: float = 1.65
    acceleration: float = 0.05
    spin: float = 0.5
    slip: float = 1000.0
    slip_load: float = 0.0156


@dataclass(frozen=True)
class Targets:
    """What the motion should look like, on the solver's time grid.

    Attributes:
        t: (T,) s.  q: (T, 7 + 3 C), v: (T, 6 + 3 C) as in `motion.Reference`.
        body_confidence: (T,).  foot_confidence: (T, C).
    """

    t: Array
    q: Array
    v: Array
    body_confidence: Array
    foot_confidence: Array

    @property
    def points(self) -> Array:
        """(T, C, 3) m."""
        return self.q[:, 7:].reshape(len(self.t), -1, 3)


def _resample(motion: KeypointMotion, name: str, t: Array) -> tuple[Array, Array]:
    """Position (T, 3) and confidence (T,) of a key point at times t; missing stretches are bridged."""
    i = motion.index(name)
    c = motion.confidence[:, i]
    seen = np.flatnonzero(c > 0)
    if not len(seen):
        raise InvalidData(f"key point {name!r} has no confidence anywhere", where="keypoints.npz")
    x = np.stack([np.interp(t, motion.t[seen], motion.positions[seen, i, k]) for k in range(3)], axis=1)
    return x, np.interp(t, motion.t, c)


def _orientation(hips: Array, observed: Array, weights: Array) -> Rotation:
    """Rotations that best map hips (C, 3) to observed (T, C, 3), both about their weighted mean (Kabsch 1976)."""
    w = weights[..., None] + 1e-9
    a = hips - np.sum(w * hips, axis=1, keepdims=True) / np.sum(w, axis=1, keepdims=True)
    b = observed - np.sum(w * observed, axis=1, keepdims=True) / np.sum(w, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.einsum("tci,tcj->tij", w * b, a))
    sign = np.ones((len(b), 3))
    sign[:, 2] = np.sign(np.linalg.det(U @ Vt))
    return Rotation.from_matrix(np.einsum("tij,tj,tjk->tik", U, sign, Vt))


def velocities(t: Array, q: Array) -> Array:
    """(T, 6 + 3 C) velocities with q_next = q + h v_next, the first as the second."""
    h = np.diff(t)[:, None]
    R = Rotation.from_quat(q[:, 3:7])
    w = (R[:-1].inv() * R[1:]).as_rotvec() / h
    d = np.diff(q, axis=0) / h
    v = np.concatenate([d[:, :3], w, d[:, 7:]], axis=1)
    return np.concatenate([v[:1], v])


def targets(motion: KeypointMotion, model: PointFootModel, terrain: Terrain, *, dt: float) -> Targets:
    """Resample `base`, `<limb>_hip` and the model's key points to steps of dt (s); points are lifted to the ground.

    Raises:
        InvalidData: a key point is missing, or the motion is shorter than two steps.
    """
    steps = int(np.floor((motion.t[-1] - motion.t[0]) / dt + 1e-9))
    if steps < 2:
        raise InvalidData(f"lasts {motion.t[-1] - motion.t[0]:.3f} s, shorter than two steps of {dt} s", where="motion")
    t = motion.t[0] + dt * np.arange(steps + 1)
    base, c_base = _resample(motion, "base", t)
    hips = [_resample(motion, f"{n}_hip", t) for n in model.names]
    seen = [n for n in model.key_points if np.any(motion.confidence[:, motion.index(n)] > 0)]
    if not seen:
        raise InvalidData("no foot has any confidence", where="keypoints.npz")
    R = _orientation(model.hips, np.stack([x for x, _ in hips], axis=1), np.stack([c for _, c in hips], axis=1))
    points, c_foot = np.empty((len(t), model.C, 3)), np.zeros((len(t), model.C))
    for c, name in enumerate(model.key_points):
        if name in seen:
            points[:, c], c_foot[:, c] = _resample(motion, name, t)
        else:
            # Nothing is known of this point: under its hip, a foot on the ground, with no weight.
            points[:, c] = base + R.apply(model.hips[c])
            points[:, c, 2] -= 0.5 * (model.leg_min + model.leg_max)[c] if np.isinf(model.clearance[c]) else np.inf
    points[..., 2] = np.maximum(points[..., 2], terrain.height(points))
    q = np.concatenate([base, R.as_quat(), points.reshape(len(t), -1)], axis=1)
    return Targets(t=t - t[0], q=q, v=velocities(t, q), body_confidence=c_base, foot_confidence=c_foot)


@dataclass(frozen=True)
class Steps:
    """Step lengths as unknowns: shortest and longest as factors of the nominal length, and the weight (per second of
    motion) of the squared relative deviation from it."""

    shortest: float
    longest: float
    weight: float


def make_task(
    model: PointFootModel, want: Targets, terrain: Terrain, weights: Weights, *, steps: Steps | None = None
) -> Task:
    """The solver's task for targets (N + 1 knots), with fixed step lengths unless `steps` frees them."""
    T, C = len(want.t), model.C
    nv = 6 + 3 * C
    cb, cf = want.body_confidence[:, None], want.foot_confidence
    w_x = np.zeros((T, 2 * nv))
    w_x[:, :3], w_x[:, 3:6] = weights.position * cb, weights.orientation * cb
    w_x[:, 6:nv] = (cf[:, :, None] * [weights.foot, weights.foot, weights.foot_height]).reshape(T, -1)
    w_x[:, nv : nv + 3], w_x[:, nv + 3 : nv + 6] = weights.velocity, weights.angular_velocity
    w_x[:, nv + 6 :] = weights.foot_velocity
    h = np.diff(want.t)
    u_high = np.tile(model.u_max.ravel(), (T - 1, 1))
    weight = model.total_mass * model.g
    u_low, u_ref, w_u = -u_high, np.zeros((T - 1, 3 * C)), np.full((T - 1, 3 * C), weights.effort / weight**2)
    if steps is not None:
        u_low, u_high = np.column_stack([u_low, steps.shortest * h]), np.column_stack([u_high, steps.longest * h])
        u_ref, w_u = np.column_stack([u_ref, h]), np.column_stack([w_u, steps.weight / h**2])
    return Task(
        h=np.append(h, h[-1]),
        ground=np.ascontiguousarray(terrain.planes(want.points)),
        stick=np.zeros((T - 1, C), bool),
        q_ref=np.ascontiguousarray(want.q),
        v_ref=np.ascontiguousarray(want.v),
        u_ref=u_ref,
        w_x=w_x,
        w_u=w_u,
        u_low=u_low,
        u_high=u_high,
        w_acceleration=weights.acceleration,
        w_spin=weights.spin * (float(model.leg_max.max()) / model.g) ** 2,
        w_slip=weights.slip,
        slip_load=weights.slip_load * weight,
        cyclic=False,
        shift=np.zeros(4),
    )


def make_start(model: PointFootModel, want: Targets, task: Task) -> Iterate:
    """Body and feet at their targets, the weight split over the feet near the ground, swinging feet held up."""
    T, C = len(want.t), model.C
    gap = np.maximum(np.sum(task.ground[..., :3] * want.points, axis=2) - task.ground[..., 3], 0.0)
    near = np.exp(-gap / 0.01) + 1e-3
    share = near / near.sum(axis=1, keepdims=True)
    u = np.zeros((T - 1, C, 3))
    u[..., 2] = share[1:] * model.mass * model.g - (gap[1:] > 0.01) * model.foot_mass * model.g
    us = task.u_ref.copy()
    us[:, : 3 * C] = u.reshape(T - 1, -1)
    return Iterate.at(want.q, want.v, np.clip(us, task.u_low, task.u_high), C=C, M=constraints.number(Body.of(model)))
