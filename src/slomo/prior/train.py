"""The training of one network, from the first step to the file that ships.

    python -m slomo.prior.train DATA OUT --kind quadruped

A fixed number of steps of AdamW under one cosine, batches that follow from the seed, an average of the weights over
the last steps. Stopped at any time, the same command goes on. Leaves in OUT: <kind>.onnx; <kind>.json, the record
(config, digests of the data, metrics); <kind>.csv and <kind>.png, the curves.
"""

import math
import platform
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer

from slomo.console import Console
from slomo.errors import SlomoError, UsageError
from slomo.prior.augment import AugmentConfig, without
from slomo.prior.dataset import Batch, Shards, batches, find_shards, fixed, split
from slomo.prior.export import onnx_bytes, require_onnx
from slomo.prior.inference import Prior
from slomo.prior.labels import Labels, labels
from slomo.prior.network import STRIDE, Network, NetworkConfig, network
from slomo.prior.objective import TERMS, ObjectiveConfig, class_weights, losses, total
from slomo.prior.validate import check, curves, score, temperatures
from slomo.skeleton import list_skeletons, load_skeleton
from slomo.stage import Progress, Silent
from slomo.store.checkpoint import Checkpoints
from slomo.store.digest import digest_json
from slomo.store.files import json_bytes, replace_file

LOG_EVERY = 25  # steps
CHECK_EVERY = 500  # steps between looks at samples that are not trained on
CHECK_BATCHES = 8
SAVE_EVERY = 60.0  # s


@dataclass(frozen=True)
class TrainConfig:
    """All that decides about the weights, beside the data.

    Attributes:
        kind: skeleton.
        steps, batch: how long; samples a step.
        size: px, side of the input.
        rate: highest learning rate.  warm: share of the steps until it is reached.  decay: of the weights.
        average: share of the averaged weights that a step leaves as it is.
        held_out: share of the shards to validate on.
    """

    kind: str = "quadruped"
    steps: int = 4500
    batch: int = 32
    size: int = 128
    seed: int = 0
    rate: float = 2.5e-3
    warm: float = 0.08
    decay: float = 0.02
    clip: float = 2.0
    average: float = 0.998
    held_out: float = 0.04
    network: NetworkConfig = field(default_factory=NetworkConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self):
        if self.kind not in list_skeletons():
            raise UsageError(f"no kind {self.kind!r}", where="train", valid=list_skeletons())
        if self.size % STRIDE or self.size < STRIDE:
            raise UsageError(f"size is {self.size}", where="train", valid=[f"multiples of {STRIDE}"])
        if min(self.steps, self.batch) < 1:
            raise UsageError("steps and batch must be 1 or more", where="train")


def learning_rate(step: int, config: TrainConfig) -> float:
    """Up along a line, down along a cosine to a hundredth."""
    at = (step + 1) / config.steps
    if at < config.warm:
        return config.rate * at / config.warm
    return config.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (at - config.warm) / (1 - config.warm))))


