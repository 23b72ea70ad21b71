"""The CasADi model against the compiled one: values and derivatives, at any attitude, on any plane."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.optimize import casadi_model as cm
from slomo.optimize import constraints, cost, dynamics, so3
from slomo.optimize.dynamics import Body
from slomo.optimize.fatrop import smooth_step
from slomo.pointfoot import PointFootModel
from slomo.robot_workspace import directions

HIPS = np.array([[0.19, 0.13, 0], [0.19, -0.13, 0], [-0.19, 0.13, 0], [-0.19, -0.13, 0]])
PELVIS = np.array(
    [[0.1, 0.1, -0.3], [-0.1, 0.1, -0.3], [0.1, -0.1, -0.3], [-0.1, -0.1, -0.3], [0, 0.2, 0.3], [0, -0.2, 0.3]]
)


def make_model(C: int) -> PointFootModel:
    """A quadruped, or a humanoid: toe and heel of two feet, two hands."""
    human = C == 6
    return PointFootModel(
        mass=30.0 if human else 11.7, inertia=[[0.9, 0.01, 0.02], [0.01, 0.8, 0.03], [0.02, 0.03, 0.3]],
        hips=PELVIS if human else HIPS, leg_min=np.full(C, 0.10), leg_max=np.full(C, 0.8 if human else 0.385),
        foot_mass=np.linspace(0.3, 0.6, C), u_max=np.full((C, 3), 400.0), names=tuple(f"leg{c}" for c in range(C)),
        pairs=[[0, 1], [2, 3]] if human else np.zeros((0, 2), int), pair_length=[0.2, 0.21] if human else np.zeros(0),
        leg_roots=(PELVIS if human else HIPS) + [0.02, 0.01, -0.03],
        workspace=np.where(np.arange(C)[:, None] == 1, np.linspace(0.1, 0.6, len(directions())), np.inf),
        clearance=[0.2, 0.2, 0.2, 0.2, -np.inf, -np.inf] if human else np.full(C, 0.05),
    )  # fmt: skip


def random_plane(rng, tilt=0.4):
    n = np.array([*rng.uniform(-tilt, tilt, 2), 1.0])
    return np.append(n / np.linalg.norm(n), rng.normal(0, 0.02))


def random_task(rng, model: PointFootModel, N: int, *, free_steps: bool) -> cost.Task:
    C, nv, nu = model.C, 6 + 3 * model.C, 3 * model.C + free_steps
    q = rng.normal(0, 0.3, (N + 1, nv + 1))
    q[:, 3:7] = Rotation.random(N + 1, rng=rng).as_quat()
    ground = np.array([[random_plane(rng) for _ in range(C)] for _ in range(N + 1)])
    return cost.Task(
        h=rng.uniform(0.02, 0.06, N + 1), ground=ground, stick=np.zeros((N, C), bool),
        q_ref=q, v_ref=rng.normal(size=(N + 1, nv)),
        u_ref=rng.normal(size=(N, nu)), w_x=rng.uniform(0, 5, (N + 1, 2 * nv)), w_u=rng.uniform(0, 1e-2, (N, nu)),
        u_low=np.full((N, nu), -400.0), u_high=np.full((N, nu), 400.0), w_acceleration=0.3, w_spin=0.02, w_slip=4.0,
        slip_load=2.0, cyclic=False, shift=np.zeros(4),
    )  # fmt: skip


def attitudes(rng):
    """Orientations that small-angle shortcuts get wrong, and a random one."""
    return [
        Rotation.from_euler("y", 60, degrees=True),
        Rotation.from_rotvec([0, 0, 2.0]),
        Rotation.from_euler("ZY", [2.0, -1.0]),
        Rotation.random(rng=rng),
    ]


def random_state(rng, task, attitude):
    """A state with that orientation, its points near their planes, fast or slow."""
    C = task.ground.shape[1]
    q, v = rng.normal(0, 0.3, 7 + 3 * C), rng.normal(0, rng.choice([0.01, 1.0]), 6 + 3 * C)
    q[3:7] = attitude.as_quat()
    for c in range(C):
        n, d = task.ground[1, c, :3], task.ground[1, c, 3]
        f = q[7 + 3 * c : 10 + 3 * c]
        f += n * (d + rng.choice([5e-4, 0.01, 0.2]) - n @ f)
    u = rng.normal(0, 20, task.u_ref.shape[1])
    u[3 * C :] = rng.uniform(0.02, 0.08)
    return q, v, u


def symbols(model, task):
    """Expressions of one knot with their symbols (x, u, parameters)."""
    names = cm.fields(model.C, task.u_ref.shape[1])
    p, part = names.symbols("p")
    x, u = ca.SX.sym("x", 12 + 6 * model.C), ca.SX.sym("u", task.u_ref.shape[1])
    x_next, lam = smooth_step(model, x, u, part)
    return x, u, p, part, x_next, lam


@pytest.mark.parametrize("C", [4, 6])
@pytest.mark.parametrize("free_steps", [False, True])
def test_step_and_its_derivative(C, free_steps):
    rng, model, kappa = np.random.default_rng(C), make_model(C), 1e-2
    body, nv, nu = Body.of(model), 6 + 3 * C, 3 * C + free_steps
    for attitude in attitudes(rng):
        task = random_task(rng, model, 2, free_steps=free_steps)
        q, v, u = random_state(rng, task, attitude)
        h = u[-1] if free_steps else task.h[0]
        A, B, D = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, nu)), np.zeros((C, 3, 10))
        q1, v1, lam = np.zeros(nv + 1), np.zeros(nv), np.zeros((C, 3))
        dynamics.linearize(body, h, kappa, task.ground[1], task.stick[0], q, v, u, q1, v1, lam, A, B, D)
        # With the orientations themselves as references, CasADi's states are the kernel's tangent vectors.
        q_ref = task.q_ref.copy()
        q_ref[0, 3:7], q_ref[1, 3:7] = q[3:7], q1[3:7]
        here = task._replace(q_ref=q_ref)
        x, us, p, _, x_next, forces = symbols(model, here)
        f = ca.Function("f", [x, us, p], [x_next, forces, ca.jacobian(x_next, x), ca.jacobian(x_next, us)])
        x0 = np.concatenate([q[:3], np.zeros(3), q[7:], v])
        expected = [np.array(y) for y in f(x0, u, cm.parameters(here, kappa)[0])]
        assert np.allclose(expected[0][:, 0], np.concatenate([q1[:3], np.zeros(3), q1[7:], v1]), atol=1e-9)
        assert np.allclose(expected[1].T, lam, rtol=1e-9, atol=1e-9)
        assert np.allclose(expected[2], A, atol=1e-9 * max(1, np.abs(A).max()))
        assert np.allclose(expected[3], B, atol=1e-9 * max(1, np.abs(B).max()))


@pytest.mark.parametrize("C", [4, 6])
def test_any_reference_gives_the_same_step(C):
    """States are stored relative to the task's orientations; the motion does not depend on them."""
    rng, model, kappa = np.random.default_rng(C), make_model(C), 1e-4
    body = Body.of(model)
    task = random_task(rng, model, 2, free_steps=False)
    x, us, p, _, x_next, _ = symbols(model, task)
    f = ca.Function("f", [x, us, p], [x_next])
    for attitude in attitudes(rng):
        q, v, u = random_state(rng, task, attitude)
        q1, v1 = np.zeros_like(q), np.zeros_like(v)
        dynamics.step(body, task.h[0], kappa, task.ground[1], task.stick[0], q, v, u, q1, v1, np.zeros((C, 3)))
        x0 = cm.to_tangent(task, np.stack([q] * 3), np.stack([v] * 3))[0]
        x1 = np.array(f(x0, u, cm.parameters(task, kappa)[0]))[:, 0]
        q2, v2 = cm.from_tangent(task, np.stack([x1] * 3))
        assert np.allclose(q2[1][[0, 1, 2, *range(7, len(q))]], q1[[0, 1, 2, *range(7, len(q))]], atol=1e-9)
        assert (Rotation.from_quat(q2[1][3:7]).inv() * Rotation.from_quat(q1[3:7])).magnitude() < 1e-9
        assert np.allclose(v2[1], v1, atol=1e-9)


