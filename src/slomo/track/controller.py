"""From a robot's sensors to its motors: state, plan, joint targets. Knows no simulation and no network."""

import numpy as np

from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.config import JOINT_HZ, Config, layer_of, resolved
from slomo.track.estimator import Estimator
from slomo.track.joint_space import JointCommand, JointSpace
from slomo.track.lead_in import with_lead_in
from slomo.track.open_loop import STIFFER
from slomo.track.plan import Plan
from slomo.track.planner import make_planner
from slomo.track.posture import standing_pose
from slomo.track.sensors import SensorSample
from slomo.track.whole_body_qp import WholeBodyQp

Array = np.ndarray

# s: how soon a standing foot tells where the ground is, and how soon that is forgotten in the air.
FEELING, FORGETTING = 0.05, 0.3
HIGHEST = 0.06  # m, by which the ground may be off
STANDING = 3.0  # N, of planned force from which a point is planned to stand
SMOOTHING = 0.005  # s, time constant


class Controller:
    """Follows a reference: `start` once, then `sense` for each sample and `command` at the joint rate.

    Args:
        robot: whose reference it is.
        reference: starts at t = 0; the lead-in from a stand is put before it here.
        terrain: ground as it was planned.

    Attributes:
        reference: with the lead-in; it begins at reference.t[0] < 0, on the controller's clock.
        plan: the last one, None before the first tick.
        shift: (C,) m, how much higher than planned the ground under each point is found to be.
        point_state: ((7 + 3 C,), (6 + 3 C,)) the state from which the last command was made, as in `motion.Reference`.
    """

    def __init__(
        self,
        robot: Robot,
        reference: Reference,
        *,
        terrain: Terrain,
        config: Config,
    ):
        config = resolved(config, robot)
        model = PointFootModel.from_robot(robot, mu=config.mu)
        self.robot, self.config, self.terrain = robot, config, terrain
        self.reference = with_lead_in(
            reference, model, standing=robot.nominal_feet, terrain=terrain, settle=config.settle, blend=config.blend
        )
        self.planner = make_planner(config.controller, model, self.reference, terrain=terrain, config=config)
        self.joints = JointSpace(robot)
        self.layer = self._make_layer()
        self.estimator = Estimator(robot, terrain)
        self.plan: Plan | None = None
        self._begin()

    @property
    def first_pose(self) -> Array:
        """(nq,) in which the reference begins, standing."""
        return standing_pose(self.robot, self.reference.q[0])

    def warm_up(self) -> float:
        """Compile everything that runs later; returns the seconds."""
        return self.planner.warm_up() + self.estimator.warm_up()

    def start(self, sample: SensorSample) -> None:
        """Begin: the robot stands at rest in about `first_pose`."""
        self._begin()
        self.estimator.start(sample, self.first_pose)

    def sense(self, sample: SensorSample) -> None:
        """Take in what was measured, at any rate up to 1 kHz."""
        planned = np.ones(len(self.robot.limbs), bool)
        if self.plan is not None:
            planned = self.plan.at(sample.t).lam[:, 2] > STANDING
        self.estimator.sense(sample, planned)

    def estimate(self, t: float) -> tuple[Array, Array]:
        """q (nq,) and v (nv,) of the whole robot, Pinocchio's convention (root velocity in the root's frame).

        The filter's, or the true ones where they have been given by `observe`.
        """
        return self._true or self.estimator.state(t)

    def observe(self, q: Array, v: Array) -> None:
        """Instead of `start` and `sense`, for study: the true q (nq,) and v (nv,)."""
        self._true = q, v

    def command(self, t: float) -> JointCommand:
        """What the motors shall do now; plans anew where that is due.

        Args:
            t: s, on the reference's clock; never less than before.
        """
        q, v = self.estimate(t)
        if self._true is None and isinstance(self.layer, WholeBodyQp):
            v = self._smoothed(v)
        self.point_state = q_point, v_point = self.joints.state(q, v)
        if self.plan is None or t >= self._due - 1e-6:
            self._feel_ground(q_point)
            self.plan = self.planner.step(t, q_point, v_point, shift=self.shift)
            period = 1 / self.config.mpc_hz
            self._due += period * max(1.0, np.floor((t - self._due) / period + 1e-3) + 1)
        u = self.plan.feedback(t, q_point, v_point)
        return self.layer.command(self.plan.at(t), self.plan.at(t + self.config.lookahead), u=u, q=q, v=v)

    def _smoothed(self, v: Array) -> Array:
        """v (nv,) with joint speeds through a low pass: the QP turns noise of encoders into torques at once."""
        last = v[6:] if self._speeds is None else self._speeds
        speeds = last + (1 - np.exp(-1 / (JOINT_HZ * SMOOTHING))) * (v[6:] - last)
        self._speeds = speeds
        return np.concatenate([v[:6], speeds])

    def _make_layer(self) -> JointSpace | WholeBodyQp:
        """From plan to joints: the layer that the parameters name."""
        robot, config = self.robot, self.config
        if config.controller == "open-loop":
            return JointSpace(robot, kp=STIFFER[0] * config.kp, kd=STIFFER[1] * config.kd)
        if layer_of(config, robot.kind) == "ik":
            return JointSpace(robot, kp=config.kp, kd=config.kd)
        return WholeBodyQp(robot, self.reference, terrain=self.terrain, mu=config.mu)

    def _feel_ground(self, q_point: Array) -> None:
        """Let `shift` follow the standing feet: the ground is where they are."""
        points = q_point[7:].reshape(-1, 3)
        off = np.clip(points[:, 2] - self.terrain.height(points), -HIGHEST, HIGHEST)
        step = 1 / self.config.mpc_hz
        stands = self.estimator.contact > 0.9
        self.shift += np.where(stands, step / FEELING * (off - self.shift), -step / FORGETTING * self.shift)

    def _begin(self) -> None:
        self.shift = np.zeros(len(self.robot.limbs))
        self.plan, self._due = None, float(self.reference.t[0])
        self.planner.reset()
        self.layer.reset()
        self._speeds: Array | None = None
        self._true: tuple[Array, Array] | None = None
