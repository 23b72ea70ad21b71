"""Report: what the robot does beside what the animal did, as a video, pictures and a table."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slomo.errors import InvalidData, UsageError
from slomo.formats.mp4 import encode_mp4
from slomo.gravity import GRAVITY
from slomo.motion import KeypointMotion, Reference, Rollout
from slomo.optimize.inverse import joint_motion
from slomo.pointfoot import PointFootModel
from slomo.report import table
from slomo.report.evidence import evidence_picture
from slomo.report.panels import ClipPanel, KeypointPanel, Panel, ReferencePanel, RobotPanel, heading
from slomo.report.plots import foot_heights
from slomo.report.plots_reference import contacts_and_torques
from slomo.report.video import Composer, FootFalls, contact_sheet, draw_all, png
from slomo.stage import Arrays, Artifact, Inputs, Progress
from slomo.synth.score import score
from slomo.terrain import Terrain

VERSION = 7


@dataclass(frozen=True)
class Config:
    """Parameters of `slomo report`.

    Attributes:
        fps: of the video, 1/s.  moments: columns of the contact sheet.  crf: H.264 quality, lower is better.
    """

    fps: float = 25.0
    moments: int = 6
    crf: int = 21


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`side_by_side.mp4`, `.png`, `foot_heights.png`, `contacts_and_torques.png`, `evidence.png` and `report.json`.

    Takes the artifacts of the whole line; "decode", "evidence" and "reconstruct" are absent when key points were
    imported, and then the video has no panel of a clip. `evidence.png` is left out where nobody said anything about the
    clip. With a `truth.npz` in `inputs.files["truth"]` the reconstruction is scored.

    Raises:
        UsageError: a parameter out of range.
        InvalidData: a mesh of the robot cannot be read, or a truth that does not fit.
    """
    if not (1 <= config.fps <= 120 and config.moments >= 2):
        raise UsageError("needs fps of 1 to 120 and at least 2 moments", where="report")
    robot, artifacts = inputs.robot, inputs.artifacts
    assert robot is not None
    source = artifacts["reconstruct" if "reconstruct" in artifacts else "import"].npz["keypoints.npz"]
    motion = KeypointMotion.from_arrays(source)
    retarget, optimize, track = (artifacts[k] for k in ("retarget", "optimize", "track"))
    reference = Reference.from_arrays(optimize.npz["reference.npz"])
    rollout = Rollout.from_arrays(track.npz["rollout.npz"])
    terrain = Terrain.from_json(optimize.json["terrain.json"])

    start = float(retarget.json["report.json"]["used_s"][0])
    azimuth = _azimuth(motion, source, start)
    turned = float(np.interp(start, motion.t, np.unwrap(heading(_paths(motion)))))
    # The robot starts at the origin and looks along x: seen from the same side as the creature.
    beside = azimuth - turned
    progress.update(0.0, "reading the robot's meshes")
    panels: list[Panel] = []
    if "decode" in artifacts and "T_world_cam" in source:
        frames = artifacts["decode"].npz["frames.npz"]
        camera = dict(K=_camera_matrix(source, motion), T_world_cam=np.asarray(source["T_world_cam"], float))
        panels.append(ClipPanel(frames["frames"], frames["t"], motion, **camera, start=start))
    panels.append(KeypointPanel(motion, azimuth=azimuth, start=start))
    model = PointFootModel.from_robot(robot)
    weight = robot.mass * GRAVITY
    panels.append(ReferencePanel(reference, robot, terrain, hips=model.hips, weight=weight, azimuth=beside))
    fell = bool(track.json["metrics.json"]["fell"])
    ground = Terrain.from_json(track.json["terrain.json"])
    panels.append(RobotPanel(rollout, robot, ground, azimuth=beside, fell=fell))

    duration = float(reference.t[-1])
    falls = FootFalls(
        robot.limb_names, reference.t[:-1], reference.lam[..., 2] > 1.0, rollout.t, rollout.lam[..., 2] > 1.0
    )
    composer = Composer(panels, falls, duration=duration)
    times = np.arange(0, duration, 1 / config.fps)
    chosen = set(np.linspace(0, len(times) - 1, config.moments).round().astype(int).tolist())
    kept: dict[int, list[np.ndarray]] = {}

    def composed():
        for i, pictures in enumerate(draw_all(panels, times)):
            if i in chosen:
                kept[i] = pictures
            progress.update(0.05 + 0.9 * i / len(times), f"video: frame {i + 1} of {len(times)}")
            yield composer.frame(float(times[i]), pictures)

    video = encode_mp4(composed(), config.fps, crf=config.crf, preset="veryfast")
    sheet = contact_sheet([p.title for p in panels], times[sorted(kept)], [kept[i] for i in sorted(kept)])
    progress.update(0.96, "plots")
    target = KeypointMotion.from_arrays(retarget.npz["keypoints.npz"])
    heights = foot_heights(target, reference, rollout, limbs=robot.limb_names, terrain=terrain, robot=robot.name)
    work = contacts_and_torques(target, reference, joint_motion(robot, reference), robot=robot, terrain=terrain)
    report = _report(inputs, motion, retarget.json["report.json"])
    for line in report["text"].splitlines():
        progress.note(line)
    blobs = {"side_by_side.mp4": video, "side_by_side.png": png(sheet), "foot_heights.png": heights}
    blobs["contacts_and_torques.png"] = work
    if "evidence" in artifacts:
        frames = artifacts["decode"].npz["frames.npz"]
        seen = evidence_picture(artifacts["evidence"].npz["evidence.npz"], frames["frames"], frames["t"])
        blobs |= {"evidence.png": seen} if seen else {}
    return Artifact(json={"report.json": report}, blobs=blobs)


def _paths(motion: KeypointMotion) -> dict[str, np.ndarray]:
    return {n: motion.positions[:, i] for i, n in enumerate(motion.names)}


def _camera_matrix(source: Arrays, motion: KeypointMotion) -> np.ndarray:
    K, T = np.asarray(source["K"], float), np.asarray(source["T_world_cam"])
    if K.shape != (3, 3) or len(T) != len(motion.t):
        raise InvalidData("K or T_world_cam does not fit the key points", where="keypoints.npz")
    return K


def _azimuth(motion: KeypointMotion, source: Arrays, start: float) -> float:
    """rad, world: from the creature to the clip's camera; without a clip three quarters from its left front."""
    if "T_world_cam" in source:
        away = (np.asarray(source["T_world_cam"])[:, :2, 3] - motion.positions[..., :2].mean(1)).mean(0)
        return float(np.arctan2(away[1], away[0]))
    return float(np.interp(start, motion.t, np.unwrap(heading(_paths(motion))))) + np.radians(65)


def _report(inputs: Inputs, motion: KeypointMotion, retarget: dict[str, Any]) -> dict[str, Any]:
    scored = None
    if "truth" in inputs.files:
        with np.load(inputs.files["truth"], allow_pickle=False) as z:
            scored = score(motion, dict(z))
    optimize = inputs.artifacts["optimize"].json["report.json"]
    track = inputs.artifacts["track"].json["metrics.json"]
    lines = table.rows(scored, retarget, optimize, track)
    return {
        "reconstruction": scored,
        "verified": optimize.get("verified"),
        "fell": track.get("fell"),
        "rows": lines,
        "text": table.as_text(lines),
    }
