"""References with exact dynamics, made by hand: what the points do and which forces act on them is chosen, the inputs
and the body's motion follow."""

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel


def follow(model: PointFootModel, h, points, lam, *, body, robot_digest="") -> Reference:
    """The reference whose points start at rest and go through `points` under the contact forces `lam`.

    Args:
        h: (T - 1,) s.  points: (T, C, 3) m.  lam: (T - 1, C, 3) N.  body: (7,) its first pose, at rest.
    """
    C, T = model.C, len(points)
    q, v = np.zeros((T, 7 + 3 * C)), np.zeros((T, 6 + 3 * C))
    q[:, 7:], q[0, :7] = points.reshape(T, -1), body
    v[1:, 6:] = np.diff(points, axis=0).reshape(T - 1, -1) / h[:, None]
    acceleration = np.diff(v[:, 6:], axis=0).reshape(T - 1, C, 3) / h[:, None, None]
    gravity = np.array([0, 0, -model.g])
    u = lam + model.foot_mass[:, None] * (gravity - acceleration)
    for k in range(T - 1):
        R, w = Rotation.from_quat(q[k, 3:7]), v[k, 3:6]
        torque = R.inv().apply(np.cross(points[k] - q[k, :3], u[k]).sum(axis=0)) - np.cross(w, model.inertia @ w)
        v[k + 1, :3] = v[k, :3] + h[k] * (u[k].sum(axis=0) / model.mass + gravity)
        v[k + 1, 3:6] = w + h[k] * np.linalg.solve(model.inertia, torque)
        q[k + 1, :3] = q[k, :3] + h[k] * v[k + 1, :3]
        q[k + 1, 3:7] = (R * Rotation.from_rotvec(h[k] * v[k + 1, 3:6])).as_quat()
    return Reference(
        t=np.concatenate([[0.0], np.cumsum(h)]), h=h, q=q, v=v, u=u.reshape(T - 1, -1), lam=lam,
        point_names=model.names, robot_digest=robot_digest,
    )  # fmt: skip


def carrying(model: PointFootModel, body, points, *, on=None) -> np.ndarray:
    """(C, 3) N: vertical contact forces at `points` (C, 3) that hold the body and the points still.

    Args:
        body: (3,) m.  on: the points that may push, default all.
    """
    on = np.ones(model.C, bool) if on is None else np.asarray(on)
    r = points - body
    weight = model.foot_mass * model.g
    # Inputs u = lam - foot weight: their sum is the body's weight, their moment about the body nothing.
    A = np.stack([np.ones(model.C), r[:, 0], r[:, 1]])
    b = np.array([model.mass * model.g, 0.0, 0.0]) + A @ weight
    lam = np.zeros((model.C, 3))
    lam[on, 2] = np.linalg.lstsq(A[:, on], b)[0]
    if lam[:, 2].min() < 0:
        lam[on, 2], _ = nnls(A[:, on], b)
    return lam


def standing(model: PointFootModel, body, points, *, steps=20, h=0.05) -> Reference:
    """Nothing moves: body (7,) over points (C, 3)."""
    lam = np.tile(carrying(model, body[:3], points), (steps, 1, 1))
    return follow(model, np.full(steps, h), np.tile(points, (steps + 1, 1, 1)), lam, body=body)
