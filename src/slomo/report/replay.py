"""One trial again, to be looked at: its roll-out and a video beside the reference."""

from dataclasses import dataclass

import numpy as np

from slomo.errors import UsageError
from slomo.formats.mp4 import encode_mp4
from slomo.gravity import GRAVITY
from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.report.panels import Panel, ReferencePanel, RobotPanel
from slomo.report.video import Composer, FootFalls, draw_all
from slomo.stage import Artifact, Inputs, Progress
from slomo.terrain import Terrain
from slomo.track import config as track
from slomo.track.stage import check_robot, reference_digest
from slomo.track.trial import make_world, parse_trial, run_trial

VERSION = 1
FPS = 25.0  # 1/s
AZIMUTH = np.radians(65)  # the camera's, from the body: three quarters from its left front


@dataclass(frozen=True)
class Config(track.Config):
    """Parameters of `slomo track --replay`, beside those of `slomo track`.

    Attributes:
        trial: row and number, as "push-12/7".  seed: of all trials.
    """

    trial: str = ""
    seed: int = 0


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`rollout.npz`, `replay.mp4` and `trial.json` of one trial, the same to the last bit as among the others.

    Raises:
        UsageError: no such trial, or a parameter out of range.
        MissingInput: the reference was made for another robot.
    """
    track.check(config)
    row, number = parse_trial(config.trial)
    robot, upstream = inputs.robot, inputs.artifacts["optimize"]
    assert robot is not None
    arrays = upstream.npz["reference.npz"]
    reference, terrain = Reference.from_arrays(arrays), Terrain.from_json(upstream.json["terrain.json"])
    check_robot(reference, robot)
    world = make_world(row, number, seed=config.seed, reference=reference, terrain=terrain)
    found = run_trial(
        row, number, seed=config.seed, robot=robot, reference=reference, terrain=terrain, config=config,
        progress=progress, reference_digest=reference_digest(arrays),
    )  # fmt: skip
    if found is None or world is None:
        raise UsageError("this motion has no place for a step: no foot lands anywhere else", where=config.trial)
    result, outcome = found
    progress.note(f"{config.trial}: {result.about}: {result.fall or 'no fall'}")

    r = outcome.rollout
    hips, weight = PointFootModel.from_robot(robot).hips, robot.mass * GRAVITY
    seen = RobotPanel(r, robot, world.disturbance.ground(world.ground), azimuth=AZIMUTH, fell=result.fall is not None)
    panels: list[Panel] = [ReferencePanel(reference, robot, terrain, hips=hips, weight=weight, azimuth=AZIMUTH), seen]
    last = float(reference.t[-1])
    falls = FootFalls(robot.limb_names, reference.t[:-1], reference.lam[..., 2] > 1.0, r.t, r.lam[..., 2] > 1.0)
    composer = Composer(panels, falls, duration=last)
    times = np.arange(0, last, 1 / FPS)
    pictures = (composer.frame(float(t), p) for t, p in zip(times, draw_all(panels, times), strict=True))
    return Artifact(
        npz={"rollout.npz": r.to_arrays()},
        json={"trial.json": vars(result)},
        blobs={"replay.mp4": encode_mp4(pictures, FPS, preset="veryfast")},
    )