class Trainer:
    """A network with its optimiser and averaged weights, as a checkpoint holds them."""

    def __init__(self, known: Labels, config: TrainConfig):
        torch.manual_seed(config.seed)
        self.config = config
        self.network = network(known, config.network).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        plain = [p for p in self.network.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": config.decay}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=config.rate, betas=(0.9, 0.99))
        self.average = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.step = 0
        self.rows: list[list[float]] = []  # of the log: step, rate, a loss a term; NaN or the same of held-out samples

    def train(self, batch: Batch, weights: torch.Tensor) -> dict[str, float]:
        """One step. Returns the losses."""
        rate = learning_rate(self.step, self.config)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.network.train()
        with torch.autocast("cpu", torch.bfloat16):
            out = self.network(batch.input)
        terms = losses(out, batch, weights, self.config.objective)
        self.optimiser.zero_grad(set_to_none=True)
        total(terms, self.config.objective).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        self.step += 1
        keep = min(self.config.average, self.step / (self.step + 10))
        for name, value in self.network.state_dict().items():
            mine = self.average[name]
            if mine.is_floating_point():
                mine.lerp_(value, 1 - keep)
            else:
                mine.copy_(value)
        return {k: float(v.detach()) for k, v in terms.items()}

    def averaged(self, known: Labels) -> Network:
        """The network with the averaged weights, for evaluation."""
        net = network(known, self.config.network)
        net.load_state_dict(self.average)
        return net.eval().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def state(self) -> dict[str, np.ndarray]:
        """All of it as arrays."""
        out = {f"network/{k}": v.numpy() for k, v in self.network.state_dict().items()}
        out |= {f"average/{k}": v.numpy() for k, v in self.average.items()}
        for i, entry in self.optimiser.state_dict()["state"].items():
            out |= {f"optimiser/{i}/{k}": v.numpy() for k, v in entry.items()}
        return out | {"step": np.array(self.step), "rows": np.array(self.rows, float).reshape(len(self.rows), -1)}

    def load(self, state: Any) -> None:
        """Go back to where `state` was taken."""

        def part(name: str) -> dict[str, torch.Tensor]:
            return {k[len(name) :]: torch.tensor(v) for k, v in state.items() if k.startswith(name)}

        self.network.load_state_dict(part("network/"))
        self.average = part("average/")
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in part("optimiser/").items():
            number, name = key.split("/")
            entries.setdefault(int(number), {})[name] = value
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": entries})
        self.step, self.rows = int(state["step"]), state["rows"].tolist()


def train(data: Path, out: Path, config: TrainConfig, progress: Progress) -> Path:
    """Train on the shards in `data`/<kind> and write the results to `out`; returns the path of the .onnx file.

    Raises:
        MissingInput, InvalidData: no data set, or a damaged one.
        UsageError: the package for the export is not installed.
    """
    require_onnx()
    known = labels(load_skeleton(config.kind))
    paths, listed = find_shards(data / config.kind)
    learned, held_paths = split(paths, held_out=config.held_out)
    key = digest_json({"config": asdict(config), "data": listed})[:16]
    checkpoints = Checkpoints(out / "partial" / f"{config.kind}-{key}")
    trainer = Trainer(known, config)
    if (found := checkpoints.load()) is not None:
        trainer.load(found[0])
        progress.note(f"goes on from step {trainer.step}")
    first = Shards(learned[:1], known)
    weights = class_weights(
        torch.from_numpy(np.stack([first[i].parts for i in range(len(first))])).long(), len(known.parts) + 1
    )
    view = dict(size=config.size, batch=config.batch)
    held = list(fixed(held_paths, known, config.augment, **view))
    saved = logged = time.monotonic()
    recent: list[dict[str, float]] = []
    stream = batches(learned, known, config.augment, **view, seed=config.seed, start=trainer.step)
    while trainer.step < config.steps:
        recent.append(trainer.train(next(stream), weights))
        step, last = trainer.step, trainer.step == config.steps
        if step % LOG_EVERY == 0 or last:
            mean = {t: float(np.mean([r[t] for r in recent])) for t in TERMS}
            seen = dict.fromkeys(TERMS, math.nan)
            if step % CHECK_EVERY == 0 or last:
                seen = check(trainer.averaged(known), held[:CHECK_BATCHES], weights, config.objective)
            trainer.rows.append([step, learning_rate(step - 1, config), *mean.values(), *seen.values()])
            pace = len(recent) * config.batch / max(time.monotonic() - logged, 1e-9)
            losses_now = " ".join(f"{k} {v:.2f}" for k, v in mean.items())
            progress.update(step / config.steps, f"{config.kind}: step {step}, {pace:.0f} samples/s, {losses_now}")
            recent, logged = [], time.monotonic()
            if time.monotonic() - saved > SAVE_EVERY or last:
                checkpoints.save(trainer.state(), {"step": step})
                saved = time.monotonic()
    net = trainer.averaged(known).to(memory_format=torch.contiguous_format)
    about = {
        "kind": config.kind,
        "keypoints": list(known.keypoints),
        "parts": list(known.parts),
        "size": config.size,
        "temperature": temperatures(net, held),
        "recipe": digest_json({"config": asdict(config), "data": listed}),
    }
    path = out / f"{config.kind}.onnx"
    replace_file(path, onnx_bytes(net, about))
    prior = Prior(path)
    bare = list(fixed(held_paths, known, without(config.augment), **view))
    record = about | {
        "digest": prior.digest,
        "parameters": sum(p.numel() for p in net.parameters()),
        "config": asdict(config),
        "data": listed,
        "metrics": {"as in training": score(prior, known, held), "true masks": score(prior, known, bare)},
        "made_with": {"torch": torch.__version__, "python": platform.python_version()},
    }
    replace_file(out / f"{config.kind}.json", json_bytes(record))
    text, picture = curves(trainer.rows)
    replace_file(out / f"{config.kind}.csv", text)
    replace_file(out / f"{config.kind}.png", picture)
    return path


class _Shown(Silent):
    def __init__(self, console: Console):
        self.note, self.update = console.note, console.update


def main(
    data: Annotated[Path, typer.Argument(help="Folder that `slomo dataset` wrote.")],
    out: Annotated[Path, typer.Argument(help="Folder for the network, its record and its curves.")],
    kind: Annotated[str, typer.Option(metavar="quadruped|human")] = TrainConfig.kind,
    steps: Annotated[int, typer.Option(help="Batches of 32.")] = TrainConfig.steps,
    seed: Annotated[int, typer.Option(help="Of the first weights, the batches, the augmentation.")] = TrainConfig.seed,
    threads: Annotated[int, typer.Option(min=1, help="Other numbers give weights that differ in rounding.")] = 1,
) -> None:
    """Train the network of one kind. Goes on where it was stopped."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    console = Console()
    console.start(f"train {kind}")
    try:
        path = train(data, out, TrainConfig(kind=kind, steps=steps, seed=seed), _Shown(console))
    except SlomoError as e:
        console.line(f"error: {e}")
        sys.exit(e.exit_code)
    finally:
        console.close()
    print(path)


if __name__ == "__main__":
    typer.run(main)
