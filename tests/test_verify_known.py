"""Motions whose answer is known on paper: the solver's step gives them to 1e-6, and the verifier agrees.

Formulas are those of the semi-implicit integrator (v' = v + h a, x' = x + h v'), which differ from the continuous
ones by terms of first order in h that the tests state.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from references import carrying
from slomo.motion import Reference
from slomo.optimize.check import failure
from slomo.optimize.dynamics import Body, step
from slomo.optimize.verify import verify
from slomo.pointfoot import PointFootModel
from slomo.terrain import Slope, Terrain

G = 9.81
HEIGHT = 0.3
HIPS = np.array([[0.2, 0.1, 0], [0.2, -0.1, 0], [-0.2, 0.1, 0], [-0.2, -0.1, 0]])
FEET = HIPS - [0, 0, HEIGHT]
NAMES = ("front_left", "front_right", "hind_left", "hind_right")
FLAT = Terrain()


def block(mu=0.6, **changes) -> PointFootModel:
    values = dict(
        mass=10.0, inertia=np.diag([0.1, 0.3, 0.35]), hips=HIPS, leg_min=np.full(4, 0.05), leg_max=np.full(4, 0.5),
        foot_mass=np.full(4, 0.5), u_max=np.full((4, 3), 300.0), names=NAMES, mu=mu,
    )  # fmt: skip
    return PointFootModel(**(values | changes))


def state(height=HEIGHT, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)):
    """Body and points as one rigid piece, its feet at `height` - 0.3 m: q (19,), v (18,)."""
    p = np.array([0.0, 0.0, height])
    q = np.concatenate([p, [0, 0, 0, 1.0], (FEET + p).ravel()])
    points = np.asarray(velocity) + np.cross(spin, FEET)
    return q, np.concatenate([velocity, spin, points.ravel()])


def simulate(model, start, inputs, *, h, kappa, terrain=FLAT) -> Reference:
    """The solver's own step under inputs (N, 12)."""
    (q, v), N = start, len(inputs)
    qs, vs, lam = np.zeros((N + 1, 19)), np.zeros((N + 1, 18)), np.zeros((N, 4, 3))
    qs[0], vs[0] = q, v
    body, free = Body.of(model), np.zeros(4, bool)
    for k in range(N):
        ground = terrain.planes(qs[k, 7:].reshape(4, 3))
        step(body, h, kappa, ground, free, qs[k], vs[k], inputs[k], qs[k + 1], vs[k + 1], lam[k])
    t = h * np.arange(N + 1)
    return Reference(
        t=t, h=np.full(N, h), q=qs, v=vs, u=np.array(inputs, float), lam=lam, point_names=NAMES, robot_digest=""
    )


def test_free_fall():
    """Thrown and spinning about a principal axis, far above the ground: a parabola and a constant turn."""
    model, h, N = block(), 0.02, 50
    q, v = state(height=1e4, velocity=(1.0, -0.5, 3.0), spin=(0.0, 0.0, 2.0))
    r = simulate(model, (q, v), np.zeros((N, 12)), h=h, kappa=1e-10)
    t, k = r.t, np.arange(N + 1)
    fall = np.stack([1.0 * t, -0.5 * t, 3.0 * t - G * h * h * k * (k + 1) / 2], axis=1)
    assert np.allclose(r.q[:, :3], q[:3] + fall, atol=1e-6, rtol=0)
    assert np.allclose(fall[:, 2], 3.0 * t - G * t * t / 2 - G * h * t / 2)
    turned = Rotation.from_quat(r.q[:, 3:7]).as_euler("zyx")
    assert np.allclose(np.unwrap(turned[:, 0]), 2.0 * t, atol=1e-6)
    # Nothing holds the points to the body: each flies its own parabola.
    speeds = np.cross([0, 0, 2.0], FEET)
    assert np.allclose(r.points, q[7:].reshape(4, 3) + fall[:, None] + t[:, None, None] * speeds, atol=1e-6, rtol=0)
    assert np.abs(r.lam).max() < 1e-6
    free = block(leg_max=np.full(4, 10.0), leg_min=np.zeros(4))
    checks = verify(free, r, terrain=FLAT)
    assert failure(checks) is None
    assert checks["slip_per_second"].value == 0


def test_free_fall_that_is_too_slow_is_found():
    model = block(leg_max=np.full(4, 10.0), leg_min=np.zeros(4))
    r = simulate(model, state(height=1e4), np.zeros((50, 12)), h=0.02, kappa=1e-10)
    z = 0.001 * r.t**2  # falls with g - 0.002 m/s^2
    q, v = r.q.copy(), r.v.copy()
    for i in (2, 9, 12, 15, 18):
        q[:, i] += z
    v[1:, [2, 8, 11, 14, 17]] += (np.diff(z) / 0.02)[:, None]
    slow = Reference(**{**vars(r), "q": q, "v": v})
    assert verify(model, slow, terrain=FLAT)["dynamics_residual"].value == pytest.approx(0.002 * 0.02, rel=1e-2)


