"""Bodies mostly move the way they face: what the path over the ground says of the side from which they are seen.

An outline leaves the view open by ten degrees and more, the same way in every frame of a clip, since nobody knows
how long and how wide this very body is; and it does not tell a view from behind from one from the front. The way of
travel, from the camera and the masks' lowest rows, errs otherwise.
"""

import numpy as np

from slomo.ground_path import GroundPath
from slomo.prior.clip import CENTRES

Array = np.ndarray

# Share of moving bodies whose way of travel says nothing of how they face: they go backwards or sideways.
ASTRAY = {"quadruped": 0.08, "human": 0.2}
SPREAD = np.radians(9.0)  # s.d. of the angle between the way of travel and the trunk of a body that goes ahead
SLOW = 0.35  # heights a second: half of the bodies this slow go somewhere
WINDOW = 0.6  # s over which a velocity is measured
INDEPENDENT = 3.0  # errors of places that a window holds: those of neighbouring frames are alike


def view_of_travel(path: GroundPath, t: Array, index: Array, T_world_cam: Array, kind: str) -> Array:
    """(F, 36) probability of the azimuth's bins (see `prior.labels`), uniform where the subject stands.

    Args:
        path: of the subject over the frames t (T,) s.  index: (F,) the frames that are asked about.
        T_world_cam: (T, 4, 4), z up.  kind: of the skeleton.
    """
    if not path.height > 0:  # seen where no ground is
        return np.full((len(index), len(CENTRES)), 1 / len(CENTRES), np.float32)
    slow = SLOW * path.height
    heading = path.heading(t, slow)[index]
    speed = np.linalg.norm(path.velocity[index], axis=1)
    to_camera = T_world_cam[index, :2, 3] - path.middle[index]
    azimuth = np.arctan2(to_camera[:, 1], to_camera[:, 0]) - heading
    # How wrong a heading is: the slope of a line through places that are this wrong, across the way of travel.
    across = np.stack([-np.sin(heading), np.cos(heading)], 1)
    spread = 1.5 * np.median(np.abs(path.noise @ across.T), axis=0)
    wrong = np.sqrt(12 / INDEPENDENT) * spread / WINDOW / np.maximum(speed, 1e-9)
    sd = np.hypot(SPREAD, wrong)
    apart = np.mod(CENTRES - azimuth[:, None] + np.pi, 2 * np.pi) - np.pi
    p = np.exp(-0.5 * (apart / sd[:, None]) ** 2)
    p /= p.sum(1, keepdims=True)
    moving = speed**2 / (speed**2 + slow**2)
    sure = (moving * (1 - ASTRAY.get(kind, max(ASTRAY.values()))))[:, None]
    return (sure * p + (1 - sure) / len(CENTRES)).astype(np.float32)
