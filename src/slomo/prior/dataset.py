"""Batches for the training of the networks, read from the shards that `slomo dataset` writes.

Which samples a batch holds and how they are augmented follows from the seed and the number of the step alone: a
training that was stopped goes on with the very batches that it would have had.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from slomo.errors import InvalidData, MissingInput
from slomo.formats import npz
from slomo.prior.augment import AugmentConfig, Example, Sample, example
from slomo.prior.labels import SURFACE_UNIT, Labels
from slomo.store.files import read_json

Array = np.ndarray

GROUP = 8  # shards in memory at a time; what is drawn from them is mixed
_FIELDS = ("rgb", "mask", "flow", "parts", "surface", "keypoints", "visible", "azimuth", "up")


class Batch(NamedTuple):
    """N examples: see `augment.Example`. `surface` is float32 in body lengths."""

    input: Tensor
    parts: Tensor
    surface: Tensor
    keypoints: Tensor
    visible: Tensor
    azimuth: Tensor
    up: Tensor


def find_shards(folder: Path) -> tuple[list[Path], dict[str, Any]]:
    """The shards of one kind in order, and what `dataset.json` says of them: {"recipe", "shards": name -> digest}.

    Raises:
        MissingInput: there is no finished data set.
        InvalidData: a shard that is listed is not there.
    """
    listed = read_json(folder / "dataset.json")
    if listed is None:
        raise MissingInput("no finished data set", where=folder, todo="run `slomo dataset` first")
    paths = [folder / name for name in sorted(listed["shards"])]
    for path in paths:
        if not path.is_file():
            raise InvalidData("a shard of the data set is missing", where=path, todo="run `slomo dataset` again")
    return paths, listed


def split(paths: Sequence[Path], *, held_out: float) -> tuple[list[Path], list[Path]]:
    """Shards to train on, and the last ones (other animals, at least one shard where there are two) to validate on."""
    n = min(max(1, round(held_out * len(paths))), len(paths) - 1)
    return list(paths[: len(paths) - n]), list(paths[len(paths) - n :])


class Shards:
    """Samples of several shards."""

    def __init__(self, paths: Sequence[Path], labels: Labels):
        loaded = [npz.load(path) for path in paths]
        for path, arrays in zip(paths, loaded, strict=True):
            lacking = [f for f in _FIELDS if f not in arrays]
            if lacking or arrays["keypoints"].shape[1] != len(labels.keypoints):
                what = f"lacks {', '.join(lacking)}" if lacking else "has other key points than the skeleton"
                raise InvalidData(f"a shard {what}", where=path, todo="run `slomo dataset` again")
        self._arrays = [{f: arrays[f] for f in _FIELDS} for arrays in loaded]
        self._rows = [(s, i) for s, arrays in enumerate(self._arrays) for i in range(len(arrays["mask"]))]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Sample:
        shard, i = self._rows[index]
        row = {f: x[i] for f, x in self._arrays[shard].items()}
        return Sample(**row | {"flow": row["flow"].astype(np.float32), "azimuth": float(row["azimuth"])})


def collate(examples: Sequence[Example]) -> Batch:
    """Examples as one batch of tensors; the input is laid out channels last, which convolutions on a CPU like."""

    def stack(name: str, dtype: Any = np.float32) -> Tensor:
        return torch.from_numpy(np.stack([getattr(e, name) for e in examples]).astype(dtype))

    return Batch(
        stack("input").contiguous(memory_format=torch.channels_last),
        stack("parts", np.int64),
        stack("surface") / SURFACE_UNIT,
        stack("keypoints"),
        stack("visible"),
        stack("azimuth"),
        stack("up"),
    )


def steps_in_epoch(sizes: Sequence[int], batch: int) -> int:
    """Batches that shards of these numbers of samples give, group by group."""
    return sum(sum(sizes[i : i + GROUP]) // batch for i in range(0, len(sizes), GROUP))


def batches(
    paths: Sequence[Path],
    labels: Labels,
    augment: AugmentConfig,
    *,
    size: int,
    batch: int,
    seed: int,
    start: int = 0,
) -> Iterator[Batch]:
    """Endless batches from step `start` on: shards in a new order each epoch, samples mixed within groups of shards.

    Raises:
        InvalidData: all shards together are fewer samples than a batch.
    """
    step, epoch = 0, 0
    count = {path: len(np.load(path)["azimuth"]) for path in paths}
    if sum(count.values()) < batch:
        raise InvalidData(f"{sum(count.values())} samples are fewer than a batch of {batch}", where=paths[0].parent)
    while True:
        order = np.random.default_rng([seed, epoch]).permutation(len(paths))
        for g in range(0, len(order), GROUP):
            group = [paths[i] for i in order[g : g + GROUP]]
            n = sum(count[path] for path in group) // batch
            if step + n > start:
                samples = Shards(group, labels)
                rows = np.random.default_rng([seed, epoch, g + 1]).permutation(len(samples))
                for i in range(max(0, start - step), n):
                    rng = np.random.default_rng([seed, step + i, 7])
                    yield collate(
                        [
                            example(samples[row], labels, augment, rng, size=size)
                            for row in rows[i * batch : (i + 1) * batch]
                        ]
                    )
            step += n
        epoch += 1


def fixed(paths: Sequence[Path], labels: Labels, augment: AugmentConfig, *, size: int, batch: int) -> Iterator[Batch]:
    """Every sample of the shards once, always augmented in the same way: what a network is validated on."""
    for number, path in enumerate(paths):
        samples = Shards([path], labels)
        rng = np.random.default_rng([number, 11])
        for i in range(0, len(samples), batch):
            rows = range(i, min(i + batch, len(samples)))
            yield collate([example(samples[row], labels, augment, rng, size=size) for row in rows])
