"""A camera's path in the world of the fit (z up, the ground at z = 0, mean height 1), and how certain it is."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.reconstruct import ground, resection, scale_breaks, sfm

GROUND_SUPPORT = 0.08  # part of the weight of all sparse points that a plane needs to be taken for the ground
SLOPE_DEG = 1.0  # standard deviation of the slope of what subjects walk on
# Of the median distance of the sparse points: least height of the lowest camera over the lowest of them, and the height
# that it is given where it has less. A camera that looks down by 12 degrees at ground so far away is so high.
_LEAST_HEIGHT, _GUESSED_HEIGHT = 0.02, 0.2
_SCALE = "mean camera height over the ground set to 1"
GUESSED_SCALE = "guessed camera height set to 1"


@dataclass(frozen=True)
class CameraSettings:
    """What the stage's configuration says, in px of the decoded frames. See `CameraConfig`."""

    focal: float
    focal_std: float
    refine_focal: bool
    key_every: int
    features: int
    overlap: int
    seed: int


@dataclass(frozen=True)
class CameraPath:
    """K (3, 3) px and T_world_cam (T, 4, 4), world z up, ground z = 0, mean camera height 1, and the report."""

    K: np.ndarray
    T_world_cam: np.ndarray
    report: dict[str, Any]


def _intrinsics(focal: float, center: np.ndarray) -> np.ndarray:
    return np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], float)


