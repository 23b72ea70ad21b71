"""What a motion does with the ground: contact, friction, slip. Plain NumPy on points and forces, whatever the model.

Forces of step k are judged where the step ends, at knot k + 1, which is where an implicit contact model applies them.
The gap of a point is its distance from the plane of the terrain under it, n . (f - ground).
"""

import numpy as np

from slomo.optimize.check import Check, worst
from slomo.terrain import Terrain

Array = np.ndarray

LOADED = 1.0  # N, a point is in contact during a step when its normal force exceeds this
BETWEEN = 0.02  # m, about a foot's radius: how deep the straight path of a point may cut through an edge
SAMPLES = 8  # of a step


def gaps(points: Array, terrain: Terrain) -> Array:
    """(...) m, signed distance of points (..., 3) from the plane of the ground under them."""
    return terrain.normal(points)[..., 2] * (points[..., 2] - terrain.height(points))


def normal_and_tangential(points: Array, lam: Array, terrain: Terrain) -> tuple[Array, Array]:
    """Normal force (T - 1, C) N, negative when it pulls, and size of the tangential one, at the ends of the steps.

    Args:
        points: (T, C, 3) m.  lam: (T - 1, C, 3) N.
    """
    n = terrain.normal(points[1:])
    normal = np.sum(n * lam, axis=2)
    return normal, np.linalg.norm(lam - normal[..., None] * n, axis=2)


def slip_path(points: Array, lam: Array, terrain: Terrain) -> Array:
    """(T - 1, C) m, path along the ground of each point in each step in which it is loaded, else 0."""
    n = terrain.normal(points[1:])
    d = np.diff(points, axis=0)
    along = np.linalg.norm(d - np.sum(n * d, axis=2, keepdims=True) * n, axis=2)
    return along * (normal_and_tangential(points, lam, terrain)[0] > LOADED)


def ground_checks(
    t: Array, points: Array, lam: Array, *, terrain: Terrain, mu: float, names: tuple[str, ...]
) -> dict[str, Check]:
    """Every check that needs only points (T, C, 3) m, forces (T - 1, C, 3) N and times (T,) s.

    complementarity: |gap| times normal force, N m.  penetration: m, at the knots.  friction_violation: N, tangential
    force beyond the cone.  pull: N, negative normal force.  slip_per_second: m/s, path along the ground of all loaded
    points together, over the duration; its place is the longest single step of it.
    penetration_between (a warning): m, how deep the straight paths between knots cut through the ground.
    """
    t1 = t[1:]
    gap = gaps(points, terrain)
    normal, tangential = normal_and_tangential(points, lam, terrain)
    slip = slip_path(points, lam, terrain)
    longest = worst(slip, 0.0, "m", t1, names)
    total = float(slip.sum() / (t[-1] - t[0]))
    return {
        "complementarity": worst(np.abs(gap[1:] * normal), 1e-4, "N m", t1, names),
        "penetration": worst(np.maximum(-gap, 0.0), 1e-3, "m", t, names),
        "friction_violation": worst(np.maximum(tangential - mu * normal.clip(0.0), 0.0), 1e-6, "N", t1, names),
        "pull": worst(np.maximum(-normal, 0.0), 1e-9, "N", t1, names),
        "slip_per_second": Check(total if np.isfinite(total) else np.inf, 0.01, "m/s", longest.t, longest.point),
        "penetration_between": _between(t, points, terrain, names),
    }


def _between(t: Array, points: Array, terrain: Terrain, names: tuple[str, ...]) -> Check:
    """How deep the paths between knots, which the integrator makes straight, go through the ground."""
    s = np.arange(1, SAMPLES) / SAMPLES
    path = points[:-1, None] + s[:, None, None] * np.diff(points, axis=0)[:, None]  # (T - 1, SAMPLES - 1, C, 3)
    times = t[:-1, None] + s * np.diff(t)[:, None]
    deep = np.maximum(-gaps(path, terrain), 0.0)
    # Beside an edge the way out is sideways: the nearest place, of a ring, whose ground is not above the point.
    inside = deep > 1e-6
    p, d = path[inside], deep[inside]
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for share in np.arange(SAMPLES - 1, 0, -1) / SAMPLES:
        beside = p[:, None, :2] + (share * deep[inside])[:, None, None] * ring
        out = np.any(terrain.height(beside) <= p[:, None, 2], axis=1)
        d = np.where(out, share * deep[inside], d)
    deep[inside] = d
    return worst(deep.reshape(-1, len(names)), BETWEEN, "m", times.ravel(), names, required=False)
