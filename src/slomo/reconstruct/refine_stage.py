"""The reconstruction as a stage: the coarse fit in, refined; metric key points and a report out."""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from slomo.errors import StageFailed, UsageError
from slomo.mesh import SkinnedMesh
from slomo.packed import unpack
from slomo.reconstruct.body_colours import coloured_by_clip
from slomo.reconstruct.body_mesh import body_mesh, field_mesh
from slomo.reconstruct.descent import Plan, descend
from slomo.reconstruct.fields.background import colours
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.device import CPU, find, on
from slomo.reconstruct.fields.mesh import mesh
from slomo.reconstruct.fit_stage import FitConfig, Prepared, one_thread, prepare
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.outcome import Outcome, assess
from slomo.reconstruct.physics.learn import PhysicsConfig
from slomo.reconstruct.run import Run, from_arrays
from slomo.reconstruct.verdict import Facts, checks, verdict
from slomo.stage import Artifact, Inputs, Progress

REFINE_VERSION = 19
SHORT = 0.05  # body lengths, added to bones and the skeleton's own: by how much short ones change says little
TREMBLES = 0.1  # degrees of a camera's rotation, of which the user is told


@dataclass(frozen=True)
class ReconstructConfig(FitConfig):
    """Parameters of the reconstruction: those of the fit, and of its refinement.

    Attributes:
        fields: whether the neural model of the body is fitted.
        networks: its sizes: "small", or "published" (lab4d's, for a GPU; hours on a CPU, see docs/fields.md).
        physics: whether the motion is drawn towards a simulated one. Draft quality has neither.
        weight_colour, weight_opacity, weight_field_flow, weight_eikonal, weight_cycle, weight_background,
            weight_residual: of the terms of the fields. weight_physics: of the pull towards the simulated motion.
    """

    fields: bool = True
    networks: str = "small"
    physics: bool = True
    weight_colour: float = 0.3
    weight_opacity: float = 0.05
    weight_field_flow: float = 0.3
    weight_eikonal: float = 0.05
    weight_cycle: float = 0.01
    weight_background: float = 0.3
    weight_residual: float = 0.02
    weight_physics: float = 0.2

    def __post_init__(self):
        super().__post_init__()
        if self.networks not in NETWORKS:
            raise UsageError(f"no networks {self.networks!r}", where="networks", valid=NETWORKS)

    def plan(self) -> Plan:
        """What the refinement does at this quality."""
        done = PLANS[self.quality]
        fields = NETWORKS[self.networks]() if done.fields and self.fields else None
        return replace(done, fields=fields, physics=done.physics if self.physics else None)


NETWORKS = {"small": FieldsConfig, "published": FieldsConfig.published}
PLANS = {
    "draft": Plan(None, None),
    "normal": Plan(FieldsConfig(), PhysicsConfig(), appearance=100, joint=200, rounds=2, render=60),
    "high": Plan(FieldsConfig(), PhysicsConfig(), appearance=200, joint=900, rounds=4, render=100),
}


def run_refine(inputs: Inputs, config: ReconstructConfig, progress: Progress) -> Artifact:
    """Refine the artifact "fit"; beside it, reads what `fit_stage.prepare` does.

    Returns:
        keypoints.npz and report.json; `failure` says why when the verdict is that they are not usable.
    """
    began, cpu = time.perf_counter(), time.process_time()
    made = prepare(inputs, config)
    run = from_arrays(inputs.artifacts["fit"].npz["fit.npz"])
    plan = config.plan()
    device = device_of(config)
    frames = np.asarray(inputs.artifacts["decode"].npz["frames.npz"]["frames"])
    try:
        with one_thread():
            images = colours(frames, made.problem.obs) if plan.fields else None
            run = descend(
                made.problem, run, images, plan, metres=made.metres, seed=config.seed, progress=progress, device=device
            )
            outcome = assess(made.problem, run, made.metres)
            body = _mesh(made, run, outcome, plan.fields, frames, device)
    except torch.OutOfMemoryError as e:
        raise StageFailed(f"{device} has too little memory", where="networks", todo="take networks = small") from e
    source = "length_m" if config.length_m else f"typical length of {made.skeleton.name}"
    progress.note(f"size: {made.metres:g} m from {source}; the video alone does not tell it")
    tremble = _tremble(inputs.artifacts["camera"].npz["camera.npz"]["T_world_cam"], made.problem.obs.T_world_cam)
    if tremble > TREMBLES:
        progress.note(f"camera: its rotation trembles by {tremble:.2f} degrees, which the background's flow takes back")
    report: dict[str, Any] = outcome.report | {
        "skeleton": made.skeleton.name, "camera_mode": made.camera_mode, "length_m": made.metres,
        "scale_source": source, "evidence": made.evidence, "quality": config.quality, "device": str(device),
        "camera_tremble_deg": tremble,
        "seconds": round(time.perf_counter() - began, 1), "cpu_seconds": round(time.process_time() - cpu, 1),
    }  # fmt: skip
    report["verdict"] = found = verdict(checks(_facts(inputs, made, run, outcome)))
    progress.note(f"verdict: {found['trust']}; {found['text']}")
    failure = f"not usable: {found['text']}" if found["trust"] == "unusable" else None
    npz = {"keypoints.npz": _arrays(made, outcome), "mesh.npz": body.to_arrays()}
    return Artifact(npz=npz, json={"report.json": report}, failure=failure)


