"""The reconstruction as a stage: the coarse fit in, refined; metric key points and a report out."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from slomo.reconstruct.fit_stage import FitConfig, Prepared, one_thread, prepare
from slomo.reconstruct.outcome import Outcome, assess
from slomo.reconstruct.run import from_arrays
from slomo.stage import Artifact, Inputs, Progress

REFINE_VERSION = 2

# The rest pose at the right place overlaps by 0.5 to 0.6, a fit that is right by 0.75 and more. Below this the body is
# elsewhere or another shape in many frames, and its key points do not follow the subject.
MIN_IOU = 0.45


@dataclass(frozen=True)
class ReconstructConfig(FitConfig):
    """Parameters of the reconstruction: those of the fit, and of its refinement."""


def run_refine(inputs: Inputs, config: ReconstructConfig, progress: Progress) -> Artifact:
    """Refine the artifact "fit"; beside it, reads what `fit_stage.prepare` does.

    Returns:
        keypoints.npz and report.json; `failure` is set when the body hardly overlaps the masks.
    """
    began, cpu = time.perf_counter(), time.process_time()
    made = prepare(inputs, config)
    run = from_arrays(inputs.artifacts["fit"].npz["fit.npz"])
    with one_thread():
        outcome = assess(made.problem, run, made.metres)
    source = "length_m" if config.length_m else f"typical length of {made.skeleton.name}"
    progress.note(f"size: {made.metres:g} m from {source}; the video alone does not tell it")
    report: dict[str, Any] = outcome.report | {
        "skeleton": made.skeleton.name, "camera_mode": made.camera_mode, "length_m": made.metres,
        "scale_source": source, "evidence": made.evidence, "quality": config.quality,
        "seconds": round(time.perf_counter() - began, 1), "cpu_seconds": round(time.process_time() - cpu, 1),
    }  # fmt: skip
    iou = report["silhouette_iou"]
    failure = None
    if iou < MIN_IOU:
        failure = f"the fitted body covers the subject badly (IoU {iou:.2f}, needs {MIN_IOU}); look at the masks"
    return Artifact(npz={"keypoints.npz": _arrays(made, outcome)}, json={"report.json": report}, failure=failure)


def _arrays(made: Prepared, o: Outcome) -> dict[str, np.ndarray]:
    skeleton = made.skeleton
    return dict(
        t=made.problem.obs.t.numpy().astype(float), keypoints=o.keypoints, keypoint_names=np.array(o.names),
        confidence=o.confidence, contact=o.contact,
        contact_names=np.array([skeleton.names[c] for c in skeleton.contacts]),
        K=np.asarray(made.K, float), T_world_cam=o.T_world_cam, packed=made.masks["packed"], shape=made.masks["shape"],
    )  # fmt: skip
