"""Kinematics and dynamics of the whole robot over a motion, with derivatives.

One step of length h is semi-implicit, in the convention of `motion.Reference`: the base has its velocity in the world
and its angular velocity in its own frame,

    p' = p + h v'      R' = R exp(h w')      s' = s + h ds'      (v', w', ds' at the end of the step)
    rnea(q, v, (velocity' - velocity) / h) - sum_c J_c(q)^T lam_c = (0, tau).

Mechanics do not change in a frame that moves along with the base (Galilei), so that rnea (Featherstone 2008, ch. 5)
gets a base velocity of (0, w) and the base acceleration R^T (v' - v) / h: a translation is exact at any turning speed.
Tangent vectors are (dp world, dR in the base frame, ds): R exp(dR).
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from slomo.robot import Robot

Array = np.ndarray


def plus(q: Array, dq: Array) -> Array:
    """Configurations (..., 7 + nj) moved along tangents (..., 6 + nj)."""
    turned = Rotation.from_quat(q[..., 3:7]) * Rotation.from_rotvec(dq[..., 3:6])
    return np.concatenate([q[..., :3] + dq[..., :3], turned.as_quat(), q[..., 7:] + dq[..., 6:]], axis=-1)


def minus(q1: Array, q0: Array) -> Array:
    """The tangents (..., 6 + nj) that lead from q0 to q1."""
    turn = (Rotation.from_quat(q0[..., 3:7]).inv() * Rotation.from_quat(q1[..., 3:7])).as_rotvec()
    return np.concatenate([q1[..., :3] - q0[..., :3], turn, q1[..., 7:] - q0[..., 7:]], axis=-1)


def carried(q: Array, cycle: Array) -> Array:
    """Configurations (..., 7 + nj) after one cycle: turned about z and moved by a `Reference.cycle` (4,)."""
    turn = Rotation.from_euler("z", cycle[3])
    place = q[..., :3] @ turn.as_matrix().T + cycle[:3]
    return np.concatenate([place, (turn * Rotation.from_quat(q[..., 3:7])).as_quat(), q[..., 7:]], axis=-1)


def skew(x: Array) -> Array:
    """(..., 3) to the matrices (..., 3, 3) of the cross product from the left."""
    out = np.zeros((*x.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    return out - np.swapaxes(out, -1, -2)


def right_jacobian_inverse(x: Array) -> Array:
    """(..., 3) to J (..., 3, 3) with log(exp(x) exp(d)) = x + J d (Chirikjian 2012, eq. 10.86)."""
    angle2 = np.sum(x * x, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    near = angle < 1e-4
    safe = np.where(near, 1.0, angle)
    factor = np.where(near, 1 / 12, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.where(near, 1.0, np.sin(safe))))
    S = skew(x)
    return np.eye(3) + 0.5 * S + factor * (S @ S)


@dataclass(frozen=True)
class Kinematics:
    """Where the contact points and the base frame are at T knots.

    Attributes:
        points: (T, C, 3) m.  J: (T, C, 3, nv) their derivatives.
        base: (T, 7) m and quat_xyzw of the base frame.  J_base: (T, 6, nv): of its position in the world, and of its
            rotation in its own frame.
    """

    points: Array
    J: Array
    base: Array
    J_base: Array


@dataclass(frozen=True)
class Steps:
    """The equations of K steps between K + 2 knots, knot k + 1 being where step k begins.

    Attributes:
        v: (K + 1, nv) velocities between the knots.
        force: (K, nv) rnea without contact forces: root force and torque in its frame (N, N m), joint torques (N m).
        Jt: (K, nv, 3 C) transposed Jacobian of the points at the beginning of the step.
        D: (K, 3, nv, nv) derivatives of force - Jt lam by the three knots that matter, or None.
    """

    v: Array
    force: Array
    Jt: Array
    D: Array | None

    def residual(self, lam: Array) -> Array:
        """(K, nv): force - Jt lam, which is (0, tau) where the equations hold. lam (K, C, 3) N."""
        return self.force - np.einsum("kij,kj->ki", self.Jt, lam.reshape(len(lam), -1))


class WholeBodyModel:
    """A robot with its contact points and its base frame."""

    def __init__(self, robot: Robot):
        self.model, self.data = robot.model, robot.model.createData()
        self.points = [robot.model.getFrameId(name) for name in robot.foot_names]
        self.base = robot.model.getFrameId(robot.base)
        self.nj = robot.model.nv - 6

    def structure(self) -> tuple[Array, Array]:
        """Where derivatives can differ from zero: of a joint's equation by a joint (nv, nv), only along one branch of
        the tree, and of a point by a joint (C, nv)."""
        model, nv = self.model, self.model.nv
        joints = [1] * 6 + list(range(2, model.njoints))
        above = np.array([[j in model.supports[i] for j in joints] for i in joints])
        on = [model.supports[model.frames[f].parentJoint] for f in self.points]
        return above | above.T, np.array([[j in s for j in joints] for s in on]).reshape(-1, nv)

    def velocities(self, q: Array, h: Array) -> Array:
        """(K + 1, nv) velocities between the knots q (K + 2, nq), with steps h (K + 1,) s."""
        return minus(q[1:], q[:-1]) / h[:, None]

    def kinematics(self, q: Array) -> Kinematics:
        """Of knots q (T, nq)."""
        model, data, nv, C = self.model, self.data, self.model.nv, len(self.points)
        points, J = np.empty((len(q), C, 3)), np.empty((len(q), C, 3, nv))
        base, J_base = np.empty((len(q), 7)), np.empty((len(q), 6, nv))
        aligned, local = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, pin.ReferenceFrame.LOCAL
        for k, x in enumerate(q):
            pin.computeJointJacobians(model, data, x)
            pin.updateFramePlacements(model, data)
            for c, f in enumerate(self.points):
                points[k, c] = data.oMf[f].translation
                J[k, c] = pin.getFrameJacobian(model, data, f, aligned)[:3]
            base[k] = pin.SE3ToXYZQUAT(data.oMf[self.base])
            J_base[k, :3] = pin.getFrameJacobian(model, data, self.base, aligned)[:3]
            J_base[k, 3:] = pin.getFrameJacobian(model, data, self.base, local)[3:]
        # Pinocchio moves the base along its own axes; here it moves along the world's.
        Rt = np.swapaxes(Rotation.from_quat(q[:, 3:7]).as_matrix(), 1, 2)
        J[..., :3] = J[..., :3] @ Rt[:, None]
        J_base[..., :3] = J_base[..., :3] @ Rt
        return Kinematics(points, J, base, J_base)

    def steps(self, q: Array, h: Array, lam: Array | None = None) -> Steps:
        """The equations of the steps between knots q (K + 2, nq) with h (K + 1,) s; derivatives at forces lam
        (K, C, 3) N, and without lam no derivatives."""
        model, data, nv, C = self.model, self.data, self.model.nv, len(self.points)
        K = len(q) - 2
        aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        v = self.velocities(q, h)
        dv = np.diff(v, axis=0) / h[1:, None]
        R = Rotation.from_quat(q[1:-1, 3:7]).as_matrix()
        a_base = np.einsum("kji,kj->ki", R, dv[:, :3])
        v_hat, a_hat = v[:-1].copy(), np.concatenate([a_base, dv[:, 3:]], axis=1)
        v_hat[:, :3] = 0.0
        force, Jt = np.empty((K, nv)), np.empty((K, nv, 3 * C))
        G = np.empty((K, 3, nv, nv))
        for k in range(K):
            x = q[k + 1]
            pin.computeJointJacobians(model, data, x)
            pin.updateFramePlacements(model, data)
            Js = [pin.getFrameJacobian(model, data, f, aligned) for f in self.points]
            for c, J in enumerate(Js):
                Jt[k, :, 3 * c : 3 * c + 3] = J[:3].T
            if lam is None:
                force[k] = pin.rnea(model, data, x, v_hat[k], a_hat[k])
                continue
            external = self._external(lam[k])
            G[k, 0], G[k, 1], G[k, 2] = pin.computeRNEADerivatives(model, data, x, v_hat[k], a_hat[k], external)
            force[k] = data.tau + Jt[k] @ lam[k].ravel()
            # The derivatives hold an external force still in its link; a contact force stays as it is in the world.
            for c, J in enumerate(Js):
                G[k, 0] -= J[:3].T @ skew(lam[k, c]) @ J[3:]
        return Steps(v, force, Jt, None if lam is None else _chain(q, h, G, R, a_base))

    def _external(self, lam: Array) -> list[pin.Force]:
        """Contact forces (C, 3) as what acts on each joint's body, in its frame; placements are up to date."""
        out = [pin.Force.Zero() for _ in range(self.model.njoints)]
        for f, force in zip(self.points, lam, strict=True):
            joint = self.model.frames[f].parentJoint
            T = self.data.oMi[joint]
            local = T.rotation.T @ force
            out[joint] += pin.Force(local, np.cross(T.actInv(self.data.oMf[f].translation), local))
        return out


