"""Plot of a reference: which point stands when, beside the input, and how hard the joints work."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slomo.motion import KeypointMotion, Reference
from slomo.optimize.inverse import JointMotion
from slomo.optimize.sequence import in_contact
from slomo.robot import Robot
from slomo.runs import runs
from slomo.terrain import Terrain

Array = np.ndarray

PLAN, INPUT = "#0072B2", "#999999"
NAMED = ("#D55E00", "#009E73", "#CC79A7", "#E69F00")


def contacts_and_torques(
    target: KeypointMotion, reference: Reference, joints: JointMotion, *, robot: Robot, terrain: Terrain
) -> bytes:
    """PNG: contact sequence of the key points and of the plan, and below it torque and speed over their limits.

    Args:
        target: retarget's key points; contact is drawn for those of the robot's that it knows.
        joints: of the reference (`inverse.joint_motion`).
    """
    C = len(robot.limbs)
    figure = Figure(figsize=(10, 4 + 0.45 * C), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[C, 7])
    _draw_contacts(above, target, reference, robot, terrain)
    _draw_joints(below, reference, joints, robot)
    for axis in (above, below):
        axis.grid(alpha=0.25, lw=0.5, axis="x")
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    below.set_xlim(0, float(reference.t[-1]))
    below.set_xlabel("time (s)")
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def _intervals(t: Array, on: Array) -> list[tuple[float, float]]:
    """Start and duration (s) of the runs of on (T - 1,) between times (T,)."""
    return [(float(t[a]), float(t[b] - t[a])) for a, b in runs(on)]


def _draw_contacts(axis: Axes, target: KeypointMotion, reference: Reference, robot: Robot, terrain: Terrain) -> None:
    planned = in_contact(reference, terrain)
    for c, name in enumerate(robot.key_points):
        if target.contact is not None and name in target.contact_names:
            wanted = target.contact[:-1, target.contact_names.index(name)] > 0.5
            bars = _intervals(target.t - target.t[0], wanted)
            axis.broken_barh(bars, (c - 0.36, 0.3), color=INPUT, lw=0, label="input" if c == 0 else None)
        bars = _intervals(reference.t, planned[:, c])
        axis.broken_barh(bars, (c - 0.02, 0.38), color=PLAN, lw=0, label="plan" if c == 0 else None)
    axis.set_yticks(range(len(robot.limbs)), [n.replace("_", " ") for n in robot.limb_names])
    axis.set_ylim(len(robot.limbs) - 0.4, -0.6)
    axis.set_title("in contact", loc="left", fontsize=10)
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, fontsize=9)


def _draw_joints(axis: Axes, reference: Reference, joints: JointMotion, robot: Robot) -> None:
    torque = np.abs(joints.tau) / robot.effort
    speed = np.abs(joints.v[:, 6:]) / robot.velocity
    for j, color in zip(np.argsort(-torque.max(axis=0)), NAMED, strict=False):
        axis.stairs(torque[:, j], reference.t, color=color, lw=1.2, label=robot.joint_names[j])
    axis.stairs(torque.max(axis=1), reference.t, color="0.2", lw=0.8, label="largest torque")
    axis.plot(reference.t, speed.max(axis=1), color=PLAN, lw=1, ls=":", label="largest speed")
    axis.axhline(1.0, color="0.4", lw=0.8, ls="--")
    axis.set_ylim(0, max(1.3, 1.15 * float(max(torque.max(), speed.max()))))
    axis.set_title("joint torque and speed over their limits", loc="left", fontsize=10)
    axis.legend(loc="upper left", ncols=3, frameon=False, fontsize=8)
