"""Plots of the line's results (matplotlib, colours for the colour-blind)."""

import io

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from slomo.motion import KeypointMotion, Reference, Rollout
from slomo.robot_file import key_point_names
from slomo.terrain import Terrain


def foot_heights(
    target: KeypointMotion,
    reference: Reference,
    rollout: Rollout,
    *,
    limbs: tuple[str, ...],
    terrain: Terrain,
    robot: str,
) -> bytes:
    """PNG: height over the ground of each foot in the three stages, one subplot a foot.

    Args:
        target: retarget's key points.  limbs: C names in the order of the reference's points.
    """
    figure = Figure(figsize=(10, 1.2 + 1.5 * len(limbs)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(len(limbs), 1, sharex=True, sharey=True))
    on = rollout.t >= 0
    z_ref, z_robot = (100 * (p[..., 2] - terrain.height(p)) for p in (reference.points, rollout.points[on]))  # cm
    for c, (axis, limb, key_point) in enumerate(zip(axes, limbs, key_point_names(limbs), strict=True)):
        p = target[key_point]
        z = 100 * (p[:, 2] - terrain.height(p))
        axis.axhline(0, color="0.6", lw=0.8)
        axis.plot(target.t, z, color="#999999", lw=3, label="reconstructed, retargeted")
        axis.plot(reference.t, z_ref[:, c], color="#0072B2", lw=1.8, label="optimised reference")
        axis.plot(rollout.t[on], z_robot[:, c], color="#D55E00", lw=1.2, label=f"{robot} in simulation")
        standing = np.append(reference.lam[:, c, 2] > 1.0, False)
        axis.fill_between(
            reference.t, 0, 1, where=standing, step="post", transform=axis.get_xaxis_transform(),
            color="#0072B2", alpha=0.08, lw=0, label="in contact (reference)",
        )  # fmt: skip
        axis.set_title(limb.replace("_", " "), loc="left", fontsize=10)
        axis.set_ylabel("height (cm)")
        axis.grid(alpha=0.25, lw=0.5)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    axes[-1].set_xlabel("time (s)")
    axes[-1].set_xlim(0, float(reference.t[-1]))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()
