"""Contact, dynamics and cost: known answers, and every derivative against finite differences and CasADi."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.optimize import closing, constraints, cost, ddp, dynamics, so3
from slomo.optimize.contact import contact_derivative, contact_force, tangents
from slomo.optimize.dense import box_qp
from slomo.optimize.dynamics import Body
from slomo.optimize.iterate import Iterate, Work
from slomo.optimize.load import JointLoad, load_cost, load_derivative
from slomo.optimize.reach import Reach, reach_cost, reach_derivative, reach_excess
from slomo.optimize.riccati import backward
from slomo.pointfoot import PointFootModel
from slomo.robot_workspace import directions

HIPS = np.array([[0.188, 0.1268, 0], [0.188, -0.1268, 0], [-0.188, 0.1268, 0], [-0.188, -0.1268, 0]])


FLAT = np.array([0.0, 0.0, 1.0, 0.0])


def slope(rng, C):
    """(C, 4) planes through the origin, up to about 40 degrees steep."""
    n = np.column_stack([rng.uniform(-0.6, 0.6, (C, 2)), np.ones(C)])
    return np.column_stack([n / np.linalg.norm(n, axis=1, keepdims=True), np.zeros(C)])


def make_model(C=4, **changes) -> PointFootModel:
    hips = HIPS if C == 4 else np.random.default_rng(0).normal(0, 0.2, (C, 3))
    values = dict(
        mass=11.7, inertia=np.diag([0.10, 0.30, 0.36]), hips=hips, leg_min=np.full(C, 0.10), leg_max=np.full(C, 0.385),
        foot_mass=np.full(C, 0.35), u_max=np.full((C, 3), 120.0), names=tuple(f"leg{c}" for c in range(C)),
    )  # fmt: skip
    return PointFootModel(**(values | changes))


def random_state(rng, C):
    q, v = rng.normal(0, 0.3, 7 + 3 * C), rng.normal(0, 1, 6 + 3 * C)
    q[3:7] = Rotation.random(rng=rng).as_quat()
    q[9::3] = rng.choice([0.0005, 0.01, 0.2], C)
    return q, v, rng.normal(0, 20, 3 * C)


def numerical(f, x, eps=1e-6):
    return np.stack([(f(x + d) - f(x - d)) / (2 * eps) for d in eps * np.eye(len(x))], axis=-1)


def test_contact_keeps_relaxed_complementarity_and_the_cone():
    rng = np.random.default_rng(1)
    m, h, mu, g, kappa = 0.35, 0.05, 0.6, 9.81, 1e-3
    lam = np.zeros(3)
    for plane in slope(rng, 200):
        n, f = plane[:3], rng.normal(0, 0.1, 3)
        f += n * (rng.uniform(0, 0.1) - n @ f)
        v, u = rng.normal(0, 1, 3), rng.normal(0, 60, 3)
        contact_force(plane, f, v, u, m, h, mu, g, kappa, False, lam)
        f1 = f + h * (v + h * ((lam - u) / m - [0, 0, g]))
        gamma = n @ lam
        assert gamma > 0
        assert n @ f1 > 0
        assert gamma * (n @ f1) == pytest.approx(kappa, rel=1e-6)
        assert np.linalg.norm(lam - gamma * n) <= mu * gamma * (1 + 1e-12)
        contact_force(plane, f, v, u, m, h, mu, g, kappa, True, lam)
        v1 = v + h * ((lam - u) / m - [0, 0, g])
        assert np.linalg.norm(v1 - n * (n @ v1)) < 1e-12


def test_contact_known_answers():
    m, h, g, none = 0.35, 0.01, 9.81, np.zeros(3)
    lam = np.zeros(3)
    # A resting point under load carries load and weight; friction below the cone holds it, beyond it saturates.
    contact_force(FLAT, none, none, np.array([5.0, 0.0, 30.0]), m, h, 0.6, g, 1e-10, False, lam)
    assert lam[2] == pytest.approx(30 + m * g, rel=1e-6)
    assert lam[0] == pytest.approx(5.0, rel=1e-3)
    contact_force(FLAT, none, none, np.array([50.0, 0.0, 30.0]), m, h, 0.6, g, 1e-10, False, lam)
    assert lam[0] == pytest.approx(0.6 * lam[2], rel=1e-2)
    # Far from the ground there is nothing.
    contact_force(FLAT, np.array([0, 0, 1.0]), none, none, m, h, 0.6, g, 1e-6, False, lam)
    assert np.abs(lam).max() < 2e-6
    # On a slope of 20 degrees the ground carries the weight, without sliding.
    plane = np.array([-np.sin(np.radians(20)), 0.0, np.cos(np.radians(20)), 0.0])
    contact_force(plane, none, none, none, m, h, 0.6, g, 1e-12, False, lam)
    assert lam == pytest.approx([0, 0, m * g], abs=2e-2)


def test_tangents_are_a_right_handed_frame():
    for n in np.random.default_rng(0).normal(size=(50, 3)):
        n /= np.linalg.norm(n)
        t1, t2 = np.array(tangents(*n))
        F = np.stack([t1, t2, n])
        assert np.allclose(F @ F.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(F) == pytest.approx(1)
    assert np.array_equal(np.array(tangents(0.0, 0.0, 1.0)), [[1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize("stick", [False, True])
def test_contact_derivative(stick):
    rng = np.random.default_rng(2)
    for plane in slope(rng, 50):
        x = np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.5, 3), rng.normal(0, 20, 3), [0.05]])

        def force(x, plane=plane):
            lam = np.zeros(3)
            contact_force(plane, x[:3], x[3:6], x[6:9], 0.35, x[9], 0.6, 9.81, 1e-2, stick, lam)
            return lam

        D, lam = np.full((3, 10), np.nan), np.zeros(3)
        contact_derivative(
            plane, x[:3].copy(), x[3:6].copy(), x[6:9].copy(), 0.35, 0.05, 0.6, 9.81, 1e-2, stick, lam, D
        )
        assert np.allclose(lam, force(x), atol=1e-12)
        assert np.allclose(D, numerical(force, x), atol=1e-5 * (1 + np.abs(D).max()))


def test_rotations_against_scipy():
    rng = np.random.default_rng(3)
    for size in (1e-7, 0.1, 3.0):
        a, w = Rotation.random(rng=rng), rng.normal(size=3)
        w *= size / np.linalg.norm(w)
        out, back, R, J, Ji = np.zeros(4), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
        so3.plus(a.as_quat(), *w, out)
        assert np.allclose(Rotation.from_quat(out).as_matrix(), (a * Rotation.from_rotvec(w)).as_matrix(), atol=1e-12)
        so3.minus(out, a.as_quat(), back)
        assert np.allclose(back, w, atol=1e-9)
        so3.exp_matrix(w, R)
        assert np.allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-10)
        so3.right_jacobian(w, J)
        so3.right_jacobian_inverse(w, Ji)
        assert np.allclose(J @ Ji, np.eye(3), atol=1e-7)
        E = Rotation.from_rotvec(w)
        assert np.allclose(
            J,
            numerical(lambda d, E=E, w=w: (E.inv() * Rotation.from_rotvec(w + d)).as_rotvec(), np.zeros(3)),
            atol=1e-6,
        )


@pytest.mark.parametrize("C", [4, 6])
@pytest.mark.parametrize("free_step", [False, True])
def test_dynamics_derivative(C, free_step):
    model, rng = make_model(C), np.random.default_rng(4)
    body, nv, nu = Body.of(model), 6 + 3 * C, 3 * C + free_step
    for n in range(4):
        q, v, u = random_state(rng, C)
        ground, stick = slope(rng, C), np.arange(C) % 2 == n % 2
        A, B, D = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, nu)), np.zeros((C, 3, 10))
        q0, v0, lam = np.zeros(nv + 1), np.zeros(nv), np.zeros((C, 3))
        dynamics.linearize(body, 0.05, 1e-2, ground, stick, q, v, u, q0, v0, lam, A, B, D)

        def after(d, q=q, v=v, u=u, q0=q0, v0=v0, ground=ground, stick=stick):
            qa, va, q1, v1, out = np.zeros(nv + 1), np.zeros(nv), np.zeros(nv + 1), np.zeros(nv), np.zeros(2 * nv)
            dynamics.plus(q, v, d[: 2 * nv], 1.0, qa, va)
            h, ua = 0.05 + (d[-1] if free_step else 0.0), u + d[2 * nv : 2 * nv + 3 * C]
            dynamics.step(body, h, 1e-2, ground, stick, qa, va, ua, q1, v1, np.zeros((C, 3)))
            dynamics.minus(q1, v1, q0, v0, out)
            return out

        N = numerical(after, np.zeros(2 * nv + nu))
        assert np.allclose(after(np.zeros(2 * nv + nu)), 0, atol=1e-12)
        assert np.allclose(np.hstack([A, B]), N, atol=2e-5 * np.abs(N).max())


def casadi_step(model, h, kappa):
    """Velocities after one step as a CasADi function of (q, v, u), written from the equations."""
    C = model.C
    q, v, u = ca.SX.sym("q", 7 + 3 * C), ca.SX.sym("v", 6 + 3 * C), ca.SX.sym("u", 3 * C)
    x, y, z, w = (q[i] for i in range(3, 7))
    R = ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    force, torque, feet = ca.SX.zeros(3), ca.SX.zeros(3), []
    for c in range(C):
        uc, f, vf, m = u[3 * c : 3 * c + 3], q[7 + 3 * c : 10 + 3 * c], v[6 + 3 * c : 9 + 3 * c], model.foot_mass[c]
        force, torque = force + uc, torque + ca.cross(f - q[:3], uc)
        free = vf + h * (-uc / m - ca.vertcat(0, 0, model.g))
        a, b = h**2 / m, f[2] + h * free[2]
        gamma = (-b + ca.sqrt(b**2 + 4 * a * kappa)) / (2 * a)
        s = -m / h * free[:2]
        t = s * (1 + (ca.norm_2(s) / (model.mu * gamma)) ** 6) ** (-1 / 6)
        feet.append(free + h / m * ca.vertcat(t, gamma))
    inertia = ca.DM(model.inertia)
    spin = ca.solve(inertia, R.T @ torque - ca.cross(v[3:6], inertia @ v[3:6]))
    v1 = ca.vertcat(v[:3] + h * (force / model.mass - ca.vertcat(0, 0, model.g)), v[3:6] + h * spin, *feet)
    return ca.Function("step", [q, v, u], [v1, ca.jacobian(v1, v), ca.jacobian(v1, u)])


def test_dynamics_against_casadi():
    model, rng = make_model(), np.random.default_rng(5)
    body, f = Body.of(model), casadi_step(model, 0.05, 1e-2)
    for _ in range(5):
        q, v, u = random_state(rng, 4)
        A, B, D = np.zeros((36, 36)), np.zeros((36, 12)), np.zeros((4, 3, 10))
        q1, v1, flat, free = np.zeros(19), np.zeros(18), np.tile(FLAT, (4, 1)), np.zeros(4, bool)
        dynamics.linearize(body, 0.05, 1e-2, flat, free, q, v, u, q1, v1, np.zeros((4, 3)), A, B, D)
        expected, by_v, by_u = (np.array(x) for x in f(q, v, u))
        assert np.allclose(v1, expected[:, 0], atol=1e-9)
        assert np.allclose(A[18:, 18:], by_v, atol=1e-8)
        assert np.allclose(B[18:], by_u, atol=1e-8)


def test_free_fall_and_standing():
    model = make_model()
    body = Body.of(model)
    q, v = np.zeros(19), np.zeros(18)
    q[2], q[6], q[7:] = 10.0, 1.0, (HIPS + [0, 0, 9.8]).ravel()
    lam, flat, free = np.zeros((4, 3)), np.tile(FLAT, (4, 1)), np.zeros(4, bool)
    for _ in range(100):
        dynamics.step(body, 0.01, 1e-8, flat, free, q.copy(), v.copy(), np.zeros(12), q, v, lam)
    assert v[2] == pytest.approx(-9.81, rel=1e-9)
    assert v[8] == pytest.approx(-9.81, rel=1e-6)
    # Standing: the ground carries the whole weight and nothing moves.
    q, v, u = np.zeros(19), np.zeros(18), np.zeros((4, 3))
    q[2], q[6], q[7:], u[:, 2] = 0.28, 1.0, HIPS.ravel(), model.mass * model.g / 4
    for _ in range(100):
        dynamics.step(body, 0.01, 1e-8, flat, free, q.copy(), v.copy(), u.ravel(), q, v, lam)
    assert lam[:, 2].sum() == pytest.approx(model.total_mass * model.g, rel=1e-4)
    assert np.abs(v).max() < 1e-3


def make_task(rng, C, N=2, nu=None):
    nv, nu = 6 + 3 * C, nu or 3 * C
    q = np.stack([random_state(rng, C)[0] for _ in range(N + 1)])
    return cost.Task(
        h=np.full(N + 1, 0.05), ground=np.stack([slope(rng, C) for _ in range(N + 1)]), stick=rng.random((N, C)) < 0.5,
        q_ref=q, v_ref=rng.normal(size=(N + 1, nv)), u_ref=rng.normal(size=(N, nu)),
        w_x=rng.uniform(0, 5, (N + 1, 2 * nv)), w_u=rng.uniform(0, 1e-2, (N, nu)),
        u_low=np.full((N, nu), -1e6), u_high=np.full((N, nu), 1e6), w_acceleration=0.3, w_spin=0.02, w_slip=4.0,
        slip_load=2.0, cyclic=False, shift=np.zeros(4),
    )  # fmt: skip


@pytest.mark.parametrize("free_step", [False, True])
def test_cost_derivatives(free_step):
    C, nv, nu = 4, 18, 12 + free_step
    rng = np.random.default_rng(6)
    model = make_model(pairs=[[0, 1], [2, 3]], pair_length=[0.2, 0.3], clearance=[0.3, -np.inf, 0.1, 0.1])
    body, task = Body.of(model), make_task(rng, C, nu=nu)
    multiplier, cone, rho = rng.uniform(0, 5, constraints.number(body)), rng.uniform(0, 1e-3, C), 30.0
    multiplier[14:18] = 0.0
    for _ in range(4):
        q, v, u = random_state(rng, C)
        u, ground, stick = np.append(u, 0.05)[:nu], task.ground[1], task.stick[0]

        def total(d, q=q, v=v, u=u, ground=ground, stick=stick):
            qa, va, q1, v1, lam = np.zeros(19), np.zeros(18), np.zeros(19), np.zeros(18), np.zeros((C, 3))
            dynamics.plus(q, v, d[:36], 1.0, qa, va)
            ua = u + d[36:]
            dynamics.step(body, ua[12] if free_step else 0.05, 1e-2, ground, stick, qa, va, ua, q1, v1, lam)
            state = cost.state_cost(body, task, 0, qa, va, multiplier, rho)
            return np.array([state + cost.input_cost(body, task, 0, va, ua, v1, lam, cone, rho)])

        A, B, D = np.zeros((36, 36)), np.zeros((36, nu)), np.zeros((C, 3, 10))
        q1, v1, lam = np.zeros(19), np.zeros(18), np.zeros((C, 3))
        dynamics.linearize(body, 0.05, 1e-2, ground, stick, q, v, u, q1, v1, lam, A, B, D)
        Lx, Lu, Lxx = np.zeros(2 * nv), np.zeros(nu), np.zeros((36, 36))
        Luu, Lux = np.zeros((nu, nu)), np.zeros((nu, 36))
        cost.state_derivative(body, task, 0, q, v, multiplier, rho, Lx, Lxx)
        cost.input_derivative(body, task, 0, v, u, v1, lam, cone, rho, A, B, D, Lx, Lu, Lxx, Luu, Lux)
        g = numerical(total, np.zeros(36 + nu), eps=1e-5)[0]
        assert np.allclose(np.concatenate([Lx, Lu]), g, atol=1e-5 * np.abs(g).max())
        H = np.block([[Lxx, Lux.T], [Lux, Luu]])
        assert np.allclose(H, H.T)
        assert np.linalg.eigvalsh(H)[0] > -1e-9 * np.linalg.eigvalsh(H)[-1]


def test_derivatives_of_joint_limits_and_reach():
    rng = np.random.default_rng(11)
    C, J, M, rho = 4, 5, 3, 30.0
    q, v, u = random_state(rng, C)
    loads = [JointLoad(rng.normal(size=(1, J, n)), rng.normal(size=(1, J)), np.full((1, J), 0.3)) for n in (12, 18)]
    for load in loads:
        load.most[0, 2] = np.inf
    normal = rng.normal(size=(1, M, 3 * C))
    reach = Reach(normal / np.linalg.norm(normal, axis=2, keepdims=True), np.array([[-0.2, np.inf, 0.1]]))
    y, z = rng.uniform(0, 2, J), rng.uniform(0, 2, M)
    assert reach_excess(reach, q[None])[0, 0] == pytest.approx(
        reach.normal[0, 0] @ (Rotation.from_quat(q[3:7]).inv().apply(q[7:].reshape(-1, 3) - q[:3])).ravel() + 0.2
    )

    def total(d):
        qa, va = np.zeros(19), np.zeros(18)
        dynamics.plus(q, v, d[:36], 1.0, qa, va)
        of_joints = load_cost(loads[0], 0, u + d[36:], y, rho) + load_cost(loads[1], 0, va, y, rho)
        return np.array([of_joints + reach_cost(reach, 0, qa, z, rho)])

    Lx, Lxx, Lu, Luu = np.zeros(36), np.zeros((36, 36)), np.zeros(12), np.zeros((12, 12))
    load_derivative(loads[0], 0, u, y, rho, Lu, Luu)
    load_derivative(loads[1], 0, v, y, rho, Lx[18:], Lxx[18:, 18:])
    reach_derivative(reach, 0, q, z, rho, Lx, Lxx)
    g = numerical(total, np.zeros(48))[0]
    assert np.allclose(np.concatenate([Lx, Lu]), g, atol=1e-5 * np.abs(g).max())
    for H in (Lxx, Luu):
        assert np.allclose(H, H.T)
        assert np.linalg.eigvalsh(H)[0] > -1e-9 * np.linalg.eigvalsh(H)[-1]


def test_constraints_and_their_derivatives():
    rng = np.random.default_rng(9)
    model = make_model(
        6, pairs=[[0, 1], [3, 2]], pair_length=[0.2, 0.3], clearance=[0.3, 0.3, 0.3, 0.3, -np.inf, -np.inf]
    )
    room = np.where(rng.random((6, len(directions()))) < 0.3, 0.4, np.inf)
    body = Body.of(replace(model, workspace=room))
    M = constraints.number(body)
    assert 24 + room.size == M
    assert [constraints.is_equality(body, n) for n in range(M)] == [18 <= n < 20 for n in range(M)]
    q, _, _ = random_state(rng, 6)
    g = np.zeros(M)
    constraints.values(body, q, g)
    R, points = Rotation.from_quat(q[3:7]), q[7:].reshape(-1, 3)
    assert g[6:12] == pytest.approx(np.linalg.norm(q[:3] + R.apply(model.hips) - points, axis=1) - model.leg_max)
    assert g[12:16] == pytest.approx(R.inv().apply(points - q[:3])[:4, 2] + 0.3)
    assert np.all(np.isinf(g[16:18]))
    assert g[19] == pytest.approx(np.linalg.norm(points[3] - points[2]) - 0.3)
    assert g[20] == pytest.approx(points[0, 2] - points[1, 2] - 0.2 * np.sin(constraints.TILT))
    assert g[24:].reshape(room.shape) == pytest.approx(R.inv().apply(points - q[:3]) @ directions().T - room)

    def at(d):
        qa, va, out = np.zeros(25), np.zeros(24), np.zeros(M)
        dynamics.plus(q, np.zeros(24), d, 1.0, qa, va)
        constraints.values(body, qa, out)
        return np.where(np.isfinite(out), out, 0.0)

    expected = numerical(at, np.zeros(48))
    for n in range(M):
        grad, index, row = np.zeros(9), np.zeros(9, int), np.zeros(48)
        count = constraints.gradient(body, q, R.as_matrix(), n, index, grad)
        row[index[:count]] = grad[:count]
        if np.isfinite(g[n]):
            assert np.allclose(row, expected[n], atol=1e-7)


def test_curvature_of_links():
    """Against second differences; of the rotation only what turns with the link is in it."""
    rng = np.random.default_rng(0)
    body = Body.of(make_model(6, pairs=[[0, 1], [3, 2]], pair_length=[0.2, 0.3]))
    q, _, _ = random_state(rng, 6)
    R = Rotation.from_quat(q[3:7]).as_matrix()
    for n in (7, 18, 19):
        H = np.zeros((48, 48))
        constraints.add_curvature(body, q, R, n, 2.0, H)

        def force(d, n=n):
            qa, va, grad, index, row = np.zeros(25), np.zeros(24), np.zeros(9), np.zeros(9, int), np.zeros(24)
            dynamics.plus(q, np.zeros(24), np.append(d, np.zeros(24)), 1.0, qa, va)
            Ra = Rotation.from_quat(qa[3:7]).as_matrix()
            count = constraints.gradient(body, qa, Ra, n, index, grad)
            row[index[:count]] = 2.0 * grad[:count]
            return row

        off = H[:24, :24] - numerical(force, np.zeros(24))
        off[3:6, 3:6] = 0.0
        assert np.abs(off).max() < 1e-6
        assert np.linalg.eigvalsh(H)[0] > -1e-9
        constraints.add_curvature(body, q, R, n, -4.0, H)
        assert np.linalg.eigvalsh(H)[0] > -1e-9


def test_cyclic_end_and_its_derivatives():
    rng = np.random.default_rng(10)
    task = make_task(rng, 4)._replace(cyclic=True, shift=np.array([0.3, -0.2, 0.1, 0.8]))
    q0, v0, _ = random_state(rng, 4)
    turn = Rotation.from_rotvec([0, 0, 0.8])
    q1, v1 = q0.copy(), v0.copy()
    q1[3:7] = (turn * Rotation.from_quat(q0[3:7])).as_quat()
    for i in (0, 7, 10, 13, 16):
        q1[i : i + 3] = turn.apply(q0[i : i + 3]) + task.shift[:3]
    for i in (0, 6, 9, 12, 15):
        v1[i : i + 3] = turn.apply(v0[i : i + 3])
    e = np.zeros(36)
    closing.end_gap(task, q0, v0, q1, v1, e)
    assert np.abs(e).max() < 1e-12
    d = 0.3 * rng.normal(size=36)
    dynamics.plus(q1, v1, d, 1.0, q1, v1)
    closing.end_gap(task, q0, v0, q1, v1, e)
    y, rho = rng.normal(size=36), 7.0

    def total(x):
        qa, va, qb, vb, out = np.zeros(19), np.zeros(18), np.zeros(19), np.zeros(18), np.zeros(36)
        dynamics.plus(q0, v0, x[:36], 1.0, qa, va)
        dynamics.plus(q1, v1, x[36:], 1.0, qb, vb)
        closing.end_gap(task, qa, va, qb, vb, out)
        return np.array([closing.end_cost(out, y, rho)])

    Vx, Vt, Vxx, Vxt, Vtt = np.zeros(36), np.zeros(36), np.zeros((36, 36)), np.zeros((36, 36)), np.zeros((36, 36))
    closing.end_derivative(task, e, y, rho, Vx, Vxx, Vt, Vxt, Vtt)
    g = numerical(total, np.zeros(72), eps=1e-5)[0]
    assert np.allclose(np.concatenate([Vt, Vx]), g, atol=1e-6 * np.abs(g).max())
    H = np.block([[Vtt, Vxt.T], [Vxt, Vxx]])
    assert np.linalg.eigvalsh(H)[0] > -1e-9 * np.linalg.eigvalsh(H)[-1]


def test_box_qp_satisfies_the_optimality_conditions():
    rng = np.random.default_rng(7)
    for n in (3, 12):
        for _ in range(30):
            M = rng.normal(size=(n, n))
            H, g = M @ M.T + 0.1 * np.eye(n), 5 * rng.normal(size=n)
            lower, upper = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
            x = np.zeros(n)
            free = box_qp(H, g, lower, upper, x, np.zeros(n, int), np.zeros((n, n)), np.zeros((n, 1)))
            grad = H @ x + g
            assert free >= 0
            assert np.all((x >= lower) & (x <= upper))
            assert np.all(grad[x == lower] >= -1e-8)
            assert np.all(grad[x == upper] <= 1e-8)
            assert np.allclose(grad[(x > lower) & (x < upper)], 0, atol=1e-8)
    indefinite, one = -np.eye(2), np.ones(2)
    scratch = (np.zeros(2), np.zeros(2, int), np.eye(2), np.zeros((2, 1)))
    assert box_qp(indefinite, one, -one, one, *scratch) == -1


def test_newton_step_solves_the_linear_quadratic_problem():
    """Without contact nearby and without limits, one full step closes all gaps to first order."""
    C, N = 4, 6
    rng = np.random.default_rng(8)
    model = make_model(u_max=np.full((C, 3), 1e6), leg_max=np.full(C, 50.0), leg_min=np.zeros(C))
    body, task = Body.of(model), make_task(rng, C, N)
    q = np.tile(task.q_ref[:1], (N + 1, 1))
    q[:, 2], q[:, 9::3] = 2.0, 1.5
    it = Iterate.at(q, np.zeros((N + 1, 18)), np.zeros((N, 12)), C=C, M=constraints.number(body))
    w = Work.make(it)
    ddp.evaluate(body, task, 1e-4, it, 1.0, w.gap, w)
    assert backward(body, task, 1e-4, it, 1.0, 0.0, False, w)
    ddp.forward(task, it, w)
    # Stationarity in u of the full quadratic model, checked with costates from the linearisation.
    defects = [w.A[k] @ w.dx[k] + w.B[k] @ w.du[k] + w.gap[k] - w.dx[k + 1] for k in range(N)]
    assert np.abs(defects).max() < 1e-10
    deviation = [w.k[k] + w.K[k] @ w.dx[k] - w.du[k] for k in range(N)]
    assert np.abs(deviation).max() < 1e-9 * max(1, np.abs(w.du).max())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": -1.0}, "positive"),
        ({"inertia": -np.eye(3)}, "inertia"),
        ({"leg_min": np.full(4, 0.5)}, "leg_min"),
        ({"hips": np.zeros((3, 3))}, "hips"),
    ],
)
def test_model_rejects_nonsense(changes, message):
    with pytest.raises(InvalidData, match=message):
        make_model(**changes)
