"""From a reference to the whole robot: joint angles by inverse kinematics, torques by inverse dynamics.

Inverse kinematics, at each knot with the base at the body's pose: of the configurations within the joint limits that
put every contact frame on its point, the one nearest to a home,

    min |S (q - q_home)|^2   such that   p_c(q) = f_c,   lower <= q <= upper,

by Gauss-Newton steps, damped by the error's own size (Sugihara, "Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method", 2011), with joints held at a limit that they would cross. S makes joints dear that move
heavy parts or several limbs, or that are slow, so that an arm is used before the trunk. Where joints are redundant,
home is a little of the way from the last knot's angles to the nominal ones, and in a second pass the first one's,
smoothed in time.

Inverse dynamics, of each step: the recursive Newton-Euler algorithm (Featherstone 2008, section 5.3) with the step's
contact forces at the contact frames and the accelerations of the reference's own integrator, a = (v_next - v) / h. It
has the real masses of the limbs, where the point-foot model has point masses at their ends.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.ndimage import gaussian_filter1d

from slomo.motion import Reference
from slomo.robot import Robot

Array = np.ndarray

WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
SINGULAR = 1e-8  # (m/rad)^2, damping that is always there: a straight leg moves no foot along itself
FLAT = 0.01  # m/rad, of a foot's tilt about the line from heel to toe: gives way to the points
LARGEST_STEP = 0.5  # rad
STILL = 1e-4  # rad, a step after which the iteration ends
ITERATIONS = 30
MISSED = 1e-3  # m, a point farther away than this was missed
PULL = np.minimum(1.0, 0.7 ** (np.arange(ITERATIONS) - 8))  # home gives way at last: with limits it can go in circles
RETURN = 0.5  # s in which redundant joints come back to their nominal angles
SMOOTHING = 0.3  # s, of the redundant joints' home in the second pass


@dataclass(frozen=True)
class JointMotion:
    """The whole robot's motion along a reference of T knots.

    Attributes:
        q: (T, nq) Pinocchio configurations, root free flyer first (position m, quat_xyzw), then joints rad.
        v: (T, nv) root twist in the root's frame (m/s, rad/s), then joints rad/s; knot k + 1 ends step k.
        tau: (T - 1, nj) N m, inverse dynamics.  tau_static: (T - 1, nj) N m, -J^T u alone.
        jacobian: (T, 3 C, nj) m/rad, of the contact frames by the joints.
        root_wrench: (T - 1, 6) N and N m in the root's frame that no motor gives: what the point-foot model misses of
            the whole robot.
        miss: (T, C) m, distance of the contact frames from their points.
        reached: (T, C, 3) m, where the contact frames are, world.
    """

    q: Array
    v: Array
    tau: Array
    tau_static: Array
    jacobian: Array
    root_wrench: Array
    miss: Array
    reached: Array


def joint_motion(robot: Robot, reference: Reference) -> JointMotion:
    """Joint angles, velocities and torques along a reference of this robot.

    Unreachable points are missed as little as the limits allow (`JointMotion.miss`); nothing is raised.
    """
    r, model = reference, robot.model
    T, nj = len(r.t), len(robot.effort)
    legs = Legs(robot)
    root = np.array([legs.root(*state) for state in zip(r.q, r.v, strict=True)])  # (T, 7 + 6): pose and twist
    q, v = np.empty((T, model.nq)), np.empty((T, model.nv))
    q[:, :7], v[:, :6] = root[:, :7], root[:, 7:]
    nominal = np.tile(robot.q_nominal[7:], (T, 1))
    keep = np.exp(-np.concatenate([[np.inf], r.h]) / RETURN)
    q[:, 7:], error = legs.sweep(root[:, :7], r.points, nominal, keep)
    if nj > len(legs.error):
        home = gaussian_filter1d(q[:, 7:], SMOOTHING * (T - 1) / (r.t[-1] - r.t[0]), axis=0, mode="nearest")
        q[:, 7:], error = legs.sweep(root[:, :7], r.points, home, np.zeros(T))
    v[1:, 6:] = np.diff(q[:, 7:], axis=0) / r.h[:, None]
    v[0, 6:] = legs.velocities(q[0], v[0, :6], v[1, 6:], r.v[0, 6:])

    tau, tau_static, wrench = np.empty((T - 1, nj)), np.empty((T - 1, nj)), np.empty((T - 1, 6))
    jacobian = np.empty((T, 3 * len(legs.points), nj))
    for k in range(T - 1):
        J = legs.jacobian(q[k])[: 3 * len(legs.points)]
        a = np.concatenate([legs.root_acceleration(r.q[k], r.v[k], r.v[k + 1], r.h[k]), (v[k + 1] - v[k])[6:] / r.h[k]])
        force = pin.rnea(model, legs.data, q[k], v[k], a) - J.T @ r.lam[k].ravel()
        wrench[k], tau[k] = force[:6], force[6:]
        tau_static[k], jacobian[k] = -J[:, 6:].T @ r.u[k], J[:, 6:]
    jacobian[-1] = legs.jacobian(q[-1])[: 3 * len(legs.points), 6:]
    miss = np.linalg.norm(error, axis=2)
    return JointMotion(q, v, tau, tau_static, jacobian, wrench, miss, reached=r.points - error)


class Legs:
    """Contact frames of a robot: residual and Jacobian of inverse kinematics, and the root that carries the base.

    After `solve`, `error` (m) is the residual of its solution: 3 rows a point, then one a flat foot.
    """

    def __init__(self, robot: Robot):
        self.robot, self.model, self.data = robot, robot.model, robot.model.createData()
        self.points = [self.model.getFrameId(name) for name in robot.foot_names]
        T_root_base = self.model.frames[self.model.getFrameId(robot.base)].placement
        self._R_base_root, self._lever = T_root_base.rotation.T, T_root_base.inverse().translation
        # Two points on one link leave it free to roll about the line through them: a foot, kept flat sideways.
        pin.framesForwardKinematics(self.model, self.data, robot.q_nominal)
        self._flat = []  # joint, and the axis across the foot in its frame, level in the nominal pose
        for toe, heel in robot.pairs:
            joint = self.model.frames[self.points[toe]].parentJoint
            along = self.data.oMf[self.points[toe]].translation - self.data.oMf[self.points[heel]].translation
            across = np.cross([0.0, 0.0, 1.0], along)
            self._flat.append((joint, self.data.oMi[joint].rotation.T @ across / np.linalg.norm(across)))
        inertia = np.diag(pin.crba(self.model, self.data, robot.q_nominal))[6:]
        chains = [self.model.supports[j] for j in {self.model.frames[f].parentJoint for f in self.points}]
        limbs = [sum(j in chain for chain in chains) for j in range(2, self.model.njoints)]
        heavy = np.maximum(1.0, np.sqrt(inertia / np.median(inertia))) * np.maximum(1, limbs)
        self._scale = heavy * np.median(robot.velocity) / robot.velocity
        self.error = np.zeros(3 * len(self.points) + len(self._flat))

    def root(self, q: Array, v: Array) -> Array:
        """(7 + 6,) pose of the root (m, quat_xyzw) and its twist in its own frame, of a point-foot state."""
        R = pin.Quaternion(q[3:7]).normalized().matrix()
        R_root = R @ self._R_base_root
        spin = v[3:6]
        pose = pin.SE3ToXYZQUAT(pin.SE3(R_root, q[:3] + R @ self._lever))
        linear = R_root.T @ (v[:3] + R @ np.cross(spin, self._lever))
        return np.concatenate([pose, linear, self._R_base_root.T @ spin])

    def root_acceleration(self, q: Array, v: Array, v1: Array, h: float) -> Array:
        """(6,) spatial acceleration of the root in its own frame, of a step from the state (q, v) to velocity v1."""
        R = pin.Quaternion(q[3:7]).normalized().matrix()
        spin, turn = v[3:6], (v1[3:6] - v[3:6]) / h
        of_lever = np.cross(turn, self._lever) + np.cross(spin, np.cross(spin, self._lever))
        twist = self.root(q, v)[7:]
        linear = self._R_base_root.T @ (R.T @ (v1[:3] - v[:3]) / h + of_lever)
        return np.concatenate([linear - np.cross(twist[3:], twist[:3]), self._R_base_root.T @ turn])

    def jacobian(self, q: Array) -> Array:
        """(3 C + flat feet, nv) at a configuration; its placements stay in `data`."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        J = np.empty((len(self.error), self.model.nv))
        for c, f in enumerate(self.points):
            J[3 * c : 3 * c + 3] = pin.getFrameJacobian(self.model, self.data, f, WORLD)[:3]
        for i, (joint, axis) in enumerate(self._flat):
            x, y, _ = self.data.oMi[joint].rotation @ axis
            turning = pin.getJointJacobian(self.model, self.data, joint, WORLD)[3:]
            J[3 * len(self.points) + i] = FLAT * (y * turning[0] - x * turning[1])
        return J

    def _residual(self, points: Array) -> Array:
        out = np.empty(len(self.error))
        for c, f in enumerate(self.points):
            out[3 * c : 3 * c + 3] = points[c] - self.data.oMf[f].translation
        for i, (joint, axis) in enumerate(self._flat):
            out[3 * len(self.points) + i] = -FLAT * (self.data.oMi[joint].rotation[2] @ axis)
        return out

    def sweep(self, root: Array, points: Array, home: Array, keep: Array) -> tuple[Array, Array]:
        """`solve` at every knot, each from the one before: joints (T, nj) rad and what is missing (T, C, 3) m.

        A limb that was once led to a limit (a foot turned backwards) would stay there, in a minimum of its own, long
        after its points are within reach: what is missed is tried from the nominal angles too.

        Args:
            home: (T, nj) rad.  keep: (T,) share of the last knot's angles in the home of each.
        """
        joints, error = np.empty(home.shape), np.empty(points.shape)
        last = home[0]
        for k in range(len(root)):
            aim = keep[k] * last + (1 - keep[k]) * home[k]
            last = joints[k] = self.solve(root[k], last, points[k], aim)
            error[k] = self.error[: points[k].size].reshape(-1, 3)
            if np.abs(error[k]).max() > MISSED:
                again = self.solve(root[k], self.robot.q_nominal[7:], points[k], aim)
                other = self.error[: points[k].size].reshape(-1, 3)
                if np.linalg.norm(other) < 0.5 * np.linalg.norm(error[k]):
                    last, joints[k], error[k] = again, again, other
        return joints, error

    def solve(self, root: Array, joints: Array, points: Array, home: Array, *, iterations: int = ITERATIONS) -> Array:
        """(nj,) rad that bring the contact frames to points (C, 3), from a first guess, with the root at (7,)."""
        lower, upper, scale = self.robot.lower, self.robot.upper, self._scale
        q = np.concatenate([root, joints])
        for i in range(iterations):
            J = self.jacobian(q)[:, 6:] / scale
            e = self._residual(points)
            to_home, to_lower, to_upper = (scale * (x - q[7:]) for x in (home, lower, upper))
            step = _bounded_step(J, e, PULL[i] * to_home, to_lower, to_upper) / scale
            size = np.abs(step).max()
            q[7:] = np.clip(q[7:] + step * min(1.0, LARGEST_STEP / max(size, STILL)), lower, upper)
            if size < STILL:
                break
        pin.framesForwardKinematics(self.model, self.data, q)
        self.error = self._residual(points)
        return q[7:]

    def velocities(self, q: Array, root: Array, near: Array, points: Array) -> Array:
        """(nj,) rad/s nearest to `near` that move the contact frames at `points` (3 C,) m/s, given the root's twist."""
        J = self.jacobian(q)[: len(points)]
        missing = points - J @ np.concatenate([root, near])
        return near + _damped(J[:, 6:], missing, SINGULAR)


def _damped(J: Array, e: Array, damping: float) -> Array:
    """x minimising |J x - e|^2 + damping |x|^2, by the smaller of the two systems."""
    rows, columns = J.shape
    if rows < columns:
        return J.T @ np.linalg.solve(J @ J.T + damping * np.eye(rows), e)
    return np.linalg.solve(J.T @ J + damping * np.eye(columns), J.T @ e)


def _bounded_step(J: Array, e: Array, home: Array, lower: Array, upper: Array) -> Array:
    """dq with J dq = e, damped, and else towards `home`; joints that would leave their bounds stop there."""
    damping = SINGULAR + 0.5 * float(e @ e)
    step = np.zeros(len(home))
    free = np.ones(len(home), bool)
    for _ in range(4):
        Jf = J[:, free]
        rest = e - J[:, ~free] @ step[~free]
        step[free] = _damped(Jf, rest, damping) + home[free] - _damped(Jf, Jf @ home[free], SINGULAR)
        out = free & ((step < lower) | (step > upper))
        if not out.any():
            break
        step = np.clip(step, lower, upper)
        free &= ~out
    return step
