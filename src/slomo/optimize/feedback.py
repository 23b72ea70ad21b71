"""What the whole robot's joints say of a motion, in the point-foot model's terms: limits for its next solution.

All are linear about the motion that was looked at, and exact there: torques in the forces, speeds in the velocities of
body and points, and the half-spaces beyond which inverse kinematics could not bring the points of a limb.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.optimize.inverse import MISSED, JointMotion
from slomo.optimize.load import JointLoad
from slomo.optimize.reach import Reach
from slomo.robot import Robot

_LOADED = 0.97  # of a joint's limits that is planned with
_SINGULAR = 0.1  # of the usual size of the Jacobian: directions in which a limb moves less say nothing of its joints
_MARGIN = 1e-3  # m by how much less than was reached is asked for
_NEIGHBOURS = 2  # knots to either side of one that missed that are limited with it


def torques(robot: Robot, joints: JointMotion, reference: Reference) -> JointLoad:
    """The torques of all joints along a motion, over their limits, as they follow from the forces nearby."""
    arm = -joints.jacobian[:-1].transpose(0, 2, 1) / robot.effort[:, None]
    rest = joints.tau / robot.effort - np.einsum("kjf,kf->kj", arm, reference.u)
    return JointLoad(np.ascontiguousarray(arm), rest, np.full(rest.shape, _LOADED))


def speeds(robot: Robot, joints: JointMotion, reference: Reference) -> JointLoad:
    """The speeds of all joints along a motion, over their limits, as they follow from body and points nearby."""
    T, C = joints.miss.shape
    R = Rotation.from_quat(reference.q[:, 3:7]).as_matrix()
    # Velocities of the points in the body: v_c - v - R w x r.
    relative = np.zeros((T, C, 3, 6 + 3 * C))
    for c in range(C):
        x, y, z = (reference.points[:, c] - reference.q[:, :3]).T
        o = np.zeros(T)
        cross = np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
        relative[:, c, :, :3], relative[:, c, :, 3:6] = -np.eye(3), cross @ R
        relative[:, c, :, 6 + 3 * c : 9 + 3 * c] = np.eye(3)
    # The least change of the joints' speeds, as shares of their limits, that does it.
    J = joints.jacobian * robot.velocity
    size = float(np.median(np.linalg.norm(J, axis=1)))
    Jt = J.transpose(0, 2, 1)
    inverse = Jt @ np.linalg.inv(J @ Jt + (_SINGULAR * size) ** 2 * np.eye(3 * C))
    arm = inverse @ relative.reshape(T, 3 * C, -1)
    rest = joints.v[:, 6:] / robot.velocity - np.einsum("kjf,kf->kj", arm, reference.v)
    return JointLoad(np.ascontiguousarray(arm), rest, np.full(rest.shape, _LOADED))


def trunk_overloaded(robot: Robot, joints: JointMotion) -> bool:
    """Whether a joint is overloaded that carries no foot: then it is the trunk's acceleration that asks too much."""
    ratio = (np.abs(joints.tau) / robot.effort).max(axis=0)
    model = robot.model
    legs = {
        model.idx_vs[j] - 6
        for c, name in enumerate(robot.foot_names)
        if np.isfinite(robot.clearance[c])
        for j in model.supports[model.frames[model.getFrameId(name)].parentJoint]
        if j > 1
    }
    return any(ratio[j] > 1.0 for j in range(len(ratio)) if j not in legs)


def reach(robot: Robot, joints: JointMotion, reference: Reference) -> Reach:
    """Half-spaces, one for each limb, about the places where the joints cannot bring its points."""
    T, C = joints.miss.shape
    pairs = [[int(c) for c in pair] for pair in robot.pairs]
    limbs = pairs + [[c] for c in range(C) if c not in robot.pairs]
    R = Rotation.from_quat(reference.q[:, 3:7]).as_matrix()
    off, at = (
        np.einsum("kji,kcj->kci", R, x)
        for x in (reference.points - joints.reached, joints.reached - reference.q[:, None, :3])
    )
    normal, most = np.zeros((T, len(limbs), C, 3)), np.full((T, len(limbs)), np.inf)
    for m, points in enumerate(limbs):
        missed = np.flatnonzero(joints.miss[:, points].max(axis=1) > MISSED)
        for k in range(T):
            # What is taken away from one knot must not come back at the next.
            near = missed[np.abs(missed - k) <= _NEIGHBOURS]
            if len(near):
                n = near[np.argmin(np.abs(near - k))]
                normal[k, m, points] = off[n, points] / np.linalg.norm(off[n, points])
                most[k, m] = np.sum(normal[k, m] * at[n]) - _MARGIN
    return Reach(normal.reshape(T, len(limbs), -1), most)