@pytest.mark.parametrize("C", [4, 6])
def test_cost_and_its_derivative(C):
    rng, model, kappa = np.random.default_rng(10 + C), make_model(C), 1e-2
    body, nv = Body.of(model), 6 + 3 * C
    nx, nu = 2 * nv, 3 * C
    for attitude in attitudes(rng):
        task = random_task(rng, model, 2, free_steps=False)
        q, v, u = random_state(rng, task, attitude)
        A, B, D = np.zeros((nx, nx)), np.zeros((nx, nu)), np.zeros((C, 3, 10))
        q1, v1, lam = np.zeros(nv + 1), np.zeros(nv), np.zeros((C, 3))
        dynamics.linearize(body, task.h[0], kappa, task.ground[1], task.stick[0], q, v, u, q1, v1, lam, A, B, D)
        nothing = np.zeros(constraints.number(body)), 1e-30
        Lx, Lu = np.zeros(nx), np.zeros(nu)
        Lxx, Luu, Lux = np.zeros((nx, nx)), np.zeros((nu, nu)), np.zeros((nu, nx))
        cost.state_derivative(body, task, 0, q, v, *nothing, Lx, Lxx)
        cost.input_derivative(body, task, 0, v, u, v1, lam, np.zeros(C), 1.0, A, B, D, Lx, Lu, Lxx, Luu, Lux)
        J = cost.state_cost(body, task, 0, q, v, *nothing)
        J += cost.input_cost(body, task, 0, v, u, v1, lam, np.zeros(C), 1.0)

        x, us, p, part, x_next, forces = symbols(model, task)
        total = cm.state_cost(x, part) + cm.input_cost(model, task, x, x_next, us, forces, part)
        z = ca.vertcat(x, us)
        f = ca.Function("f", [x, us, p], [total, ca.gradient(total, z)])
        x0 = cm.to_tangent(task, np.stack([q] * 3), np.stack([v] * 3))[0]
        value, grad = (np.array(y) for y in f(x0, u, cm.parameters(task, kappa)[0]))
        # CasADi differentiates with respect to the rotation vector d of R = R_ref exp(d): dR = R [J_r(d) dd].
        Jr = np.zeros((3, 3))
        so3.right_jacobian(x0[3:6], Jr)
        Lx[3:6] = Jr.T @ Lx[3:6]
        assert value[0, 0] == pytest.approx(J, rel=1e-12)
        assert np.allclose(grad[:, 0], np.concatenate([Lx, Lu]), atol=1e-9 * np.abs(grad).max())


