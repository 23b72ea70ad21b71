"""Mesh files for other programs: an animated GLB, a sequence of PLY files, or the body at rest in one file."""

import re
from collections.abc import Callable
from pathlib import Path

from slomo.errors import UsageError
from slomo.formats.gltf import encode_animated_glb, encode_glb
from slomo.formats.ply import encode_ply
from slomo.mesh import SkinnedMesh
from slomo.store import replace_file

SUFFIXES = (".glb", ".ply")


def check_target(out: Path, *, rest: bool, every: int) -> None:
    """Raises `UsageError` for a place that says no format, or that does not go with the options."""
    if out.suffix and out.suffix not in SUFFIXES and not out.is_dir():
        valid = ["FOLDER (a PLY file a frame)", "FILE.glb (animation)", "FILE.ply (at rest)"]
        raise UsageError(f"unknown extension {out.suffix!r}", where=out, valid=valid)
    if out.is_dir() and out.suffix in SUFFIXES:
        raise UsageError("is a folder, and would be a file", where=out, todo="give another name")
    if out.exists() and not out.is_dir() and out.suffix not in SUFFIXES:
        raise UsageError("is a file, and would be a folder", where=out, todo="give another name")
    still = rest or out.suffix == ".ply"
    if still and out.suffix not in SUFFIXES:
        raise UsageError("the body at rest is one file", where=out, valid=["FILE.glb", "FILE.ply"])
    if still and every != 1:
        raise UsageError("goes with a motion, and this is the body at rest", where="--every")


def write_meshes(
    mesh: SkinnedMesh, out: Path, *, rest: bool = False, shown: Callable[[float, str], None] = lambda f, m: None
) -> list[Path]:
    """Write a mesh where `check_target` has nothing against. Each file is whole or absent.

    Args:
        out: .glb: the animation, or at rest; .ply: at rest; else a folder for frame-00000.ply, ..., in the world.
        shown: called with the fraction done and what of.

    Raises:
        UsageError: the folder holds frames of a longer sequence. SlomoError: the system refuses to write.
    """
    if out.suffix == ".glb":
        data = encode_glb(mesh.vertices, mesh.faces, mesh.colours) if rest else encode_animated_glb(mesh)
        replace_file(out, data)
        return [out]
    if out.suffix == ".ply" and not out.is_dir():
        comments = ("slomo: the body at rest; metres; x forward, y left, z up",)
        replace_file(out, encode_ply(mesh.vertices, mesh.faces, mesh.colours, comments=comments))
        return [out]
    files = [out / f"frame-{k:05d}.ply" for k in range(len(mesh.t))]
    left = [p for p in out.glob("frame-*.ply") if re.fullmatch(r"frame-\d+\.ply", p.name) and p not in files]
    if left:
        what = f"holds frames of a longer sequence ({min(left).name})"
        raise UsageError(what, where=out, todo="remove them, or give another folder")
    for k, path in enumerate(files):
        comments = (f"slomo: {mesh.t[k]:.6f} s; metres; z up, ground at 0",)
        replace_file(path, encode_ply(mesh.posed(k), mesh.faces, mesh.colours, comments=comments))
        shown((k + 1) / len(files), path.name)
    return files
