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
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer

from slomo.console import Console
from slomo.errors import SlomoError
from slomo.prior.augment import without
from slomo.prior.dataset import Shards, batches, find_shards, fixed, split
from slomo.prior.export import onnx_bytes, require_onnx
from slomo.prior.inference import Prior
from slomo.prior.labels import labels
from slomo.prior.objective import TERMS, class_weights
from slomo.prior.trainer import TrainConfig, Trainer, learning_rate
from slomo.prior.validate import check, curves, score, temperatures
from slomo.skeleton import load_skeleton
from slomo.stage import Progress, Silent
from slomo.store.checkpoint import Checkpoints
from slomo.store.digest import digest_json
from slomo.store.files import json_bytes, replace_file

LOG_EVERY = 25  # steps
CHECK_EVERY = 500  # steps between looks at samples that are not trained on
CHECK_BATCHES = 8
SAVE_EVERY = 60.0  # s


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
    net = trainer.averaged(known)
    with torch.no_grad():
        # A network that learns with weighted classes overstates the rare ones by their weight.
        net.parts_bias.sub_(torch.log(weights))
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
        self._console = console

    def update(self, fraction: float, message: str = "") -> None:
        self._console.update(fraction, message)

    def note(self, message: str) -> None:
        self._console.note(message)


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
