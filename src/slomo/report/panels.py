"""The panels of the side-by-side video: each draws one stage's result at a time t of the motion."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import trimesh
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from slomo.motion import KeypointMotion, Reference, Rollout
from slomo.raycast import Light, Part, Scene, intrinsics, look_at
from slomo.report import meshes
from slomo.robot import Robot
from slomo.terrain import Terrain

SIZE = (480, 270)  # px, width and height of a panel

# Okabe and Ito's colours for the colour-blind, sRGB in [0, 1].
ORANGE, SKY_BLUE, GREEN = (0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45)
BLUE, VERMILION, GREY = (0.0, 0.45, 0.70), (0.84, 0.37, 0.0), (0.55, 0.56, 0.58)

_ANIMAL = (
    ("nose", "head", "neck", "withers", "spine_mid", "pelvis", "tail_base", "tail_tip"),
    *(
        (*root, *(f"{end}_{side}_{joint}" for joint in leg))
        for end, root, leg in (
            ("front", ("withers", "chest"), ("shoulder", "elbow", "wrist", "paw")),
            ("hind", ("pelvis",), ("hip", "knee", "hock", "paw")),
        )
        for side in ("left", "right")
    ),
)
_HUMAN = (
    ("head_top", "head", "neck", "chest", "spine_mid", "pelvis"),
    ("head", "nose"),
    *(
        (root, *(f"{side}_{joint}" for joint in limb))
        for root, limb in (("chest", ("shoulder", "elbow", "wrist")), ("pelvis", ("hip", "knee", "ankle", "toe")))
        for side in ("left", "right")
    ),
)


def bones(names: tuple[str, ...]) -> list[tuple[int, int]]:
    """Pairs of key points to join by a line: of an animal or a human, leaving out what is not there."""
    out: dict[tuple[int, int], None] = {}
    for chain in _ANIMAL if "withers" in names else _HUMAN:
        present = [names.index(n) for n in chain if n in names]
        out |= dict.fromkeys(pairwise(present))
    return list(out)


def side_color(name: str) -> tuple[float, float, float]:
    """Left orange, right blue, middle grey."""
    return ORANGE if "left" in name else SKY_BLUE if "right" in name else (0.92, 0.92, 0.92)


class Panel(Protocol):
    """One cell of the video."""

    title: str

    def draw(self, t: float) -> np.ndarray:
        """(H, W, 3) uint8 RGB at time t (s) of the robot's motion."""
        ...


