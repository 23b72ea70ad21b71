"""How a motion is entered from standing still.

A reference may begin at speed and with feet in the air, and no robot can. The lead-in stands in the reference's first
pose with every foot on the ground, then gathers its velocity and lifts the feet that begin in the air. It is a
kinematic blend with forces of near-static balance, for the controller to follow; it comes before t = 0.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

Array = np.ndarray

SWING = 0.25  # s, in which a foot that begins in the air leaves the ground
IN_AIR = 0.005  # m, height from which a foot counts as in the air


def with_lead_in(
    reference: Reference, model: PointFootModel, *, terrain: Terrain, settle: float, blend: float
) -> Reference:
    """The reference with `settle` + `blend` (s) before its start, at negative times, in steps of its first h."""
    h, T0 = float(reference.h[0]), settle + blend
    n = max(2, int(np.ceil(T0 / h)))
    t = np.arange(-n, 0) * h
    q0, v0 = reference.q[0], reference.v[0]
    q, v = np.tile(q0, (n, 1)), np.zeros((n, len(v0)))

    # Body: x(s) = x0 + v0 T (s^3 - 1) / 3 ends at x0 with v0, and starts at rest without a jump of acceleration.
    # Height and orientation must also start where they end: z(s) = z0 + vz T (s^3 - s^2).
    s = np.clip(1 + t / blend, 0, 1)
    there, back, speed_back = (s**3 - 1) * blend / 3, (s**3 - s**2) * blend, 3 * s**2 - 2 * s
    q[:, :2] += there[:, None] * v0[:2]
    q[:, 2] += back * v0[2]
    q[:, 3:7] = (Rotation.from_quat(q0[3:7]) * Rotation.from_rotvec(back[:, None] * v0[3:6])).as_quat()
    v[:, :2], v[:, 2:6] = (s**2)[:, None] * v0[:2], speed_back[:, None] * v0[2:6]
    q[:, 3:7] *= np.where(q[:, 3:7] @ q0[3:7] < 0, -1.0, 1.0)[:, None]

    points = q[:, 7:].reshape(n, -1, 3)
    speeds = v[:, 6:].reshape(n, -1, 3)
    stance = np.ones(points.shape[:2], bool)
    s = np.clip(1 + t / SWING, 0, 1)
    for c, (p, w) in enumerate(zip(reference.points[0], v0[6:].reshape(-1, 3), strict=True)):
        if p[2] - terrain.height(p) < IN_AIR:
            continue
        points[:, c, :2] += ((s**3 - 1) * SWING / 3)[:, None] * w[:2]
        ground = terrain.height(points[:, c])
        rise = s**2 * (3 - 2 * s)
        points[:, c, 2] = ground + rise * (p[2] - ground)
        speeds[:, c, :2] = (s**2)[:, None] * w[:2]
        speeds[:, c, 2] = 6 * s * (1 - s) / SWING * (p[2] - ground)
        stance[:, c] = s <= 0

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