def device_of(config: ReconstructConfig) -> torch.device:
    """Where the fields are computed, where there are any.

    Raises:
        UsageError: as `find` does.
    """
    return find(large=config.networks == "published") if config.plan().fields else CPU


def _tremble(given: np.ndarray, steady: np.ndarray) -> float:
    """Degrees, root mean square of the turns between two paths (T, 4, 4) of a camera."""
    turns = Rotation.from_matrix(np.asarray(given, float)[:, :3, :3].swapaxes(1, 2) @ steady[:, :3, :3]).magnitude()
    return round(float(np.degrees(np.sqrt(np.mean(turns**2)))), 3)


def _facts(inputs: Inputs, made: Prepared, run: Run, outcome: Outcome) -> Facts:
    kin, unit = made.problem.kin, outcome.metres_per_unit
    shape = {k.removeprefix("shape."): v for k, v in run.x.items() if k.startswith("shape.")}
    own = shape["log_length"].exp()[0]
    return Facts(
        report=outcome.report,
        masks=inputs.artifacts["masks"].json["report.json"],
        camera=inputs.artifacts["camera"].json["report.json"],
        feet=outcome.body.nodes[0, :, list(made.skeleton.contacts)].numpy().astype(float) * unit,
        sole=made.skeleton.sole * float(own) * unit,
        t=made.problem.obs.t.numpy().astype(float),
        length=made.metres,
        stretch=stretch(kin, shape),
    )


def stretch(kin: Kinematics, shape: dict[str, torch.Tensor]) -> np.ndarray:
    """(M,) lengths of the bones of one hypothesis over the skeleton's own, the body's length taken off; of short ones
    less, and tails do not count: with a short one or a long one a body moves the same."""
    offset, rest = kin.offsets(shape)[0].norm(dim=-1), kin.offset.norm(dim=-1)
    ratio = (offset / shape["log_length"].exp()[0] + SHORT) / (rest + SHORT)
    names = kin.skeleton.group_names
    return ratio[torch.tensor([n < 0 or names[n] != "tail" for n in kin.skeleton.group])].numpy()


def _mesh(
    made: Prepared, run: Run, outcome: Outcome, fields: FieldsConfig | None, frames: np.ndarray, device: torch.device
) -> SkinnedMesh:
    """The surface of the field, or, where there is none, the skin of the capsules in the colours of the clip."""
    kin, t = made.problem.kin, made.problem.obs.t.numpy().astype(float)
    shape = {k.removeprefix("shape."): v for k, v in run.x.items() if k.startswith("shape.")}
    unit = outcome.metres_per_unit
    if fields:
        surface = mesh(on(run.x, device), fields, on(kin, device), on(shape, device))
        return field_mesh(surface, kin, shape, outcome.body, t, metres_per_unit=unit)
    skin = body_mesh(kin, shape, outcome.body, t, metres_per_unit=unit)
    masks = unpack(made.masks)
    return coloured_by_clip(skin, lambda k: frames[k], lambda k: masks[k], np.asarray(made.K), outcome.T_world_cam)


def _arrays(made: Prepared, o: Outcome) -> dict[str, np.ndarray]:
    skeleton = made.skeleton
    return dict(
        t=made.problem.obs.t.numpy().astype(float), keypoints=o.keypoints, keypoint_names=np.array(o.names),
        confidence=o.confidence, contact=o.contact,
        contact_names=np.array([skeleton.names[c] for c in skeleton.contacts]),
        K=np.asarray(made.K, float), T_world_cam=o.T_world_cam, packed=made.masks["packed"], shape=made.masks["shape"],
    )  # fmt: skip
