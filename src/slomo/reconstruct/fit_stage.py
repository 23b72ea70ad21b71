"""The coarse fit as a stage: artifacts of decode, masks, camera and evidence in, the best hypothesis out."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from slomo.errors import UsageError
from slomo.reconstruct import chunks, evidence_terms, hypotheses, losses, seams
from slomo.reconstruct import fit as fitting
from slomo.reconstruct.evidence import Evidence, gather
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.observations import Observations, observe
from slomo.reconstruct.problem import Problem, Schedule
from slomo.reconstruct.run import Run, as_arrays
from slomo.reconstruct.trajectory import Trajectory
from slomo.skeleton import AUTO, USUAL, Skeleton, list_skeletons, load_skeleton
from slomo.stage import Artifact, Inputs, Progress

FIT_VERSION = 48

AGAIN = 0.5  # share of the rates with which the winner is fitted once more, beside one with other limbs
POLISH = 0.4  # share of the rates with which the chunks of a long clip are polished together

# Of each of the fit's phases.
ITERATIONS = {"draft": (50, 50, 60, 120, 0), "normal": (100, 120, 150, 300, 100), "high": (150, 200, 300, 450, 150)}


@dataclass(frozen=True)
class FitConfig:
    """Parameters of the fit.

    Attributes:
        skeleton: "auto" (what the clip shows), "quadruped" or "human"; a file of your own is `inputs.skeleton`.
        length_m: m, withers to tail base of a quadruped, standing height of a human; 0: the skeleton's typical length.
        seed: of every random choice.
        fps: fit frames a second at most. subject_px: size of the subject in working pixels (root of its area).
        width: neurons of the hidden layers of Q and G. joint_hz, root_hz: highest frequency of their time features.
        quality: draft, normal or high: how long it works on it.
        iterations: of the heading, gait, rivals, final and limbs phase (the phase alike has those of limbs, overtaking
            and the other pair those of final, where limbs has any); none: as the quality says.
        candidates: hypotheses that are fitted in the gait phase, at least one without a gait for each heading that is
            left (one or two); gait_phases: phases tried of each gait.
        tilt_moving_deg, tilt_static_deg: s.d. of the given gravity for a camera that moved, and for one that did not.
        weight_*: of the evidence; 0 switches a term off. `facing`, `upright` and `short` (arms) are for people only,
            `upright` and `crossed` (legs) count from the phase limbs on; `view`, `keypoints`, `parts` and `surface` are
            what networks and the user say, where they say anything.
    """

    skeleton: str = "auto"
    length_m: float = 0.0
    seed: int = 0
    fps: float = 30.0
    subject_px: float = 56.0
    width: int = 64
    joint_hz: float = 8.0
    root_hz: float = 2.5
    quality: str = "normal"
    iterations: tuple[int, ...] = ()
    candidates: int = 10
    gait_phases: int = 12
    tilt_moving_deg: float = 0.7
    tilt_static_deg: float = 4.0
    weight_mask: float = 1.0
    weight_reach: float = 0.6
    weight_flow: float = 0.8
    weight_stance: float = 0.5
    weight_ground: float = 0.3
    weight_limits: float = 0.1
    weight_smooth: float = 0.03
    weight_forward: float = 0.25
    weight_balance: float = 0.01
    weight_prior: float = 0.05
    weight_facing: float = 0.012
    weight_crossed: float = 0.03
    weight_upright: float = 0.005
    weight_short: float = 0.05
    weight_view: float = 0.05
    weight_keypoints: float = 0.5
    weight_parts: float = 0.25
    weight_surface: float = 0.25

    def __post_init__(self):
        if self.length_m < 0:
            raise UsageError("must be 0 (typical) or a length in m", where="length_m", valid=["0", "0.2 ... 3"])
        if self.quality not in ITERATIONS:
            raise UsageError(f"quality is {self.quality!r}", where="quality", valid=ITERATIONS)
        if self.iterations and len(self.iterations) != fitting.LIMBS + 1:
            raise UsageError(
                "needs one number for each phase", where="iterations", valid=fitting.PHASES[: fitting.LIMBS + 1]
            )
        if self.iterations and (min(self.iterations) < 0 or max(self.iterations) == 0):
            raise UsageError("needs numbers of at least 0, one of them more", where="iterations")
        if self.skeleton not in (AUTO, *list_skeletons()):
            raise UsageError(
                f"no skeleton {self.skeleton!r}", where="skeleton", valid=(AUTO, *list_skeletons()),
                todo="a file of your own is --skeleton PATH",
            )  # fmt: skip
        least = dict(fps=1, subject_px=8, width=1, joint_hz=0.1, root_hz=0.1, candidates=1, gait_phases=1, seed=0)
        least |= dict(tilt_moving_deg=1e-3, tilt_static_deg=1e-3)
        for name, x in (least | {k: 0 for k in vars(self) if k.startswith("weight_")}).items():
            if not getattr(self, name) >= x:
                raise UsageError(f"is {getattr(self, name)}, needs at least {x:g}", where=name)

    def weights(self) -> dict[str, float]:
        return {k.removeprefix("weight_"): v for k, v in vars(self).items() if k.startswith("weight_")}


@dataclass(frozen=True)
class Prepared:
    """What `fit` and `reconstruct` both start from.

    Attributes:
        metres: wanted body length. camera_mode: as the camera stage named it.
    """

    skeleton: Skeleton
    problem: Problem
    metres: float
    camera_mode: str
    masks: Any
    K: np.ndarray

    @property
    def evidence(self) -> list[str]:
        """What networks and the user say anything of."""
        return list(self.problem.said.groups) if self.problem.said else []


def prepare(inputs: Inputs, config: FitConfig) -> Prepared:
    """The problem of a clip.

    Reads the artifacts "decode" (frames.npz: t), "masks" (masks.npz, flow.npz), "camera" (camera.npz, report.json) and,
    where there is one, "evidence" (evidence.npz), and the file "skeleton" where the user gave one.
    """
    skeleton = load_skeleton(_named(inputs, config))
    decode, masks, camera = (inputs.artifacts[k] for k in ("decode", "masks", "camera"))
    mode = camera.json["report.json"]["mode"]
    obs = observe(
        np.asarray(decode.npz["frames.npz"]["t"], float),
        masks.npz["masks.npz"],
        masks.npz["flow.npz"],
        camera.npz["camera.npz"],
        fps=config.fps,
        subject_px=config.subject_px,
    )
    kin = Kinematics(skeleton)
    path = _path(obs.t, kin, config)
    spread = np.radians(config.tilt_moving_deg if mode == "moving" else config.tilt_static_deg)
    weights = config.weights()
    said = _evidence(inputs, obs, skeleton, weights)
    if skeleton.kind != "human":
        weights["facing"] = weights["upright"] = weights["short"] = 0.0
    terms = {**losses.TERMS, **(evidence_terms.terms(said) if said else {})}
    problem = Problem(obs, kin, path, weights, float(spread), terms, said)
    metres = config.length_m or skeleton.typical_length
    return Prepared(skeleton, problem, metres, mode, masks.npz["masks.npz"], camera.npz["camera.npz"]["K"])


def _path(t: torch.Tensor, kin: Kinematics, config: FitConfig) -> Trajectory:
    return Trajectory(t, kin.B, joint_hz=config.joint_hz, root_hz=config.root_hz, width=config.width)


def run_fit(inputs: Inputs, config: FitConfig, progress: Progress) -> Artifact:
    """Fit the skeleton to masks and flow; reads what `prepare` does.

    Returns:
        fit.npz, the winner's variables (`run.from_arrays` reads them), and report.json with every hypothesis.
    """
    began, cpu = time.perf_counter(), time.process_time()
    made = prepare(inputs, config)
    where = chunks.bounds(made.problem.obs.t.numpy().astype(float))
    where = chunks.with_subject(where, np.any(made.masks["packed"], axis=(1, 2)))
    with one_thread():
        run = _search(made, config, progress) if len(where) == 1 else _long(inputs, made, where, config, progress)
    report: dict[str, Any] = {
        "hypothesis": run.labels[0], "loss": run.loss, "search": run.log,
        "skeleton": made.skeleton.name, "camera_mode": made.camera_mode, "evidence": made.evidence,
        "seconds": round(time.perf_counter() - began, 1), "cpu_seconds": round(time.process_time() - cpu, 1),
    }  # fmt: skip
    return Artifact(npz={"fit.npz": as_arrays(run)}, json={"report.json": report})


def _search(made: Prepared, config: FitConfig, progress: Progress) -> Run:
    root = hypotheses.root_guess(made.problem.obs, made.skeleton)
    return fitting.fit(
        made.problem, root, _effort(config), metres=config.length_m or None, seed=config.seed, progress=progress
    )


def _long(
    inputs: Inputs, made: Prepared, where: Sequence[tuple[int, int]], config: FitConfig, progress: Progress
) -> Run:
    """Each chunk by itself, and then all of them together from what they found."""

    def part(n: int) -> Prepared:
        cut = prepare(chunks.cut(inputs, *where[n]), config)
        return replace(cut, problem=chunks.level(cut.problem))

    progress.note(f"fit: a long clip, in {len(where)} chunks that overlap")
    runs = chunks.finished(progress)
    while len(runs) < len(where):
        runs.append(_search(part(len(runs)), config, chunks.ChunkProgress(progress, runs, len(where))))
    paths = [_path(made.problem.obs.t[a:b], made.problem.kin, config) for a, b in where]
    turned: list[dict[str, Any]] = []
    if made.skeleton.kind == "human":
        runs, turned = seams.one_way(lambda n: part(n).problem, paths, runs, where)
    runs, exchanged = seams.settle(lambda n: part(n).problem, runs, where)
    joined = chunks.join(made.problem, paths, runs, where)
    joined.log["seams"] = turned + exchanged
    schedule = replace(_effort(config).schedules[fitting.FINAL], rate=POLISH)
    last = chunks.ChunkProgress(progress, runs, len(where))
    return fitting.polish(made.problem, joined, schedule, seed=config.seed, progress=last)


def _named(inputs: Inputs, config: FitConfig) -> str | Path:
    """The skeleton's name or file: the user's, or the one that the evidence is about."""
    named = inputs.files.get("skeleton", config.skeleton)
    if named != AUTO:
        return named
    said = inputs.artifacts.get("evidence")
    return said.json["report.json"]["skeleton"] if said else USUAL


def _evidence(inputs: Inputs, obs: Observations, skeleton: Skeleton, weights: dict[str, float]) -> Evidence | None:
    """What is said about the clip less what is switched off; None when nothing is left."""
    if "evidence" not in inputs.artifacts:
        return None
    said = gather(inputs.artifacts["evidence"].npz["evidence.npz"], obs, skeleton)
    said = said.without([g for g in said.groups if not weights[g]])
    return said if said.groups else None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread: sums then round alike on every machine, and tensors of this size gain little from two (on a
    busy machine threads that wait for each other make it many times slower)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _effort(config: FitConfig) -> fitting.Effort:
    heading, gait, rivals, final, limbs = config.iterations or ITERATIONS[config.quality]
    skeleton = tuple(f"shape.{k}" for k in ("log_length", "group", "node", "shift", "radius", "girth"))
    last = Schedule(final, 48, 300, (*skeleton, "Q", "G", "tilt"), late=("shape.flesh",))
    again = Schedule(limbs, 48, 300, (*skeleton, "shape.flesh", "Q", "G", "tilt"), rate=AGAIN)
    return fitting.Effort(
        schedules=(
            Schedule(heading, 12, 160, ("G", "shape.log_length", "shape.group", "shape.girth")),
            Schedule(gait, 16, 160, (*skeleton, "Q", "G", "tilt"), stance=1.0),
            Schedule(rivals, 32, 200, (*skeleton, "Q", "G", "tilt"), stance=0.0),
            last,
            again,
            again,
            *[last if limbs else replace(last, iterations=0)] * 2,
        ),
        candidates=config.candidates,
        phases_of_gait=config.gait_phases,
    )