@pytest.mark.parametrize("C", [4, 6])
def test_limits_are_the_constraints(C):
    """low <= rows <= high says what the compiled constraints say: squared where lengths are, same order of sign."""
    rng, model = np.random.default_rng(20 + C), make_model(C)
    body = Body.of(model)
    task = random_task(rng, model, 2, free_steps=False)
    x, _, p, part, _, _ = symbols(model, task)
    rows, low, high = cm.limits(model, x, part["quat_ref"])
    f = ca.Function("f", [x, p], [rows])
    for attitude in attitudes(rng):
        q, v, _ = random_state(rng, task, attitude)
        x0 = cm.to_tangent(task, np.stack([q] * 3), np.stack([v] * 3))[0]
        got = np.array(f(x0, cm.parameters(task, 1.0)[0]))[:, 0]
        g = np.zeros(constraints.number(body))
        constraints.values(body, q, g)
        legs = np.sqrt(got[:C])
        assert np.allclose(g[:C], np.sqrt(low[:C]) - legs)
        assert np.allclose(g[C : 2 * C], legs - np.sqrt(high[:C]))
        held = np.flatnonzero(np.isfinite(model.clearance))
        at = C + len(held)
        assert np.allclose(g[2 * C + held], low[C:at] - got[C:at])
        P, K = len(model.pairs), len(directions())
        room = np.argwhere(np.isfinite(model.workspace))
        beyond = got[at : at + len(room)] - high[at : at + len(room)]
        assert np.allclose(g[3 * C + 3 * P + room[:, 0] * K + room[:, 1]], beyond)
        at += len(room)
        assert len(got) == at + 2 * P
        assert np.allclose(g[3 * C : 3 * C + P], np.sqrt(got[at::2]) - np.sqrt(low[at::2]) - cm.PAIR_TOLERANCE)
        assert np.allclose(np.sqrt(high[at::2]) - np.sqrt(low[at::2]), 2 * cm.PAIR_TOLERANCE)
        assert np.allclose(g[3 * C + P : 3 * C + 2 * P], got[at + 1 :: 2] - high[at + 1 :: 2])
        assert np.allclose(g[3 * C + 2 * P : 3 * C + 3 * P], low[at + 1 :: 2] - got[at + 1 :: 2])
