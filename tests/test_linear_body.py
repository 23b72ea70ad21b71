"""The body linearised about a reference: what it must agree with, and its derivative."""

import numpy as np
import pytest

from slomo.errors import UsageError
from slomo.optimize import cost, dynamics
from slomo.optimize.dynamics import Body
from slomo.optimize.linear_body import LinearBody, linearize_reference, task_linearize, task_step
from slomo.terrain import Terrain
from slomo.track.mpc import Mpc, MpcConfig
from test_optimize_model import make_model, numerical, random_state
from test_optimize_model import make_task as random_task

N, KAPPA, H = 3, 1e-2, 0.03


@pytest.fixture(scope="module")
def case():
    """A body, and a task about a reference with defects, linearised."""
    rng = np.random.default_rng(3)
    body = Body.of(make_model())
    linear = LinearBody.zeros(N, 4)
    task = random_task(rng, 4, N)
    linear.q[0], linear.v[0], _ = random_state(rng, 4)
    for k in range(N):
        linear.u[k] = rng.normal(0, 20, 12)
        q, v, _ = after(dynamics.step, body, H, KAPPA, task.ground[k + 1], task.stick[k], *(x[k] for x in linear[3:]))
        dynamics.plus(q, v, rng.normal(0, 0.2, 36), 1.0, linear.q[k + 1], linear.v[k + 1])
    linearize_reference(body, np.full(N, H), linear, 0, N)
    return body, task._replace(linear=linear)


def moved(linear, k, dx, du):
    q, v = np.empty(19), np.empty(18)
    dynamics.plus(linear.q[k], linear.v[k], dx, 1.0, q, v)
    return q, v, linear.u[k] + du


def after(step, *args):
    q1, v1, lam = np.zeros(19), np.zeros(18), np.zeros((4, 3))
    step(*args, q1, v1, lam)
    return q1, v1, lam


def both(case, k, dx, du):
    """(q1, v1, lam) of the linearised step and of the nonlinear one."""
    body, task = case
    q, v, u = moved(task.linear, k, dx, du)
    linear = after(task_step, body, task, KAPPA, k, H, q, v, u)
    return linear, after(dynamics.step, body, H, KAPPA, task.ground[k + 1], task.stick[k], q, v, u)


def test_agrees_on_the_reference_and_differs_in_second_order(case):
    rng = np.random.default_rng(0)
    for k in range(N):
        for x, y in zip(*both(case, k, np.zeros(36), np.zeros(12)), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-12)
        dx, du, d = rng.normal(size=36), rng.normal(size=12), np.empty(36)
        far = []
        for eps in (1e-2, 1e-3):
            (qa, va, la), (qb, vb, lb) = both(case, k, eps * dx, eps * du)
            np.testing.assert_allclose(la, lb, atol=1e-12)  # contact is the same, not linearised
            dynamics.minus(qa, va, qb, vb, d)
            far.append(np.abs(d).max())
        assert 0 < far[1] < 0.02 * far[0]


def test_points_follow_the_nonlinear_step_however_far(case):
    rng = np.random.default_rng(1)
    (qa, va, la), (qb, vb, lb) = both(case, 1, 0.3 * rng.normal(size=36), 20 * rng.normal(size=12))
    np.testing.assert_allclose(qa[7:], qb[7:], atol=1e-12)
    np.testing.assert_allclose(va[6:], vb[6:], atol=1e-12)
    np.testing.assert_allclose(la, lb, atol=1e-9)
    assert np.abs(qa[:7] - qb[:7]).max() > 1e-4


def test_derivative(case):
    body, task = case
    rng = np.random.default_rng(2)
    q, v, u = moved(task.linear, 1, 0.2 * rng.normal(size=36), rng.normal(size=12))
    A, B, D = np.zeros((36, 36)), np.zeros((36, 12)), np.zeros((4, 3, 10))
    q0, v0 = np.zeros(19), np.zeros(18)
    task_linearize(body, task, KAPPA, 1, H, q, v, u, q0, v0, np.zeros((4, 3)), A, B, D)

    def f(x):
        qa, va, out = np.empty(19), np.empty(18), np.empty(36)
        dynamics.plus(q, v, x[:36], 1.0, qa, va)
        q1, v1, _ = after(task_step, body, task, KAPPA, 1, H, qa, va, u + x[36:])
        dynamics.minus(q1, v1, q0, v0, out)
        return out

    np.testing.assert_allclose(np.hstack([A, B]), numerical(f, np.zeros(48)), atol=2e-5, rtol=1e-4)


def test_a_task_without_matrices_is_nonlinear(case):
    body, task = case
    plain = task._replace(linear=cost.NONLINEAR)
    q, v, u = moved(task.linear, 0, np.full(36, 0.1), np.ones(12))
    for x, y in zip(
        after(task_step, body, plain, KAPPA, 0, H, q, v, u),
        after(dynamics.step, body, H, KAPPA, task.ground[1], task.stick[0], q, v, u),
        strict=True,
    ):
        np.testing.assert_array_equal(x, y)


def test_unknown_model():
    with pytest.raises(UsageError, match=r"track\.mpc_model.*ncp.*lcp"):
        Mpc(make_model(), None, terrain=Terrain(), config=MpcConfig(mpc_model="qp"))  # pyright: ignore[reportArgumentType]