def _chain(q: Array, h: Array, G: Array, R: Array, a_base: Array) -> Array:
    """(K, 3, nv, nv) by the knots before, at and after the beginning of each step, from the derivatives G, of the same
    shape, by rnea's q, v and a; R (K, 3, 3) turns the base, whose acceleration in its own frame is a_base (K, 3)."""
    by_q, by_v, by_a = G[:, 0], G[:, 1], G[:, 2].copy()
    by_q[:, :, :3] = 0.0  # nothing depends on where the base is
    by_q[:, :, 3:6] += by_a[:, :, :3] @ skew(a_base)
    by_a[:, :, :3] = by_a[:, :, :3] @ np.swapaxes(R, 1, 2)
    by_v[:, :, :3] = 0.0
    by_a /= h[1:, None, None]
    by_v -= by_a
    # velocity = log(R0^T R1) / h: by the later knot J / h, by the earlier one -J^T / h.
    turn = (Rotation.from_quat(q[:-1, 3:7]).inv() * Rotation.from_quat(q[1:, 3:7])).as_rotvec()
    late = np.tile(np.eye(q.shape[1] - 1), (len(turn), 1, 1))
    late[:, 3:6, 3:6] = right_jacobian_inverse(turn)
    late /= h[:, None, None]
    early = -np.swapaxes(late, 1, 2)
    return np.stack([by_v @ early[:-1], by_q + by_v @ late[:-1] + by_a @ early[1:], by_a @ late[1:]], axis=1)
