"""Writing down a roll-out, in arrays that are as long as it will be: nothing grows while the controller runs."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference, Rollout
from slomo.robot import Robot
from slomo.track.controller import Controller

Array = np.ndarray


class Recording:
    """One row a joint tick, and one a plan.

    Args:
        reference: with the lead-in.  ticks: rows there will be at most.
    """

    def __init__(self, robot: Robot, reference: Reference, *, ticks: int):
        nj, C = len(robot.joint_names), len(robot.limbs)
        shapes = dict(
            t=(), q=(7 + nj,), v=(6 + nj,), q_des=(nj,), tau=(nj,), asked=(nj,), body=(7,), points=(C, 3), lam=(C, 3),
            body_est=(7,), contact_est=(C,),
        )  # fmt: skip
        self.robot, self.reference, self.ticks = robot, reference, ticks
        self._rows = {name: np.zeros((ticks, *shape)) for name, shape in shapes.items()}
        self._solves = {name: np.zeros(ticks) for name in ("mpc_t", "mpc_ms", "mpc_status")}
        self._n, self._solved, self._plan = 0, 0, None

    def add(self, controller: Controller, **row: Any) -> None:
        """The row of this tick: the columns of `Rollout` that only the world knows; the rest is the controller's."""
        row["body_est"] = controller.point_state[0][:7]
        row["contact_est"] = controller.estimator.contact
        for name, x in row.items():
            self._rows[name][self._n] = x
        self._n += 1
        plan = controller.plan
        if plan is not None and plan is not self._plan:
            for name, x in zip(self._solves, (row["t"], 1e3 * plan.seconds, plan.status), strict=True):
                self._solves[name][self._solved] = x
            self._solved, self._plan = self._solved + 1, plan

    @property
    def torque_ratio(self) -> Array:
        """(T,) largest |torque asked for| over the effort limit, before clipping."""
        return np.max(np.abs(self._rows["asked"][: self._n]) / self.robot.effort, axis=1)

    def rollout(self, reference_digest: str) -> Rollout:
        """All of it so far."""
        rows = {name: x[: self._n] for name, x in self._rows.items() if name != "asked"}
        solves = {name: x[: self._solved] for name, x in self._solves.items()}
        wanted = reference_at(self.reference, rows["t"])
        return Rollout(
            **rows,
            **solves,
            body_ref=wanted[:, :7],
            points_ref=wanted[:, 7:].reshape(len(wanted), -1, 3),
            point_names=self.robot.foot_names,
            joint_names=self.robot.joint_names,
            reference_digest=reference_digest,
        )


def reference_at(reference: Reference, t: Array) -> Array:
    """(T, 7 + 3 C) configurations at times t (T,): linear between the knots, rotations along arcs, the ends held."""
    t = np.clip(t, reference.t[0], reference.t[-1])
    k = np.clip(np.searchsorted(reference.t, t, side="right") - 1, 0, len(reference.t) - 2)
    a = ((t - reference.t[k]) / (reference.t[k + 1] - reference.t[k]))[:, None]
    x = (1 - a) * reference.q[k] + a * reference.q[k + 1]
    R, S = Rotation.from_quat(reference.q[k, 3:7]), Rotation.from_quat(reference.q[k + 1, 3:7])
    x[:, 3:7] = (R * Rotation.from_rotvec(a * (R.inv() * S).as_rotvec())).as_quat()
    return x