@pytest.mark.parametrize("angle", [0.0, 15.0])
def test_a_sliding_block(angle):
    """Pushed on the flat, and down a slope that is too steep to hold: Coulomb's force, on the cone's edge."""
    mu, h, N, v0 = 0.2, 0.002, 100, 1.0
    a = np.radians(angle)
    along, normal = np.array([np.cos(a), 0, -np.sin(a)]), np.array([np.sin(a), 0, np.cos(a)])
    terrain = Terrain(slopes=(Slope(-50, 50, -50, 50, height=50 * np.tan(a), slope_x=-np.tan(a)),))
    model = block(mu)
    rate = G * (np.sin(a) - mu * np.cos(a))  # m/s^2 along the slope
    turn = Rotation.from_euler("y", a)
    r0 = turn.apply(FEET)
    q = np.concatenate([HEIGHT * normal, turn.as_quat(), (r0 + HEIGHT * normal).ravel()])
    v = np.concatenate([v0 * along, np.zeros(3), np.tile(v0 * along, 4)])
    # Normal forces: the block's weight, and no moment of the inputs about the body.
    pull = rate * along - [0, 0, -G]
    direction = normal - mu * along
    A = np.stack([np.ones(4), *np.cross(r0, direction).T])
    inputs_without = -model.foot_mass[:, None] * pull
    b = np.concatenate([[model.total_mass * G * np.cos(a)], -np.cross(r0, inputs_without).sum(axis=0)])
    gamma = np.linalg.lstsq(A, b)[0]
    lam = gamma[:, None] * direction
    assert np.allclose(A @ gamma, b)
    u = lam + inputs_without
    r = simulate(model, (q, v), np.tile(u.ravel(), (N, 1)), h=h, kappa=1e-13, terrain=terrain)
    k = np.arange(N + 1)
    path = v0 * r.t + rate * h * h * k * (k + 1) / 2
    assert np.allclose(r.q[:, :3], q[:3] + path[:, None] * along, atol=1e-6)
    assert np.allclose(r.v[:, :3] @ along, v0 + rate * r.t, atol=1e-6)
    assert np.allclose(r.lam, lam, atol=1e-6)
    checks = verify(model, r, terrain=terrain)
    # Everything is as it should be, but a block that slides is no foot that stands.
    assert [n for n, c in checks.items() if not c.holds] == ["slip_per_second"]
    assert checks["slip_per_second"].value == pytest.approx(4 * path[-1] / r.t[-1], abs=1e-6)
    slippery = verify(block(mu - 0.01), r, terrain=terrain)
    assert slippery["friction_violation"].value == pytest.approx(0.01 * gamma.max(), abs=1e-6)


def test_a_foot_landing():
    """Feet fall freely, and stop within the step that takes them to the ground; the impulse is their momentum."""
    model, h, N = block(leg_max=np.full(4, 10.0), leg_min=np.zeros(4)), 0.01, 40
    drop = 0.2
    r = simulate(model, state(height=HEIGHT + drop), np.zeros((N, 12)), h=h, kappa=1e-14)
    k = np.arange(N + 1)
    free = drop - G * h * h * k * (k + 1) / 2
    first = int(np.argmax(free < 0))  # the knot at which free flight would be under the ground
    z = r.points[..., 2]
    assert np.allclose(z[:first].T, free[:first], atol=1e-6)
    assert np.allclose(z[first:], 0, atol=1e-6)
    m = model.foot_mass[0]
    falling, last = G * h * (first - 1), free[first - 1]
    # The last bit of way is gone through at last / h; the ground takes the rest of the speed, then that.
    assert np.allclose(r.lam[first - 1, :, 2], m * ((falling + G * h) - last / h) / h, atol=1e-6)
    assert np.allclose(r.v[first, 8::3], -last / h, atol=1e-6)
    assert np.allclose(r.lam[first, :, 2], m * (last / h + G * h) / h, atol=1e-6)
    assert np.allclose(r.v[first + 1 :, 8::3], 0, atol=1e-6)
    momentum = h * r.lam[: first + 5, :, 2].sum(axis=0)
    assert np.allclose(momentum, m * G * h * (first + 5), atol=1e-6)
    assert np.allclose(r.lam[first + 1 :, :, 2], m * G, atol=1e-6)
    assert failure(verify(model, r, terrain=FLAT)) is None


def test_a_standing_robot():
    """Nothing moves, and the ground carries the weight and no more."""
    model, h, N = block(), 0.05, 40
    q, v = state()
    lam = carrying(model, q[:3], FEET + q[:3])
    u = lam.copy()
    u[:, 2] -= model.foot_mass * G
    assert u.sum(axis=0) == pytest.approx([0, 0, model.mass * G])
    r = simulate(model, (q, v), np.tile(u.ravel(), (N, 1)), h=h, kappa=1e-10)
    assert np.allclose(r.q, q, atol=1e-6)
    assert np.allclose(r.v, 0, atol=1e-6)
    assert np.allclose(r.lam.sum(axis=1), [0, 0, model.total_mass * G], atol=1e-6)
    assert np.allclose(r.lam, lam, atol=1e-6)
    checks = verify(model, r, terrain=FLAT)
    assert failure(checks) is None
    assert checks["slip_per_second"].value < 1e-9
