"""Checkpoints of a run under way: `<number>.safetensors` with its `<number>.json`, the newest two kept."""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from slomo.stage import Arrays
from slomo.store.files import fsync_folder, json_bytes, read_json, replace_file, write_file, writing

KEPT = 2


class Checkpoints:
    """The checkpoints in one folder, which belongs to one key: another key never sees them.

    The JSON is written last and holds the digest of the arrays, so that a checkpoint torn by SIGKILL or a full disk
    is known and skipped.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def _numbers(self) -> list[int]:
        return sorted(int(p.stem) for p in self.folder.glob("*.json") if p.stem.isdigit())

    def save(self, state: Arrays, about: dict[str, Any]) -> None:
        """Write a checkpoint atomically, then drop all but the newest two. `about` is kept with it."""
        from safetensors.numpy import save

        data = save({k: np.ascontiguousarray(v).reshape(np.shape(v)) for k, v in state.items()})
        number = max(self._numbers(), default=0) + 1
        path = self.folder / f"{number:06d}.safetensors"
        with writing(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            tmp = path.with_suffix(".tmp")
            write_file(tmp, lambda f: f.write(data))
            os.replace(tmp, path)
            fsync_folder(self.folder)
        replace_file(path.with_suffix(".json"), json_bytes(about | {"sha256": hashlib.sha256(data).hexdigest()}))
        for old in self._numbers()[:-KEPT]:
            for suffix in (".json", ".safetensors"):
                (self.folder / f"{old:06d}{suffix}").unlink(missing_ok=True)

    def load(self) -> tuple[Arrays, dict[str, Any]] | None:
        """The newest whole checkpoint and what was kept with it, or None."""
        from safetensors.numpy import load

        for number in reversed(self._numbers()):
            about = read_json(self.folder / f"{number:06d}.json")
            try:
                data = (self.folder / f"{number:06d}.safetensors").read_bytes()
            except OSError:
                continue
            if about and about.get("sha256") == hashlib.sha256(data).hexdigest():
                return load(data), about
        return None
