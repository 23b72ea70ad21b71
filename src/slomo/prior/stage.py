"""Evidence as a stage: what networks, models and the user say about the frames of a clip, for the fit to weigh."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slomo.errors import InvalidData, UsageError
from slomo.ground_path import ground_path, mask_box
from slomo.packed import unpack
from slomo.pinhole import Intrinsics
from slomo.prior.crop import crop_box
from slomo.prior.evidence import GRID, Columns, Dense, Shots, from_model, from_network, from_user
from slomo.prior.external import ExternalModel, load_map
from slomo.prior.frames import Motion, every
from slomo.prior.inference import Prior, packaged
from slomo.prior.kind import kind_of
from slomo.prior.labels import BINS, Labels, labels
from slomo.prior.travel import view_of_travel
from slomo.prior.user_keypoints import load_user_keypoints, to_decoded
from slomo.skeleton import AUTO, USUAL, Skeleton, list_skeletons, load_skeleton
from slomo.stage import Artifact, Inputs, Progress

Array = np.ndarray

VERSION = 10
MOST_FRAMES = 600  # that are looked at: each takes 3 MB, and long clips are not to take more than others

PRIORS = ("auto", "none")


@dataclass(frozen=True)
class Config:
    """What is asked.

    Attributes:
        prior: "auto" (the file inputs.prior, else the network that comes with slomo for this kind of skeleton, if any)
            or "none".
        skeleton: that of the fit, [reconstruct] skeleton, unless set here; "auto": told from the clip by slomo's own
            networks, or by what inputs.prior was trained for, "quadruped" where neither is asked.
        fps: frames a second at most; that of the fit, [reconstruct] fps, unless set here.
    """

    prior: str = "auto"
    skeleton: str = "auto"
    fps: float = 30.0

    def __post_init__(self):
        if self.prior not in PRIORS:
            todo = "a file of your own goes into inputs.prior (--prior FILE)"
            raise UsageError(f"unknown prior {self.prior!r}", where="evidence.prior", valid=PRIORS, todo=todo)
        if not self.fps > 0:
            raise UsageError(f"is {self.fps}", where="evidence.fps", valid=["more than 0"])


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """Look at the clip.

    Reads the artifacts "decode" (frames.npz, video.json), "masks" (masks.npz, flow.npz) and "camera" (camera.npz), and
    the files "prior" (a network of slomo's), "keypoints2d", "keypoint_model" with "keypoint_map", and "skeleton",
    where they are given.

    Returns:
        `evidence.npz`, over F frames; what nobody spoke about has no frames, and nothing has any when nobody spoke:
        frame (F,) decoded frames; box (F, 3) px, left and top edge and side of the crops; view (F, 36) probabilities of
        the azimuth's bins, view_up (F, 3) and view_path (F,) rad, see `prior.labels`; keypoint_names (N,), keypoints
        (F, N, 2) px, keypoint_confidence (F, N) in [0, 1] and keypoint_side (N,), the probability that it is not on the
        other limb of its pair; part_names (P,), part_side, the same of a pixel, parts (F, P+1, 64, 64) uint8,
        probability * 255, background first; surface (F, 3, 64, 64) and surface_scale (F, 64, 64) body lengths.
        `report.json`: which sources spoke, and how sure they are.

    Raises:
        InvalidData: a given file cannot be used, or does not fit the skeleton.
        UsageError: unknown skeleton, or a model without its mapping.
    """
    shots = _shots(inputs, config.fps)
    skeleton, clear = _skeleton(inputs, config, shots, progress)
    known = labels(skeleton)
    shots = replace(shots, travel=_travel(inputs, shots, known.kind))
    prior = _prior(inputs, config, known, progress)
    files = inputs.files
    if ("keypoint_model" in files) != ("keypoint_map" in files):
        given, lacking = ("model", "map") if "keypoint_model" in files else ("map", "model")
        raise UsageError(f"needs --keypoint-{lacking} too", where=f"--keypoint-{given}")
    user = load_user_keypoints(files["keypoints2d"], known.keypoints) if "keypoints2d" in files else None
    model = None
    if "keypoint_model" in files:
        model = ExternalModel(files["keypoint_model"], load_map(files["keypoint_map"], known.keypoints))

    report: dict[str, Any] = {
        "skeleton": skeleton.name,
        "seen_as": clear,
        "prior": "none",
        "weights_sha256": None,
        "sources": {},
    }
    columns: dict[str, Columns] = {}
    dense: Dense | None = None
    if prior and len(shots.index):
        report |= {"prior": _name(prior, known), "weights_sha256": prior.digest}
        columns["prior"], dense, said = from_network(
            prior, skeleton, known, shots, lambda x: progress.update(0.7 * x, "network")
        )
        report["sources"]["prior"] = said
        if said["view_certainty"] < 0.5:
            progress.note(f"evidence: from which side the subject is seen is in doubt ({said['view_certainty']:.2f})")
    if model and len(shots.index):
        columns["keypoint_model"], report["sources"]["keypoint_model"] = from_model(
            model, skeleton, known, shots, dense, lambda x: progress.update(0.7 + 0.25 * x, "key-point model")
        )
    if user and len(shots.index):
        frame, places = to_decoded(user, inputs.artifacts["decode"].json["video.json"], where=files["keypoints2d"])
        columns["keypoints2d"], said = from_user(user, frame, places, shots)
        report["sources"]["keypoints2d"] = said
        if said["frames_unused"]:
            progress.note(
                f"evidence: {said['frames_unused']} of {said['frames_given']} frames of --keypoints2d are not used: "
                "they are outside the part of the clip that is reconstructed, or show no subject"
            )
    for name, source in columns.items():
        spoken = source.confidence[source.confidence > 0]
        report["sources"][name]["mean_confidence"] = float(spoken.mean()) if spoken.size else 0.0
    report["frames"] = len(shots.index) if columns else 0
    return Artifact(npz={"evidence.npz": _arrays(shots, known, columns, dense)}, json={"report.json": report})


def _skeleton(inputs: Inputs, config: Config, shots: Shots, progress: Progress) -> tuple[Skeleton, dict[str, float]]:
    """The user's, or that of what the clip shows, and how clearly it is seen as each kind if that was asked."""
    named = inputs.files.get("skeleton", config.skeleton)
    if named != AUTO:
        return load_skeleton(named), {}
    prior = inputs.files.get("prior")
    if config.prior == "none" or prior is None:
        progress.note(f"evidence: skeleton {USUAL} (nobody is asked; --skeleton human for a person)")
        return load_skeleton(USUAL), {}
    if not prior.is_dir():
        kind = Prior(prior).kind
        return load_skeleton(kind if kind in list_skeletons() else USUAL), {}
    kind, clear = kind_of(prior, shots)
    told = ", ".join(f"{name} {value:.2f}" for name, value in clear.items())
    progress.note(f"evidence: skeleton {kind} (how clearly key points are seen: {told}; --skeleton takes another)")
    return load_skeleton(kind), clear


def _prior(inputs: Inputs, config: Config, known: Labels, progress: Progress) -> Prior | None:
    """The network to ask, or None, which is said."""
    path = inputs.files.get("prior")
    if config.prior == "none":
        progress.note("evidence: no prior")
        return None
    if path and path.is_dir():
        path = path / f"{known.kind}.onnx"
    if path is None:
        progress.note(
            f"evidence: no prior, slomo has none for a skeleton of kind {known.kind!r} (name your own: --prior FILE)"
        )
        return None
    prior = Prior(path)
    if why := prior.misfit(known):
        if path != packaged(known.kind):
            raise InvalidData(why, where=path, todo="give a network of this skeleton, or --prior none")
        progress.note(f"evidence: no prior, slomo's own does not fit the skeleton: {why}")
        return None
    progress.note(f"evidence: prior {_name(prior, known)}")
    return prior


def _name(prior: Prior, known: Labels) -> str:
    return f"{known.kind} (packaged)" if prior.path == packaged(known.kind) else f"{known.kind} ({prior.path.name})"


def _shots(inputs: Inputs, fps: float) -> Shots:
    """The frames to look at: every n-th, fewer of a long clip, those without a subject left out. The way of travel
    says nothing yet."""
    decode, masks = inputs.artifacts["decode"].npz["frames.npz"], inputs.artifacts["masks"].npz
    packed = masks["masks.npz"]
    t = np.asarray(decode["t"], float)
    full = unpack(packed)
    index = np.arange(0, len(t), max(every(t, fps), -(-len(t) // MOST_FRAMES)))
    index = index[full[index].any((1, 2))]
    return Shots(
        index=index,
        t=t[index],
        box=np.array([crop_box(full[f]) for f in index], float).reshape(-1, 3),
        quality=np.asarray(packed["quality"], float)[index],
        frames=decode["frames"],
        masks=full,
        motion=Motion(masks["flow.npz"]["flow"], full, t),
        travel=np.full((len(index), BINS), 1 / BINS, np.float32),
    )


def _travel(inputs: Inputs, shots: Shots, kind: str) -> Array:
    """(F, 36) the view by the subject's path on the ground."""
    if len(shots.index) < 3:  # too few for a path
        return shots.travel
    camera, t = inputs.artifacts["camera"].npz["camera.npz"], inputs.artifacts["decode"].npz["frames.npz"]["t"]
    masks = shots.masks[shots.index]
    F, height, width = masks.shape
    f, T_world_cam = (np.asarray(camera[name], float) for name in ("K", "T_world_cam"))
    K = Intrinsics(f[0, 0], f[1, 1], f[0, 2], f[1, 2], width, height)
    box = np.array([mask_box(m) for m in masks], float)
    t = np.asarray(t, float)
    path = ground_path(t, shots.index, K, T_world_cam, box, quality=shots.quality, empty=np.zeros(F, bool))
    return view_of_travel(path, t, shots.index, T_world_cam, kind)


def _arrays(shots: Shots, known: Labels, columns: dict[str, Columns], dense: Dense | None) -> dict[str, Array]:
    F = len(shots.index) if columns else 0
    sources = list(columns.values())
    P = len(known.parts)
    nothing = {
        "part_side": np.float32(1.0),
        "view": np.zeros((0, BINS), np.float32),
        "view_up": np.zeros((0, 3), np.float32),
        "view_path": np.zeros(0, np.float32),
        "parts": np.zeros((0, P + 1, GRID, GRID), np.uint8),
        "surface": np.zeros((0, 3, GRID, GRID), np.float16),
        "surface_scale": np.zeros((0, GRID, GRID), np.float16),
    }
    return {
        "frame": shots.index[:F],
        "box": shots.box[:F].astype(np.float32),
        "keypoint_names": np.array([n for s in sources for n in s.names], dtype=str),
        "keypoints": np.concatenate([np.zeros((F, 0, 2), np.float32), *(s.places for s in sources)], 1),
        "keypoint_confidence": np.concatenate([np.zeros((F, 0), np.float32), *(s.confidence for s in sources)], 1),
        "keypoint_side": np.array([s.side for s in sources for _ in s.names], np.float32),
        "part_names": np.array(known.parts),
        **(dense.arrays if dense else nothing),
    }
