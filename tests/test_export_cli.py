"""slomo export: what it writes, says and refuses."""

import dataclasses
import errno
import json
import os

import numpy as np
import pytest

import fake_line
from slomo import pipeline
from slomo.formats.ply import read_ply
from test_cli import project, run  # noqa: F401
from test_export_formats import Y_UP, Glb, tube

MESH = tube(T=9)


@pytest.fixture
def body(project, monkeypatch):  # noqa: F811
    """A project whose reconstruction has a mesh."""
    spec = pipeline.STAGES["reconstruct"]
    plain = getattr(fake_line, spec.run)

    def with_mesh(inputs, config, progress):
        made = plain(inputs, config, progress)
        return dataclasses.replace(made, npz={**made.npz, "mesh.npz": MESH.to_arrays()})

    monkeypatch.setattr(fake_line, spec.run, with_mesh)
    run("reconstruct", "clip.txt")
    return project


def test_an_animation(body):
    done = run("export", "--mesh", "cat.glb")
    assert done.stdout == f"{body / 'cat.glb'}\n"
    glb = Glb((body / "cat.glb").read_bytes())
    np.testing.assert_allclose(glb.skinned(8), MESH.posed(8) @ Y_UP.T, atol=1e-5)
    run("export", "--mesh", "cat.glb", "--every", "4")
    glb = Glb((body / "cat.glb").read_bytes())
    np.testing.assert_allclose(glb.skinned(1), MESH.posed(4) @ Y_UP.T, atol=1e-5)
    assert len(glb.arrays[glb.json["animations"][0]["samplers"][0]["input"]]) == 3


def test_a_sequence(body):
    found = json.loads(run("export", "--mesh", "new/frames", "--every", "2", "--json").stdout)
    files = sorted((body / "new" / "frames").iterdir())
    assert [f.name for f in files] == [f"frame-{k:05d}.ply" for k in range(5)]
    assert found == {
        "path": str(body / "new" / "frames"), "files": 5, "bytes": sum(f.stat().st_size for f in files), "poses": 5,
        "vertices": len(MESH.vertices), "triangles": len(MESH.faces), "links": list(MESH.link_names),
    }  # fmt: skip
    third = read_ply(files[3])
    np.testing.assert_allclose(third.vertices, MESH.posed(6), atol=1e-6)
    np.testing.assert_allclose(third.colours, MESH.colours, atol=0.51 / 255)
    assert f"{MESH.t[6]:.6f} s" in third.comments[0]
    run("export", "--mesh", "new/frames")  # the longer one covers it
    said = run("export", "--mesh", "new/frames", "--every", "2", code=2).stderr
    assert "holds frames of a longer sequence (frame-00005.ply); remove them, or give another folder" in said


def test_at_rest(body):
    run("export", "--mesh", "cat.ply")
    np.testing.assert_allclose(read_ply(body / "cat.ply").vertices, MESH.vertices, atol=1e-6)
    assert json.loads(run("export", "--mesh", "cat.glb", "--rest", "--json").stdout)["poses"] == 1
    glb = Glb((body / "cat.glb").read_bytes())
    assert "animations" not in glb.json
    np.testing.assert_allclose(glb.attribute("POSITION"), MESH.vertices, atol=1e-6)


@pytest.mark.parametrize(
    ("args", "what"),
    [
        ([], "what is to be exported? (valid: --mesh)"),
        (["--mesh", "cat.obj"], "unknown extension '.obj' (valid: FOLDER"),
        (["--mesh", "frames", "--rest"], "the body at rest is one file (valid: FILE.glb, FILE.ply)"),
        (["--mesh", "cat.ply", "--every", "2"], "goes with a motion"),
        (["--mesh", "cat.glb", "--every", "0"], "Invalid value for '--every'"),
        (["--mesh", "folder.glb"], "is a folder, and would be a file"),
        (["--mesh", "file"], "is a file, and would be a folder"),
    ],
)
def test_what_is_asked_wrongly(body, args, what):
    (body / "folder.glb").mkdir()
    (body / "file").write_text("")
    assert what in run("export", *args, code=2).stderr


def test_there_is_no_mesh_yet(project):  # noqa: F811
    assert "run `slomo reconstruct" in run("export", "--mesh", "cat.glb", code=3).stderr
    run("reconstruct", "clip.txt")
    assert "has no mesh.npz; run `slomo reconstruct --fresh`" in run("export", "--mesh", "cat.glb", code=3).stderr
    (project / "clip.txt").write_bytes(b"another clip")
    said = run("export", "--mesh", "cat.glb", code=3).stderr
    assert "reconstruct is stale" in said
    assert not (project / "cat.glb").exists()


def test_a_full_disk_leaves_nothing(body, monkeypatch):
    def full(path, write):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("slomo.store.files.write_file", full)
    assert "No space left on device" in run("export", "--mesh", "cat.glb", code=1).stderr
    assert not list(body.glob("*.glb"))
