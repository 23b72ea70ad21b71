"""The controller in closed loop on the point-foot model itself, integrated in finer steps with stiffer contact."""

from dataclasses import replace

import numpy as np
import pytest

from slomo.motion import Reference
from slomo.optimize import dynamics
from slomo.optimize.dynamics import Body
from slomo.terrain import Terrain
from slomo.track.mpc import Mpc, MpcConfig
from test_optimize import MODEL, ROBOT, optimize, trot


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference.from_arrays(optimize(trot(duration=1.5)).npz["reference.npz"])


def run(reference, *, noise=0.0, push=0.0, mass=1.0, feedback=True, replan=True, seed=0, **config):
    """Body and foot errors (K, 2), m, every 10 ms of the reference, and the last plan. The plant steps at 1 kHz."""
    rng = np.random.default_rng(seed)
    plant = Body.of(replace(MODEL, mass=MODEL.mass * mass, mu=0.8))
    mpc = Mpc(MODEL, reference, terrain=Terrain(), config=MpcConfig(**config))
    mpc.warm_up()
    q, v = reference.q[0].copy(), reference.v[0].copy()
    q1, v1, lam = np.empty_like(q), np.empty_like(v), np.zeros((4, 3))
    flat, free = np.tile([0.0, 0.0, 1.0, 0.0], (4, 1)), np.zeros(4, bool)
    errors, plan = [], mpc.step(0.0, q, v)
    for i in range(round(1000 * reference.t[-1])):
        t = i / 1000
        if i % 10 == 0:
            if replan:
                qm = q + noise * np.concatenate([rng.normal(0, 0.004, 3), np.zeros(4), rng.normal(0, 0.004, 12)])
                plan = mpc.step(t, qm, v + noise * rng.normal(0, 0.05, 18))
            k = min(i // 50, len(reference.t) - 2)
            want = reference.q[k] + (t - reference.t[k]) / reference.h[k] * (reference.q[k + 1] - reference.q[k])
            foot = np.linalg.norm((q - want)[7:].reshape(4, 3), axis=1).mean()
            errors.append([np.linalg.norm(q[:3] - want[:3]), foot])
        if i == 600:
            v[1] += push / MODEL.mass
        u = plan.feedback(t, q, v) if feedback else plan.at(t).u
        dynamics.step(plant, 0.001, 1e-6, flat, free, q, v, u.ravel(), q1, v1, lam)
        q[:], v[:] = q1, v1
    return np.array(errors), plan


@pytest.mark.parametrize("model", ["ncp", "lcp"])
def test_follows_the_reference(reference, model):
    errors, plan = run(reference, mpc_model=model)
    assert errors[:, 0].max() < 0.02
    assert errors[:, 1].mean() < 0.02
    assert plan.status == 0


def test_holds_without_feedback_between_the_ticks(reference):
    assert run(reference, feedback=False)[0][:, 0].max() < 0.03


def test_planning_is_what_keeps_it_up(reference):
    """The same forces without looking at the state lose the body."""
    assert run(reference, replan=False, feedback=False)[0][-1, 0] > 0.1


@pytest.mark.parametrize("seed", [1, 2])
def test_noise(reference, seed):
    assert run(reference, noise=1.0, seed=seed)[0][:, 0].max() < 0.04


@pytest.mark.parametrize("model", ["ncp", "lcp"])
def test_push_and_mass(reference, model):
    pushed = run(reference, push=6.0, mpc_model=model)[0][:, 0]
    assert pushed.max() > 0.015
    assert pushed[-10:].mean() < 0.05
    assert run(reference, mass=1.2, mpc_model=model)[0][:, 0].max() < 0.05


def test_plan_between_its_knots(reference):
    mpc = Mpc(MODEL, reference, terrain=Terrain())
    plan = mpc.step(0.013, *(x[0] for x in (reference.q, reference.v)))
    H = mpc.config.horizon
    assert plan.q.shape == (H + 1, 19)
    assert np.all(np.diff(plan.t) > 0.004)
    first = plan.at(plan.t[0])
    assert np.allclose(first.position, reference.q[0, :3])
    assert np.allclose(first.u.ravel(), plan.u[0])
    middle = plan.at((plan.t[3] + plan.t[4]) / 2)
    assert np.allclose(middle.points.ravel(), (plan.q[3, 7:] + plan.q[4, 7:]) / 2)
    assert np.allclose(middle.point_velocities.ravel(), plan.v[4, 6:])
    assert np.linalg.norm(middle.quat_xyzw) == pytest.approx(1)
    # Positions and velocities agree: the plan is a motion.
    eps = 1e-4
    speed = (plan.at(plan.t[5] + 0.003 + eps).position - plan.at(plan.t[5] + 0.003).position) / eps
    assert np.allclose(speed, plan.at(plan.t[5] + 0.003).velocity, atol=0.02)
    late = plan.at(plan.t[-1] + 1)
    assert np.allclose(late.position, plan.q[-1, :3])
    assert np.all(late.velocity == 0)
    # At a knot the feedback adds nothing to the plan's own state, and inputs stay within the limits.
    assert np.allclose(plan.feedback(plan.t[2], plan.q[2], plan.v[2]).ravel(), plan.u[2])
    away = plan.v[2] + 100.0
    assert np.all(np.abs(plan.feedback(plan.t[2], plan.q[2], away)) <= MODEL.u_max)


def test_keeps_the_last_plan_when_the_state_is_not_finite(reference):
    mpc = Mpc(MODEL, reference, terrain=Terrain())
    good = mpc.step(0.0, reference.q[0], reference.v[0])
    bad = mpc.step(0.01, np.full(19, np.nan), reference.v[0])
    assert good.status == 0
    assert bad.status == 1
    assert np.array_equal(bad.q, good.q)


def test_stands_at_the_end(reference):
    mpc = Mpc(MODEL, reference, terrain=Terrain())
    plan = mpc.step(float(reference.t[-1]) + 5.0, reference.q[-1], 0 * reference.v[-1])
    assert plan.status == 0
    assert plan.u[:, 2::3].sum(axis=1).mean() == pytest.approx(MODEL.mass * MODEL.g, rel=0.2)
    assert ROBOT.name == "go1"