def _world_from(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) to a world with z along `up` and y along the horizontal part of `forward`."""
    z = up / np.linalg.norm(up)
    y = forward - (forward @ z) * z
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def _gravity(frames, masks, R: np.ndarray, focal: float, center: np.ndarray) -> ground.Gravity:
    some = np.unique(np.linspace(0, len(frames) - 1, 8).round().astype(int))
    return ground.gravity_from_lines(frames[some], masks[some], R[some], focal, center)


def _gravity_report(g: ground.Gravity, focal_std: float) -> dict[str, Any]:
    """What is said of an up that comes from one place.  focal_std: of the focal length, relative to it."""
    # Lines show where on the picture they meet, f / tan(pitch) below its middle: a wrong f turns up.
    by_focal = 0.5 * np.sin(2 * g.pitch) * focal_std
    return {
        "gravity_std_deg": float(np.degrees(np.sqrt(g.pitch_std**2 + g.roll_std**2 + by_focal**2))),
        "up_source": "vertical lines and prior" if g.lines >= 5 else "prior of hand-held footage",
        "up_lines": g.lines,
        "pitch_deg": float(np.degrees(g.pitch)),
        "pitch_std_deg": float(np.degrees(g.pitch_std)),
        "roll_deg": float(np.degrees(g.roll)),
        "roll_std_deg": float(np.degrees(g.roll_std)),
    }


def turning(
    frames, masks, R: np.ndarray, focal: float, focal_std: float, center: np.ndarray, report: dict[str, Any]
) -> CameraPath:
    """A camera at height 1 that turns by R (T, 3, 3); the first key frame's camera is the frame of R. The report, to
    which more is added, says mode and reprojection error."""
    g = _gravity(frames, masks, R, focal, center)
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[:, :3, :3] = _world_from(g.up, R[0][:, 2]) @ R
    T[:, 2, 3] = 1.0
    report |= {"focal_px": float(focal), "focal_std_px": float(focal_std)}
    report |= {"scale_source": "camera height set to 1"} | _gravity_report(g, focal_std / focal)
    return CameraPath(_intrinsics(focal, center), T, report)


def moving(
    frames, masks, structure: sfm.Structure, focal_std: float, center: np.ndarray, report: dict[str, Any]
) -> CameraPath:
    """A camera that travels: the frames between the key frames, the ground, and the scale that it sets."""
    K = _intrinsics(structure.focal, center)
    weights = _near_feet(structure, masks)
    structure, breaks = scale_breaks.mended(structure, weights)
    path, measured = resection.camera_path(frames, structure, K)
    axes = Rotation.from_matrix(path[:, :3, :3]).mean().as_matrix()
    plane = ground.find_ground(structure.points, weights, axes, path[:, :3, 3])
    if plane is not None and plane.support > GROUND_SUPPORT:
        up, offset, scale_source = plane.normal, plane.offset, _SCALE
        report |= {
            "up_source": "ground plane",
            "gravity_std_deg": float(np.hypot(np.degrees(plane.tilt_std), SLOPE_DEG)),
            "ground_points": int(plane.inliers.sum()),
            "ground_support": plane.support,
        }
    else:
        g = _gravity(frames, masks, np.swapaxes(path[:1, :3, :3], 1, 2) @ path[:, :3, :3], structure.focal, center)
        up = path[0, :3, :3] @ g.up
        offset, scale_source = _lowest(structure.points, path[:, :3, 3], up)
        report |= _gravity_report(g, focal_std / structure.focal)
    scale = 1.0 / float((path[:, :3, 3] @ up - offset).mean())
    turn = _world_from(up, path[0, :3, 2])
    T = path.copy()
    T[:, :3, :3] = turn @ path[:, :3, :3]
    T[:, :3, 3] = scale * ((path[:, :3, 3] - path[:, :3, 3].mean(0)) @ turn.T)
    T[:, 2, 3] = scale * (path[:, :3, 3] @ up - offset)
    report |= {
        "mode": "moving",
        "reprojection_error_px": structure.error_px,
        "focal_px": structure.focal,
        "focal_std_px": focal_std,
        "key_frame_share": len(structure.frames) / report["key_frames"],
        "frames_measured": int(measured.sum()),
        "sparse_points": len(structure.points),
        "least_angle_deg": structure.least_angle,
        "scale_breaks": [{"after_frame": frame, "times": round(ratio, 3)} for frame, ratio in breaks],
        "scale_source": scale_source,
    }
    return CameraPath(K, T, report)


def _lowest(points: np.ndarray, centers: np.ndarray, up: np.ndarray) -> tuple[float, str]:
    """How far up (3,) the ground is that the lowest sparse points (P, 3) lie on, and where the scale comes from: from
    the cameras' (T, 3) height over it, or a guess of it where those points are no lower than the cameras."""
    offset, camera = float(np.quantile(points @ up, 0.02)), float((centers @ up).min())
    distance = float(np.median(np.linalg.norm(points - centers.mean(0), axis=-1)))
    if camera - offset > _LEAST_HEIGHT * distance:
        return offset, _SCALE
    return camera - _GUESSED_HEIGHT * distance, GUESSED_SCALE


def _near_feet(structure: sfm.Structure, masks: np.ndarray) -> np.ndarray:
    """(P,) weight of each sparse point: how near it is seen to the mask's lowest point, and how sure its depth is."""
    weight = np.full(len(structure.points), 0.05)
    size = 0.25 * max(masks.shape[1:])
    for n, t in enumerate(structure.frames):
        ys, xs = np.nonzero(masks[t])
        if len(ys) == 0:
            continue
        low = ys >= np.quantile(ys, 0.98)
        foot = np.array([xs[low].mean(), ys[low].mean()])
        rows = structure.observations[:, 0] == n
        near = np.exp(-0.5 * np.sum((structure.xy[rows] - foot) ** 2, axis=-1) / size**2)
        np.maximum.at(weight, structure.observations[rows, 1], near)
    return weight * np.minimum(1.0, _parallax(structure) / np.radians(2.0)) ** 2


def _parallax(structure: sfm.Structure) -> np.ndarray:
    """(P,) rad, angle between the rays to each point from the first and the last frame that see it."""
    centers = structure.T_world_cam[:, :3, 3]
    a, b = (centers[n] - structure.points for n in structure.seen())
    cosine = (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-12)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
