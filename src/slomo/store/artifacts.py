"""The project's artifacts: immutable folders named by the digest of everything that went into them.

.slomo/store/<stage>/<key16>/      manifest.json and the artifact's files
.slomo/partial/<stage>/<key16>/    checkpoints and progress of a run under way, files about to be published
.slomo/lock/                       one lock an artifact
out/<stage>.json                   pointer to the current artifact (out/<stage>-<robot>.json)
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slomo.stage import Arrays, Artifact
from slomo.store.checkpoint import Checkpoints
from slomo.store.digest import digest_arrays, digest_file, digest_json, plain, without_wall_times
from slomo.store.files import (
    fsync_folder,
    json_bytes,
    read_json,
    remove,
    replace_file,
    write_file,
    write_npz,
    writing,
)
from slomo.store.lock import holder, locked

Manifest = dict[str, Any]
SCHEMA = 1


class _Folder(Mapping[str, Any]):
    """Files of an artifact, or arrays of a file, read when they are asked for, so that nobody pays for what he does not
    use: the times of a clip's frames are a thousandth of a file that may hold a gigabyte."""

    def __init__(self, folder: Path, names: list[str], read: Callable[[Path], Any]):
        self._folder, self._names, self._read, self._have = folder, names, read, {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._have:
            self._have[name] = self._read(self._folder / name)
        return self._have[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _read_npz(path: Path) -> Arrays:
    with np.load(path, allow_pickle=False) as z:
        names = list(z.files)
    return _Folder(path, names, _read_array)


def _read_array(place: Path) -> np.ndarray:
    with np.load(place.parent, allow_pickle=False) as z:
        return z[place.name]


class Store:
    """The store of the project at `root`. Nothing is created before something is written."""

    def __init__(self, root: Path):
        self.root = root

    def entry(self, stage: str, key: str) -> Path:
        """Folder of an artifact."""
        return self.root / ".slomo" / "store" / stage / key[:16]

    def partial(self, stage: str, key: str) -> Path:
        """Folder of what a run under way leaves for the next one."""
        return self.root / ".slomo" / "partial" / stage / key[:16]

    def checkpoints(self, stage: str, key: str) -> Checkpoints:
        """The checkpoints of this very key."""
        return Checkpoints(self.partial(stage, key) / "checkpoints")

    def _lock_path(self, stage: str, key: str) -> Path:
        return self.root / ".slomo" / "lock" / f"{stage}-{key[:16]}.lock"

    def lock(
        self, stage: str, key: str, *, wait: bool, note: Callable[[str], None], check: Callable[[], None]
    ) -> contextlib.AbstractContextManager[None]:
        """Hold the artifact's lock (see `lock.locked`)."""
        return locked(self._lock_path(stage, key), stage, wait=wait, note=note, check=check)

    def holder(self, stage: str, key: str) -> str | None:
        """Who works on the artifact, or None."""
        return holder(self._lock_path(stage, key))

    def manifest(self, stage: str, key: str) -> Manifest | None:
        """The artifact's manifest, or None where there is no whole artifact (its files are there, in their sizes)."""
        folder = self.entry(stage, key)
        m = read_json(folder / "manifest.json")
        if m is None or m.get("key") != key or m.get("schema") != SCHEMA:
            return None
        for name, file in m["files"].items():
            path = folder / name
            if not path.is_file() or path.stat().st_size != file["bytes"]:
                return None
        return m

    def damaged(self, stage: str, key: str) -> str | None:
        """The first file of an artifact that is not what was published, or None. Reads everything."""
        folder = self.entry(stage, key)
        if not folder.exists():
            return None
        m = self.manifest(stage, key)
        if m is None:
            return "manifest.json or a file of other size"
        for name, file in m["files"].items():
            try:
                if digest_file(folder / name) != file["sha256"]:
                    return name
            except OSError:
                return name
        return None

    def load(self, m: Manifest) -> Artifact:
        """The artifact of a manifest. Its files are read when they are asked for."""
        folder = self.entry(m["stage"], m["key"])
        names = {s: [n for n in m["files"] if Path(n).suffix == s] for s in (".npz", ".json")}
        rest = [n for n in m["files"] if Path(n).suffix not in names]
        return Artifact(
            npz=_Folder(folder, names[".npz"], _read_npz),
            json=_Folder(folder, names[".json"], read_json),
            blobs=_Folder(folder, rest, Path.read_bytes),
            failure=m["failure"],
        )

    def publish(self, stage: str, key: str, artifact: Artifact, about: Mapping[str, Any]) -> Manifest:
        """Write an artifact under partial/, fsync, and rename it into the store. The caller holds its lock.

        Args:
            about: the other entries of the manifest.

        Returns:
            The manifest: `about`, and schema, stage, key, directory, failure, files (bytes, sha256, content) and
            `content`, the digest by which stages downstream know the artifact.
        """
        build = self.partial(stage, key) / "build"
        with writing(build):
            remove(build)
            build.mkdir(parents=True)
            contents: dict[str, str] = {}
            for name, arrays in artifact.npz.items():
                write_file(build / name, lambda f, arrays=arrays: write_npz(f, arrays))
                contents[name] = digest_arrays(without_wall_times(arrays))
            for name, data in artifact.json.items():
                write_file(build / name, lambda f, data=data: f.write(json_bytes(data)))
                contents[name] = digest_json(without_wall_times(plain(data)))
            for name, blob in artifact.blobs.items():
                write_file(build / name, lambda f, blob=blob: f.write(blob))
                contents[name] = digest_file(build / name)
            files = {
                n: {"bytes": (build / n).stat().st_size, "sha256": digest_file(build / n), "content": c}
                for n, c in sorted(contents.items())
            }
            m: Manifest = {
                "schema": SCHEMA,
                "stage": stage,
                "key": key,
                "directory": self.entry(stage, key).relative_to(self.root).as_posix(),
                "failure": artifact.failure,
                **plain(about),
                "content": digest_json(contents),
                "files": files,
            }
            write_file(build / "manifest.json", lambda f: f.write(json_bytes(m)))
            fsync_folder(build)
            self.discard(stage, key)
            target = self.entry(stage, key)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.rename(build, target)
            fsync_folder(target.parent)
        self.forget(stage, key)
        return m

    def discard(self, stage: str, key: str) -> None:
        """Take an artifact out of the store: renamed away first, so that nobody sees half of it."""
        target, trash = self.entry(stage, key), self.partial(stage, key) / "trash"
        if target.exists():
            with writing(trash):
                remove(trash)
                trash.parent.mkdir(parents=True, exist_ok=True)
                os.rename(target, trash)
            remove(trash)

    def forget(self, stage: str, key: str) -> None:
        """Remove the checkpoints and progress of a run."""
        remove(self.partial(stage, key))

    def pointer(self, label: str) -> dict[str, Any] | None:
        """Content of out/<label>.json, or None."""
        return read_json(self.pointer_path(label))

    def pointer_path(self, label: str) -> Path:
        """What a Makefile depends on."""
        return self.root / "out" / f"{label}.json"

    def point(self, label: str, content: Mapping[str, Any], *, touch: bool, after: list[Path]) -> None:
        """Make out/<label>.json hold `content`.

        Args:
            touch: write it even if it holds that already, so that Make sees it newer than what it depends on.
            after: with touch false, write it all the same where one of these files is newer.
        """
        path, data = self.pointer_path(label), json_bytes(content)
        if not touch and path.is_file() and path.read_bytes() == data:
            made = path.stat().st_mtime_ns
            if all(p.stat().st_mtime_ns <= made for p in after if p.exists()):
                return
        replace_file(path, data)

    def pointers(self) -> dict[str, dict[str, Any]]:
        """Label -> content of every pointer."""
        found = {p.stem: read_json(p) for p in sorted((self.root / "out").glob("*.json"))}
        return {label: c for label, c in found.items() if c is not None and {"stage", "key"} <= c.keys()}

    def unused(self, keep: set[tuple[str, str]]) -> list[Path]:
        """Artifacts and partial runs that no pointer leads to, that are not in `keep` and that nobody works on.

        Args:
            keep: (stage, key) of what the present parameters ask for.
        """
        used = {(c["stage"], c["key"][:16]) for c in self.pointers().values()} | {(s, k[:16]) for s, k in keep}
        base = self.root / ".slomo"
        folders = [p for kind in ("store", "partial") for p in sorted((base / kind).glob("*/*")) if p.is_dir()]
        ids = [(p.parent.name, p.name) for p in folders]
        return [p for p, i in zip(folders, ids, strict=True) if i not in used and not self.holder(*i)]
