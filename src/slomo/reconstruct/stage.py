"""Parts of `reconstruct`, each cached on its own: masks and camera.

Inputs by name: files "weights" and "masks" (masks); artifacts "decode", "masks".
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from slomo.errors import InvalidData, UsageError
from slomo.packed import pack, unpack
from slomo.runs import runs
from slomo.stage import Artifact, Inputs, Progress

MASKS_VERSION = 27
CAMERA_VERSION = 12
QUALITIES = ("draft", "normal", "high")

SEGMENTERS = ("auto", "u2netp", "still", "motion", "user")
_LOST = 0.05  # part of the frames without the subject, from which on the other masks are taken
_SURE = 0.8  # mean quality over all frames, below which they are
_MISSED, _ELSE = 0.2, 0.05  # parts of the other masks that these do not have, and of these that the others do not


@dataclass(frozen=True)
class MasksConfig:
    """How the subject is found.

    Attributes:
        segmenter: "auto" (the user's masks when given, else u2netp when its weights are at hand, else motion; before a
            camera that stands still "still" where those find nothing or too little), "u2netp", "still", "motion" or
            "user".
        quality: that of [reconstruct] unless it is set here.
        network_every: the network runs on every n-th frame; flow fills the frames between. 0: every frame, every fourth
            at draft quality.
        subject_at: (u, v) or (u, v, s), a pixel of the upright clip on the subject, and when; without a time, in the
            first frame used. Empty: the largest.
        subject_box: (u0, v0, u1, v1) or with a time, a box around it instead.
    """

    segmenter: str = "auto"
    quality: str = "normal"
    network_every: int = 0
    subject_at: tuple[float, ...] = ()
    subject_box: tuple[float, ...] = ()


@dataclass(frozen=True)
class CameraConfig:
    """How the camera is found.

    Attributes:
        fov_deg: degrees, horizontal field of view; 0 means unknown: taken from the clip's metadata where there is one,
            else `default_fov_deg`, and refined where the motion shows it. A given one is kept.
        default_fov_deg: degrees, along the frames' longer side, where nothing else is known: between phones (55 to 65)
            and what was zoomed in.
        quality: that of [reconstruct] unless it is set here.
        key_every: every n-th frame goes through structure from motion; fewer do of a clip that has more than 120 such.
            0: every third, every sixth at draft quality.
        features: features a key frame.
        overlap: key frames with which each is matched.
        seed: of every random choice.
    """

    fov_deg: float = 0.0
    default_fov_deg: float = 53.0
    quality: str = "normal"
    key_every: int = 0
    features: int = 1200
    overlap: int = 5
    seed: int = 0

    def __post_init__(self):
        counts = (("key_every", 0, 10**6), ("features", 1, 10**5), ("overlap", 1, 10**3), ("seed", 0, 2**31 - 1))
        for name, least, most in (*counts, ("fov_deg", 1, 170), ("default_fov_deg", 1, 170)):
            value = getattr(self, name)
            if not (least <= value <= most or (value == 0 and name == "fov_deg")):
                raise UsageError(f"is {value}", where=f"camera.{name}", valid=[f"{least} to {most}"])


def run_masks(inputs: Inputs, config: MasksConfig, progress: Progress) -> Artifact:
    """Find the subject: `masks.npz`, `flow.npz`, `report.json`.

    Raises:
        InvalidData: no subject is found, the user's masks do not fit, or the weights cannot be loaded.
        UsageError: unknown segmenter, what it needs was not given, or a subject is chosen where there can be none.
    """
    from slomo.reconstruct.flow import dense_flow
    from slomo.reconstruct.instances import choose
    from slomo.reconstruct.segment import frame_quality
    from slomo.reconstruct.subject_flow import closer

    decoded = inputs.artifacts["decode"]
    frames = decoded.npz["frames.npz"]["frames"]
    choice = choose(config.subject_at, config.subject_box, decoded.json.get("video.json", {}), len(frames))
    segmenter = _segmenter(inputs, config, choice)
    flow = dense_flow(frames, lambda f: progress.update(0.25 * f, "optical flow"))
    segmenter, found = _segmented(segmenter, config, choice, frames, flow, progress)
    progress.note(f"masks: segmenter {segmenter.name}")
    if segmenter.name == "motion" and config.segmenter == "auto":
        progress.note("masks: by motion alone, which takes shadows and more for the subject: run `slomo weights fetch`")
    quality = frame_quality(found.masks, flow, found.certainty)
    seen = np.asarray(found.masks.any((1, 2)))
    own = closer(frames, found.masks, lambda f: progress.update(0.95 + 0.05 * f, "the subject's optical flow"))
    report = {
        "segmenter": segmenter.name,
        "quality_mean": float(quality[seen].mean()),
        "quality_min": float(quality[seen].min()),
        "quality_poor_frames": int((quality[seen] < 0.7).sum()),
        "area_mean": float(found.masks.mean()),
        "frames_without_subject": int((~seen).sum()),
        "spans_without_subject": [[first, end - 1] for first, end in runs(~seen)],
        "flow_consistent": float(flow.consistent.mean()),
    } | found.report
    if found.report.get("instances", 1) > 1 and choice.how == "largest":
        progress.note("masks: several subjects are seen, the largest is taken (choose with --subject-at U,V)")
    if not seen.all():
        progress.note(f"masks: no subject in {int((~seen).sum())} of {len(seen)} frames, they are bridged")
    if quality[seen].mean() < 0.6:
        progress.note(f"masks: poor (quality {quality[seen].mean():.2f}); look at them, or give your own with --masks")
    return Artifact(
        npz={
            "masks.npz": {**pack(found.masks), "quality": quality.astype(np.float32)},
            "flow.npz": {"flow": flow.forward, "consistent": pack(flow.consistent)["packed"], **own},
        },
        json={"report.json": report},
    )


def run_camera(inputs: Inputs, config: CameraConfig, progress: Progress) -> Artifact:
    """Camera and ground: `camera.npz` (K (3, 3), T_world_cam (T, 4, 4)) and `report.json`.

    Raises:
        StageFailed: structure from motion died.
    """
    from slomo.reconstruct.camera import estimate_camera
    from slomo.reconstruct.camera_world import CameraSettings

    decoded = inputs.artifacts["decode"]
    frames, t = decoded.npz["frames.npz"]["frames"], decoded.npz["frames.npz"]["t"]
    masks = unpack(inputs.artifacts["masks"].npz["masks.npz"])
    every = 6 if _draft("camera", config.quality) else 3
    focal, share, source = _focal(config, decoded.json["video.json"].get("focal_px_hint", 0.0), frames.shape[1:3])
    settings = CameraSettings(
        focal=focal,
        focal_std=share * focal,
        refine_focal=not config.fov_deg,
        key_every=config.key_every or every,
        features=config.features,
        overlap=config.overlap,
        seed=config.seed,
    )
    path = estimate_camera(frames, masks, t, settings, progress)
    report = path.report | {"focal_source": "refined" if path.report["focal_observed"] else source}
    return Artifact(npz={"camera.npz": {"K": path.K, "T_world_cam": path.T_world_cam}}, json={"report.json": report})


def _draft(stage: str, quality: str) -> bool:
    """Whether a stage works at draft quality. Raises `UsageError` for a quality that there is not."""
    if quality not in QUALITIES:
        raise UsageError(f"quality is {quality!r}", where=f"{stage}.quality", valid=QUALITIES)
    return quality == "draft"


def _focal(config: CameraConfig, hint: float, size: tuple[int, int]) -> tuple[float, float, str]:
    """Focal length (px) to begin with, its standard deviation relative to it, and where it comes from."""
    if config.fov_deg:
        return 0.5 * size[1] / float(np.tan(0.5 * np.radians(config.fov_deg))), 0.0, "given"
    if hint:
        return hint, 0.05, "the clip's metadata"
    return 0.5 * max(size) / float(np.tan(0.5 * np.radians(config.default_fov_deg))), 0.2, "default"


def _segmented(segmenter, config: MasksConfig, choice, frames: np.ndarray, flow, progress: Progress):
    """The segmenter whose masks are taken, and its masks.

    Before a camera that stands still, "auto" looks at what differs from the picture without the subject as well, and
    takes that where the other finds nobody, loses the subject or is not sure of it, or has a part of what differs and
    hardly anything else: networks miss what is small, and legs or a head of another colour.
    """
    from slomo.reconstruct.segment import frame_quality
    from slomo.reconstruct.still_segment import StillSegmenter, stands_still

    report = lambda f: progress.update(0.25 + 0.7 * f, f"masks ({segmenter.name})")  # noqa: E731
    if config.segmenter != "auto" or segmenter.name == "user" or not stands_still(flow):
        return segmenter, segmenter.segment(frames, flow, report)
    still, other = StillSegmenter(choice), None
    with suppress(InvalidData):
        other = still.segment(frames, flow, lambda f: progress.update(0.25 + 0.1 * f, "masks (still)"))
    if other is None:  # not where it is caught: the error holds arrays as large as the frames
        return segmenter, segmenter.segment(frames, flow, report)
    if segmenter.name == "motion":
        return still, other
    try:
        found = segmenter.segment(frames, flow, report)
    except InvalidData:
        return still, other
    lost = other.masks.any((1, 2)) & ~found.masks.any((1, 2))
    sure = frame_quality(found.masks, flow, found.certainty).mean()
    part = (found.masks & other.masks).sum() / np.array([found.masks.sum(), other.masks.sum()])
    missed = part[0] > 1 - _ELSE and part[1] < 1 - _MISSED
    return (still, other) if lost.mean() > _LOST or sure < _SURE or missed else (segmenter, found)


def _segmenter(inputs: Inputs, config: MasksConfig, choice):
    """The segmenter that the configuration and the files at hand decide on."""
    name, every = config.segmenter, 4 if _draft("masks", config.quality) else 1
    if name not in SEGMENTERS:
        raise UsageError(f"unknown segmenter {name!r}", where="masks.segmenter", valid=SEGMENTERS)
    if name == "auto":
        name = "user" if "masks" in inputs.files else "u2netp" if "weights" in inputs.files else "motion"
    if name == "user":
        from slomo.reconstruct.user_masks import UserMasks

        if "masks" not in inputs.files:
            raise UsageError("no masks were given", where="masks.segmenter", todo="add --masks DIR")
        if choice.how != "largest":
            raise UsageError("your own masks say who the subject is", where="--subject-at, --subject-box")
        return UserMasks(inputs.files["masks"])
    if name == "u2netp":
        from slomo.reconstruct.saliency import SaliencySegmenter
        from slomo.reconstruct.u2net import WEIGHTS_VARIABLE, U2Net

        if "weights" not in inputs.files:
            raise UsageError(
                "the weights of u2netp are not at hand",
                where="masks.segmenter",
                todo=f"set {WEIGHTS_VARIABLE} to their path, or use --segmenter motion",
            )
        every = max(1, config.network_every or every)
        return SaliencySegmenter(U2Net(inputs.files["weights"]), choice, every=every)
    if name == "still":
        from slomo.reconstruct.still_segment import StillSegmenter

        return StillSegmenter(choice)
    from slomo.reconstruct.motion_segment import MotionSegmenter

    return MotionSegmenter(choice)
