"""Training data for the prior: shards of labelled samples, deterministic by seed, resumable, each with its digest.

A shard `<out>/<kind>/shard-00000.npz` holds N samples of 160 x 160 px, square crops around the subject:

- `rgb` (N, S, S, 3) uint8; `mask` (N, S, S) uint8, what is visible of the subject; `flow` (N, S, S, 2) float16 px to
  a frame about 1/15 s later, without the camera's share, 0 away from the mask;
- `parts` (N, S, S) uint8, labels (0: background); `surface` (N, S, S, 3) int8, canonical coordinates
  times `SURFACE_UNIT`;
- `keypoints` (N, K, 2) float32 px, `visible` (N, K) uint8; `azimuth` (N,) and `up` (N, 3) float32, the root view;
- `move` (N,) what the subject does; `recipe`: JSON of all that it was made from.

`dataset.json` beside them lists the recipe and the shards' digests. Labels are those of `slomo.prior.labels`.
"""

import io
import json
import multiprocessing
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slomo.errors import UsageError
from slomo.prior.labels import SURFACE_UNIT, labels
from slomo.skeleton import list_skeletons, load_skeleton
from slomo.stage import Progress
from slomo.store.digest import digest_file
from slomo.store.files import json_bytes, replace_file
from slomo.synth.creature import create
from slomo.synth.sample import SIZE, parts_of_keypoints, sample

VERSION = {"quadruped": 3, "human": 4}  # of each kind's recipe: raise it when the same numbers give other pictures
SHARD = 64  # samples
BODY = 16  # samples in a row of one creature: proportions are the slow part of the work

_TRIES = 20


@dataclass(frozen=True)
class Config:
    """What is in a data set.

    Attributes:
        kind: a built-in skeleton, "quadruped" or "human".
        samples: how many, rounded up to whole shards.
        seed: data sets of different seeds have nothing in common.
    """

    kind: str = "quadruped"
    samples: int = 6400
    seed: int = 0

    def __post_init__(self):
        if self.kind not in list_skeletons():
            raise UsageError(f"no kind {self.kind!r}", where="dataset", valid=list_skeletons())
        if self.samples < 1:
            raise UsageError(f"samples is {self.samples}", where="dataset", valid=["1 and more"])

    @property
    def shards(self) -> int:
        return -(-self.samples // SHARD)


def recipe(config: Config) -> dict[str, Any]:
    """All that a shard's pictures depend on, beside its number."""
    return asdict(config) | {"version": VERSION[config.kind], "size": SIZE, "shard": SHARD, "body": BODY}


def make_shard(config: Config, number: int) -> dict[str, np.ndarray]:
    """The arrays of shard `number`; the same ones whenever and on whatever CPU it is made."""
    skeleton = load_skeleton(config.kind)
    known = labels(skeleton)
    near = parts_of_keypoints(skeleton, known)
    rows: list[dict[str, Any]] = []
    for i in range(SHARD):
        if i % BODY == 0:
            creature = create(skeleton, int(np.random.SeedSequence([config.seed, number, i]).generate_state(1)[0]))
        for attempt in range(_TRIES):
            rng = np.random.default_rng([config.seed, number, i, attempt])
            row = sample(creature, known, near, rng)  # pyright: ignore[reportPossiblyUnbound]
            if row is not None:
                rows.append(row)
                break
    out = {k: np.stack([r[k] for r in rows]) for k in rows[0]}
    grown = [cv2.dilate(m, np.ones((9, 9), np.uint8)) for m in out["mask"]]
    return dict(
        rgb=out["rgb"], mask=out["mask"], flow=(out["flow"] * np.stack(grown)[..., None]).astype(np.float16),
        parts=out["parts"], surface=np.clip(np.round(out["surface"] * SURFACE_UNIT), -127, 127).astype(np.int8),
        keypoints=out["keypoints"].astype(np.float32), visible=out["visible"].astype(np.uint8),
        azimuth=out["azimuth"].astype(np.float32), up=out["up"].astype(np.float32), move=out["move"],
        recipe=np.array(json.dumps(recipe(config), sort_keys=True)),
    )  # fmt: skip


def _bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """An .npz that is compressed fast and is the same bytes for the same arrays."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as z:
        for name, x in arrays.items():
            one = io.BytesIO()
            np.lib.format.write_array(one, x, allow_pickle=False)
            z.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), one.getvalue(), zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _path(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.npz"


def _write(job: tuple[Config, Path, int]) -> int:
    config, folder, number = job
    replace_file(_path(folder, number), _bytes(make_shard(config, number)))
    return number


def _whole(path: Path, config: Config) -> bool:
    """Whether a shard is there, readable, and of this recipe."""
    try:
        with np.load(path) as z:
            return str(z["recipe"]) == json.dumps(recipe(config), sort_keys=True)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return False


def _made(jobs: list[tuple[Config, Path, int]], workers: int) -> Iterator[int]:
    if workers < 2:
        yield from map(_write, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(_write, jobs)


def write_dataset(out_dir: Path, config: Config, progress: Progress, *, workers: int = 1) -> Path:
    """Write the shards that are missing, and `dataset.json`; returns its path.

    Args:
        out_dir: folder; the shards go into one for the kind below it. Stopped at any time, the next call goes on.
        workers: processes.
    """
    folder = out_dir / config.kind
    missing = [n for n in range(config.shards) if not _whole(_path(folder, n), config)]
    done = config.shards - len(missing)
    if done:
        progress.note(f"{done} of {config.shards} shards are there already")
    for _ in _made([(config, folder, n) for n in missing], workers):
        done += 1
        progress.update(done / config.shards, f"{config.kind}: shard {done} of {config.shards}")
    paths = [_path(folder, n) for n in range(config.shards)]
    digests = {p.name: digest_file(p) for p in paths}
    replace_file(folder / "dataset.json", json_bytes({"recipe": recipe(config), "shards": digests}))
    return folder / "dataset.json"
