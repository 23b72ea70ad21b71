"""Long clips: fitted in chunks that overlap, blended into one guess for the whole clip, which is then polished.

The search among headings and gaits needs the whole motion in every draw, and a stretch of ten seconds has all that it
looks at. So the search costs the same for every second of clip, however long it is, and a walk may end in a gallop.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from slomo.reconstruct.kinematics import yaw_pitch_roll
from slomo.reconstruct.problem import Problem
from slomo.reconstruct.run import Run, as_arrays, from_arrays
from slomo.reconstruct.trajectory import Guess, Trajectory
from slomo.stage import Arrays, Artifact, Inputs, Progress

Array = np.ndarray
Tensor = torch.Tensor

LONG = 12.0  # s: clips up to there are fitted as they are
LENGTH, OVERLAP = 8.0, 1.0  # s
SHOWN = 0.2  # share of a chunk's frames that show the subject, less than which are too few for a fit of its own
LEVEL = 0.2  # share of the spread of gravity that a chunk may change: the whole clip decides about it
BY_FRAME = (
    "box", "view", "view_up", "view_path", "keypoints", "keypoint_confidence", "parts", "surface", "surface_scale",
)  # fmt: skip


def bounds(t: Array) -> list[tuple[int, int]]:
    """First frame and the one behind the last of each chunk; one chunk for a clip that is not long."""
    total = float(t[-1] - t[0])
    if total <= LONG:
        return [(0, len(t))]
    count = int(np.ceil((total - OVERLAP) / (LENGTH - OVERLAP)))
    span = (total + (count - 1) * OVERLAP) / count
    starts = t[0] + np.arange(count) * (span - OVERLAP)
    return [(int(np.searchsorted(t, s - 1e-6)), int(np.searchsorted(t, s + span + 1e-6))) for s in starts]


def with_subject(where: Sequence[tuple[int, int]], shown: Array) -> list[tuple[int, int]]:
    """The chunks, those that hardly show the subject joined to the one before (the first one, to the one after).

    Args:
        shown: (T,) bool, frames that show it.
    """
    out: list[tuple[int, int]] = []
    for first, last in where:
        if out and (shown[first:last].mean() < SHOWN or shown[out[-1][0] : out[-1][1]].mean() < SHOWN):
            first = out.pop()[0]
        out.append((first, last))
    return out


def cut(inputs: Inputs, first: int, last: int) -> Inputs:
    """The inputs of a fit with the frames from `first` to before `last` alone."""
    decode, masks, camera = (inputs.artifacts[k] for k in ("decode", "masks", "camera"))
    m, f, c = masks.npz["masks.npz"], masks.npz["flow.npz"], camera.npz["camera.npz"]
    shape = np.array([last - first, *np.asarray(m["shape"])[1:]])
    kept = {
        "decode": replace(decode, npz={"frames.npz": {"t": np.asarray(decode.npz["frames.npz"]["t"])[first:last]}}),
        "masks": replace(
            masks,
            npz={
                "masks.npz": {"packed": m["packed"][first:last], "shape": shape, "quality": m["quality"][first:last]},
                "flow.npz": {k: np.asarray(f[k])[first : last - 1] for k in f},
            },
        ),
        "camera": replace(
            camera, npz={"camera.npz": {"K": c["K"], "T_world_cam": np.asarray(c["T_world_cam"])[first:last]}}
        ),
    }
    if "evidence" in inputs.artifacts:
        kept["evidence"] = _evidence(inputs.artifacts["evidence"], first, last)
    return replace(inputs, artifacts={**inputs.artifacts, **kept})


def _evidence(artifact: Artifact, first: int, last: int) -> Artifact:
    z = dict(artifact.npz["evidence.npz"])
    frame = np.asarray(z["frame"], int)
    here = (frame >= first) & (frame < last)
    cut_down = {k: np.asarray(z[k])[here] for k in BY_FRAME if k in z and len(z[k]) == len(frame)}
    return replace(artifact, npz={"evidence.npz": z | cut_down | {"frame": frame[here] - first}})


class ChunkProgress:
    """The progress of one of several chunks; its checkpoints hold those that are done."""

    def __init__(self, progress: Progress, done: Sequence[Run], count: int):
        self._progress, self._done, self._count = progress, done, count

    def update(self, fraction: float, message: str = "") -> None:
        number = len(self._done)
        here = f"chunk {number + 1} of {self._count}: " if number < self._count else ""
        self._progress.update((number + fraction) / (self._count + 1), here + message)

    def note(self, message: str) -> None:
        self._progress.note(message)

    def checkpoint_due(self) -> bool:
        return self._progress.checkpoint_due()

    def save(self, state: Arrays) -> None:
        finished = {f"chunk{n}/{k}": v for n, run in enumerate(self._done) for k, v in as_arrays(run).items()}
        self._progress.save({**state, **finished, "chunks": np.array(len(self._done))})

    def load(self) -> Arrays | None:
        saved = self._progress.load()
        if saved is None or int(saved["chunks"]) != len(self._done):
            return None
        return {k: v for k, v in saved.items() if not k.startswith("chunk")}


def finished(progress: Progress) -> list[Run]:
    """The chunks that a checkpoint holds."""
    saved = progress.load()
    if saved is None:
        return []
    part = lambda n: {k.removeprefix(f"chunk{n}/"): v for k, v in saved.items() if k.startswith(f"chunk{n}/")}  # noqa: E731
    return [from_arrays(part(n)) for n in range(int(saved["chunks"]))]


def level(problem: Problem) -> Problem:
    """The problem of a chunk: gravity nearly as given."""
    return replace(problem, tilt_spread=LEVEL * problem.tilt_spread)


def join(whole: Problem, paths: Sequence[Trajectory], runs: Sequence[Run], where: Sequence[tuple[int, int]]) -> Run:
    """One run over the whole clip: its guess is the motion of the chunks, blended where they overlap, its networks of
    time start at nothing, its shape is their mean."""
    T = len(whole.obs.t)
    weight, total = np.zeros(T), {}
    yaw_before = None
    log: dict = {"chunks": []}
    for path, run, (first, last) in zip(paths, runs, where, strict=True):
        n = last - first
        with torch.no_grad():
            position, R, q = path(run.x, run.guess, run.x["shape.log_length"].exp(), torch.arange(n))
        yaw, pitch, roll = (a.numpy() for a in yaw_pitch_roll(R[0].double()))
        yaw = np.unwrap(yaw)
        if yaw_before is not None:
            yaw = yaw + 2 * np.pi * np.round((yaw_before[first] - yaw[0]) / (2 * np.pi))
        inner = np.minimum(np.arange(n) + 1, n - np.arange(n)).astype(float)
        values = dict(position=position[0].numpy(), yaw=yaw, lean=np.stack([pitch, roll], -1), q=q[0].numpy())
        for name, x in values.items():
            into = total.setdefault(name, np.zeros((T, *x.shape[1:])))
            into[first:last] += inner.reshape(-1, *[1] * (x.ndim - 1)) * x
        weight[first:last] += inner
        yaw_before = np.full(T, np.nan)
        yaw_before[first:last] = yaw
        loss = run.loss
        log["chunks"].append({"start_s": round(float(whole.obs.t[first]), 3), "loss": loss, **run.labels[0]})
    mean = {k: x / weight.reshape(-1, *[1] * (x.ndim - 1)) for k, x in total.items()}
    stance = torch.full((1, T, runs[0].guess.stance.shape[2]), -1.0)
    guess = Guess(stance=stance, **{k: torch.as_tensor(x, dtype=torch.float32)[None] for k, x in mean.items()})
    x = whole.variables(1, torch.Generator().manual_seed(0))
    x |= {k: torch.stack([r.x[k] for r in runs]).mean(0) for k in x if k.startswith("shape.")}
    best = min(runs, key=lambda r: r.loss)
    return Run(best.phase, x, guess, [{**best.labels[0], "chunks": len(runs)}], best.log | log)
