"""Where the robot's feet and body go: under its hips, within reach, from the origin, on a step."""

import numpy as np

from slomo.errors import InvalidData, UsageError
from slomo.retarget.trunk import Trunk
from slomo.robot import Robot
from slomo.terrain import Box, Terrain


def footprint(
    xy: np.ndarray, base: np.ndarray, yaw: np.ndarray, standing: np.ndarray, robot: Robot
) -> tuple[np.ndarray, np.ndarray, float]:
    """Stance width and length of the robot, strides of the creature, shortened where legs would not reach.

    Each foot is shifted by a constant in the heading frame, so that its median stance place lies under the robot's hip.
    One factor on the path of body and feet alike keeps standing feet standing.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    relative = np.einsum("tji,tfj->tfi", R, xy - base[:, None])
    centre = np.stack(
        [np.median(x[on] if on.any() else x, axis=0) for x, on in zip(relative.swapaxes(0, 1), standing.T, strict=True)]
    )
    excursion = float(np.percentile(np.linalg.norm(relative - centre, axis=2), 95))
    length = 0.95 * float(robot.leg_reach[:, 1].min())
    room = 0.8 * np.sqrt(max(length**2 - robot.standing_height**2, 0.0))
    stride = min(1.0, room / excursion) if excursion > 0 else 1.0
    shift = robot.nominal_hips[:, :2] - stride * centre
    return stride * xy + np.einsum("tij,fj->tfi", R, shift), stride * base, stride


def start_at_origin(xy: np.ndarray, base: np.ndarray, trunk: Trunk) -> tuple[np.ndarray, np.ndarray, Trunk]:
    """The robot starts at the origin and looks along x."""
    c, s = np.cos(trunk.yaw[0]), np.sin(trunk.yaw[0])
    R = np.array([[c, s], [-s, c]])
    moved = Trunk(origin=trunk.origin, yaw=trunk.yaw - trunk.yaw[0], pitch=trunk.pitch, roll=trunk.roll)
    return (xy - base[0]) @ R.T, (base - base[0]) @ R.T, moved


def make_terrain(xy: np.ndarray, robot: Robot, *, step_height: float, step_limbs: tuple[str, ...]) -> Terrain:
    """A step in front of the feet that stand on the ground and under those that stand on it."""
    if step_height == 0:
        return Terrain()
    unknown = [n for n in step_limbs if n not in robot.limb_names]
    if unknown or not step_limbs:
        raise UsageError(f"no limb {unknown or step_limbs}", where="retarget.step_limbs", valid=robot.limb_names)
    on = np.array([n in step_limbs for n in robot.limb_names])
    behind = float(xy[:, ~on, 0].max())
    ahead = float(xy[:, on, 0].min())
    if ahead - behind < 0.06:
        raise InvalidData(
            f"a step under {', '.join(step_limbs)} does not fit: feet off it reach x = {behind:.2f} m and "
            f"feet on it come back to {ahead:.2f} m", where="retarget.step_height",
            todo="choose a part with --set retarget.start=... and retarget.end=...",
        )  # fmt: skip
    edge = (behind + ahead) / 2
    far, wide = float(xy[..., 0].max()) + 0.5, float(np.abs(xy[..., 1]).max()) + 0.5
    return Terrain((Box(edge, far, -wide, wide, step_height),))