@dataclass(frozen=True)
class View:
    """A camera that follows a subject from one side.

    Attributes:
        t: (T,) s.  path: (T, 3) m, the subject, smoothed.
        azimuth: rad, from the subject to the camera, in the world.  extent: m, what must fit into the picture.
    """

    t: np.ndarray
    path: np.ndarray
    azimuth: float
    extent: float

    @classmethod
    def of(cls, t: np.ndarray, path: np.ndarray, *, low: float, high: float, azimuth: float, extent: float) -> "View":
        """Follow `path` (T, 3) without its shaking, at a constant height, so that `low` to `high` m are seen too."""
        smooth = gaussian_filter1d(path, 0.4 / float(np.median(np.diff(t))), axis=0, mode="nearest")
        smooth[:, 2] = (low + high) / 2
        return cls(t, smooth, azimuth, max(extent, 0.9 * (high - low) * SIZE[0] / SIZE[1]))

    def camera(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """K and T_world_cam at time t."""
        hfov = np.radians(38)
        distance = self.extent / (2 * np.tan(hfov / 2) * 0.80)
        target = np.array([np.interp(t, self.t, self.path[:, k]) for k in range(3)])
        up = np.radians(17)
        away = [np.cos(up) * np.cos(self.azimuth), np.cos(up) * np.sin(self.azimuth), np.sin(up)]
        return intrinsics(*SIZE, hfov=hfov), look_at(target + distance * np.array(away), target)


def studio(extent: float, azimuth: float) -> Light:
    """A light tiled floor under a sun that stands beside the camera."""
    a = azimuth + 0.7
    return Light(
        sun=(np.cos(a), np.sin(a), 1.6), sun_strength=0.95, ambient=0.55, ground="tiles",
        ground_scale=0.5 * extent, zenith=(0.80, 0.85, 0.90), horizon=(0.93, 0.94, 0.95), fog=14 * extent,
    )  # fmt: skip


class ClipPanel:
    """The source clip with the reconstructed key points over it.

    Args:
        frames: (T, H, W, 3) uint8.  frame_t: (T,) s.
        motion: key points in the world, with `K` (3, 3) px of the frames and `T_world_cam` (T, 4, 4).
        start: s, time of the clip at which the robot's motion begins.
    """

    title = "clip, reconstructed skeleton"

    def __init__(
        self,
        frames: np.ndarray,
        frame_t: np.ndarray,
        motion: KeypointMotion,
        *,
        K: np.ndarray,
        T_world_cam: np.ndarray,
        start: float,
    ):
        self.frames, self.frame_t, self.motion, self.start = frames, frame_t, motion, start
        x = np.einsum("tji,tnj->tni", T_world_cam[:, :3, :3], motion.positions - T_world_cam[:, None, :3, 3])
        self._uv = (x @ K.T)[..., :2] / np.maximum(x[..., 2:], 1e-6)
        self._bones = bones(motion.names)

    def draw(self, t: float) -> np.ndarray:
        t = t + self.start
        frame = self.frames[np.abs(self.frame_t - t).argmin()]
        scale = min(SIZE[0] / frame.shape[1], SIZE[1] / frame.shape[0])
        size = (round(scale * frame.shape[1]), round(scale * frame.shape[0]))
        left, top = (SIZE[0] - size[0]) // 2, (SIZE[1] - size[1]) // 2
        out = np.full((SIZE[1], SIZE[0], 3), 24, np.uint8)
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        out[top : top + size[1], left : left + size[0]] = cv2.resize(frame, size, interpolation=how)
        k = int(np.abs(self.motion.t - t).argmin())
        uv = scale * (self._uv[k] + 0.5) + [left, top]  # pixel centres are at integers
        seen = self.motion.confidence[k] > 0
        for i, j in self._bones:
            if seen[i] and seen[j] and np.abs(uv[[i, j]]).max() < 4 * SIZE[0]:
                a, b = (tuple(np.rint(16 * uv[m]).astype(int).tolist()) for m in (i, j))
                color = [round(255 * c) for c in side_color(self.motion.names[j])]
                cv2.line(out, a, b, (20, 20, 20), 4, cv2.LINE_AA, shift=4)
                cv2.line(out, a, b, color, 2, cv2.LINE_AA, shift=4)
        return out


class KeypointPanel:
    """The creature's key points in space.

    Args:
        motion: world, z up.  azimuth: rad, see `View`.  start: s, time of `motion` at which the robot's begins.
    """

    title = "key points in the world"

    def __init__(self, motion: KeypointMotion, *, azimuth: float, start: float):
        self.motion, self.start = motion, start
        p = motion.positions
        size = float(np.median(np.linalg.norm(np.ptp(p, axis=1), axis=-1)))
        self._radius = 0.012 * size
        self._bones = bones(motion.names)
        stick, ball = meshes.unit_stick(), meshes.unit_ball()
        parts = {
            f"{i}-{j}": Part(stick.vertices, stick.faces, np.array(side_color(motion.names[j]))) for i, j in self._bones
        } | {f"{i}": Part(ball.vertices, ball.faces, np.array(side_color(n))) for i, n in enumerate(motion.names)}
        self._scene = Scene(parts, studio(size, azimuth))
        low, high = np.percentile(p[..., 2], [1, 99])
        self._view = View.of(motion.t, p.mean(1), low=float(low), high=float(high), azimuth=azimuth, extent=size)

    def draw(self, t: float) -> np.ndarray:
        t = t + self.start
        p = self.motion.positions[np.abs(self.motion.t - t).argmin()]
        poses = {f"{i}-{j}": meshes.between(p[i], p[j], self._radius) for i, j in self._bones}
        self._scene.move(poses | {f"{i}": meshes.at(x, 1.5 * self._radius) for i, x in enumerate(p)})
        return self._scene.picture(*self._view.camera(t), SIZE)


def robot_extent(robot: Robot) -> float:
    """m, length of the standing robot with its legs at full stride."""
    return float(np.ptp(robot.nominal_hips[:, 0])) + 1.5 * robot.standing_height


def robot_view(t: np.ndarray, body: np.ndarray, robot: Robot, *, azimuth: float) -> View:
    """From the near feet to over the head at the body's (T, 7) highest, also where it stands on a step or rears."""
    hips = np.einsum("tij,cj->tci", Rotation.from_quat(body[:, 3:7]).as_matrix(), robot.nominal_hips)
    top = body[:, 2] + hips[..., 2].max(1).clip(min=0)
    body, high = body[:, :3], float(np.percentile(top, 99)) + 0.6 * robot.standing_height
    # Seen from above, feet nearer than the body lie lower in the picture than the ground under it.
    return View.of(t, body, low=-0.3 * robot.standing_height, high=high, azimuth=azimuth, extent=robot_extent(robot))


class ReferencePanel:
    """The optimised motion: the point-foot model and its contact forces.

    Args:
        hips: (C, 3) m, of the point-foot model, body frame.  weight: N, of the robot.
    """

    title = "reference: point-foot model, contact forces"

    def __init__(
        self, reference: Reference, robot: Robot, terrain: Terrain, *, hips: np.ndarray, weight: float, azimuth: float
    ):
        self.reference, self.hips = reference, hips
        extent = robot_extent(robot)
        self._arrow = 0.9 * extent / weight  # m/N: the whole weight on one foot is nearly the robot's length
        self._thick = 0.008 * extent
        self._rotations = Rotation.from_quat(reference.q[:, 3:7]).as_matrix()
        half = np.maximum(np.abs(hips).max(0), 0.04 * extent) * [1.1, 0.9, 1.0]
        body = trimesh.creation.box(2 * half)
        stick, ball, arrow = meshes.unit_stick(), meshes.unit_ball(), meshes.unit_arrow()
        parts = {"body": Part(body.vertices, body.faces, np.array(GREY), smooth=False)}
        for c, name in enumerate(robot.limb_names):
            color = np.array(side_color(name))
            parts |= {
                f"leg{c}": Part(stick.vertices, stick.faces, color),
                f"foot{c}": Part(ball.vertices, ball.faces, color),
            }
            parts[f"hip{c}"] = parts[f"foot{c}"]
            parts[f"force{c}"] = Part(arrow.vertices, arrow.faces, np.array(VERMILION), smooth=False)
        self._scene = Scene(parts | meshes.terrain_parts(terrain), studio(extent, azimuth))
        self._view = robot_view(reference.t, reference.q[:, :7], robot, azimuth=azimuth)

    def draw(self, t: float) -> np.ndarray:
        r = self.reference
        k = int(np.clip(np.searchsorted(r.t, t, side="right") - 1, 0, len(r.t) - 2))
        s = float(np.clip((t - r.t[k]) / (r.t[k + 1] - r.t[k]), 0, 1))
        p = (1 - s) * r.q[k, :3] + s * r.q[k + 1, :3]
        nearest = k + round(s)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._rotations[nearest], p
        hips, feet = self.hips @ T[:3, :3].T + p, (1 - s) * r.points[k] + s * r.points[k + 1]
        poses = {"body": T}
        for c, (hip, foot) in enumerate(zip(hips, feet, strict=True)):
            poses |= {
                f"leg{c}": meshes.between(hip, foot, 0.6 * self._thick),
                f"hip{c}": meshes.at(hip, 2 * self._thick),
                f"foot{c}": meshes.at(foot, 2 * self._thick),
            }
            force = self._arrow * r.lam[k, c]
            visible = np.linalg.norm(force) > 4 * self._thick
            tip = foot + force
            poses[f"force{c}"] = meshes.between(foot, tip, 1.2 * self._thick) if visible else meshes.at(hip, 1e-4)
        self._scene.move(poses)
        return self._scene.picture(*self._view.camera(t), SIZE)


class RobotPanel:
    """The whole robot in its roll-out, with its visual meshes."""

    def __init__(self, rollout: Rollout, robot: Robot, terrain: Terrain, *, azimuth: float, fell: bool):
        self.title = f"{robot.name} in simulation"
        self.rollout, self.robot, self.fell = rollout, robot, fell
        parts, self._links = meshes.robot_parts(robot)
        extent = robot_extent(robot)
        self._scene = Scene(parts | meshes.terrain_parts(terrain), studio(extent, azimuth))
        self._data = robot.model.createData()
        self._frames = {link: robot.model.getFrameId(link) for link in set(self._links.values())}
        self._view = robot_view(rollout.t, rollout.body, robot, azimuth=azimuth)

    def draw(self, t: float) -> np.ndarray:
        r = self.rollout
        if self.fell and t > r.t[-1]:
            self.title = f"{self.robot.name} in simulation: fell at {r.t[-1]:.2f} s"
        k = int(np.clip(np.searchsorted(r.t, t), 0, len(r.t) - 1))
        pin.framesForwardKinematics(self.robot.model, self._data, r.q[k])
        where = {link: self._data.oMf[i].homogeneous for link, i in self._frames.items()}
        self._scene.move({part: where[link] for part, link in self._links.items()})
        return self._scene.picture(*self._view.camera(min(t, float(r.t[-1]))), SIZE)


def heading(positions: Mapping[str, np.ndarray]) -> np.ndarray:
    """(T,) rad, world: where the creature looks, from the back of its trunk to the front. Args: name -> (T, 3)."""
    front = next((positions[n] for n in ("withers", "chest", "neck", "head") if n in positions), None)
    rear = next((positions[n] for n in ("pelvis", "tail_base", "spine_mid") if n in positions), None)
    if {"left_hip", "right_hip"} <= positions.keys():  # a person's trunk is upright: square to the hips
        across = positions["left_hip"] - positions["right_hip"]
        return np.arctan2(-across[:, 0], across[:, 1])
    if front is None or rear is None:
        return np.zeros(len(next(iter(positions.values()))))
    d = front - rear
    return np.arctan2(d[:, 1], d[:, 0])
