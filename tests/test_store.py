"""The artifact store by itself: digests, files, publishing, checkpoints, locks, pointers."""

import errno
import os
import threading
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slomo.errors import InvalidData, Locked, SlomoError
from slomo.stage import Artifact
from slomo.store import Store, digest_input, files
from slomo.store.checkpoint import Checkpoints
from slomo.store.digest import canonical, digest_array, plain, without_wall_times
from slomo.store.files import write_npz

KEY = "0123456789abcdef" * 4
ARTIFACT = Artifact(
    npz={"keypoints.npz": {"t": np.arange(3.0), "names": np.array(["a", "bc"]), "n": np.array(3)}},
    json={"report.json": {"x": np.float32(0.5), "solve_seconds": 1.0, "bad": float("nan")}},
    blobs={"clip.mp4": b"\0\1"},
)
dtypes = st.sampled_from(["<f8", "<f4", "<f2", "<i8", "u1", "?", "<U3", ">i4"])


@given(hnp.arrays(dtypes, hnp.array_shapes(min_dims=0, min_side=0, max_side=4), elements=None))
def test_equal_arrays_have_equal_digests_and_files(tmp_path_factory, x):
    folder = tmp_path_factory.mktemp("npz")
    twin = np.asfortranarray(x.copy()) if x.ndim > 1 else x.copy()
    assert digest_array("x", x) == digest_array("x", twin)
    for name, array in (("a", x), ("b", twin)):
        with open(folder / name, "wb") as f:
            write_npz(f, {"x": array})
    assert (folder / "a").read_bytes() == (folder / "b").read_bytes()
    with np.load(folder / "a", allow_pickle=False) as z:
        assert z["x"].dtype == x.dtype
        assert z["x"].shape == x.shape
        assert z["x"].tobytes() == x.tobytes()


def test_a_digest_knows_name_dtype_shape_and_bytes():
    x = np.zeros((2, 3))
    others = [("y", x), ("x", x.astype(np.int64)), ("x", x.reshape(3, 2)), ("x", x + 1)]
    assert len({digest_array("x", x), *(digest_array(*o) for o in others)}) == 5
    with pytest.raises(TypeError, match="Python objects"):
        digest_array("x", np.array([{}], dtype=object))


def test_canonical_json_is_one_string_for_equal_values():
    assert (
        canonical({"b": (1, 2.0), "a": np.float64(1)})
        == canonical({"a": 1.0, "b": [1, 2.0]})
        == b'{"a":1.0,"b":[1,2.0]}'
    )
    assert plain({"x": np.nan, "y": [np.inf]}) == {"x": None, "y": [None]}
    with pytest.raises(TypeError, match="object"):
        canonical(object())


def test_wall_times_are_not_content():
    report = {"solve_seconds": 1, "mpc_ms_p50": 2, "seconds": 3, "items": [{"cpu_seconds": 1, "x": 1}], "beams": 4}
    assert without_wall_times(report) == {"items": [{"x": 1}], "beams": 4}


def test_a_folder_is_digested_by_names_and_bytes(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.png").write_bytes(b"1")
    first = digest_input(tmp_path / "a", "masks")
    (tmp_path / "a" / "1.png").rename(tmp_path / "a" / "2.png")
    assert digest_input(tmp_path / "a", "masks") != first
    with pytest.raises(InvalidData, match=r"nothing\.mp4: no such file"):
        digest_input(tmp_path / "nothing.mp4", "clip")


def test_publish_and_load(tmp_path):
    store = Store(tmp_path)
    m = store.publish("retarget", KEY, ARTIFACT, {"seconds": 1.5})
    assert store.manifest("retarget", KEY) == m
    assert m["directory"] == ".slomo/store/retarget/0123456789abcdef"
    back = store.load(m)
    np.testing.assert_equal(dict(back.npz["keypoints.npz"]), ARTIFACT.npz["keypoints.npz"])
    assert back.json["report.json"] == {"x": 0.5, "solve_seconds": 1.0, "bad": None}
    assert back.blobs["clip.mp4"] == b"\0\1"
    assert list(back.json) == ["report.json"]  # the manifest is not the stage's
    assert store.damaged("retarget", KEY) is None
    assert not store.partial("retarget", KEY).exists()
    faster = Artifact(
        ARTIFACT.npz, {"report.json": dict(ARTIFACT.json["report.json"], solve_seconds=2.0)}, ARTIFACT.blobs
    )
    assert store.publish("retarget", KEY, faster, {})["content"] == m["content"]


@pytest.mark.parametrize("how", ["flip", "shorten", "remove", "manifest"])
def test_damage_is_seen(tmp_path, how):
    store = Store(tmp_path)
    m = store.publish("retarget", KEY, ARTIFACT, {})
    path = tmp_path / m["directory"] / "keypoints.npz"
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif how == "shorten":
        path.write_bytes(data[:-10])
    elif how == "remove":
        path.unlink()
    else:
        (path.parent / "manifest.json").write_text('{"schema": 1')
    assert store.damaged("retarget", KEY)
    if how == "flip":
        assert store.damaged("retarget", KEY) == "keypoints.npz"


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC, errno.EACCES])
def test_a_refused_write_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, number):
    def refuse(path, write):
        raise OSError(number, os.strerror(number), str(path))

    store = Store(tmp_path)
    monkeypatch.setattr("slomo.store.artifacts.write_file", refuse)
    with pytest.raises(SlomoError, match=os.strerror(number)) as e:
        store.publish("retarget", KEY, ARTIFACT, {})
    assert e.value.exit_code == 1
    assert ("slomo gc" in str(e.value)) == (number == errno.ENOSPC)
    assert store.manifest("retarget", KEY) is None


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "slomo.toml"
    files.replace_file(path, b"old")

    def half(path, write):
        path.write_bytes(b"ne")
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(files, "write_file", half)
    with pytest.raises(SlomoError, match="No space left"):
        files.replace_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["slomo.toml"]


def test_checkpoints_keep_two_and_skip_torn_ones(tmp_path):
    points = Checkpoints(tmp_path / "c")
    assert points.load() is None
    for i in range(4):
        points.save(
            {"x": np.full((2, 3), i, np.float32).T, "i": np.array(i), "on": np.array([True])}, {"fraction": i / 4}
        )
    assert len(list((tmp_path / "c").glob("*.safetensors"))) == 2
    state, about = points.load()
    assert (int(state["i"]), state["i"].shape, about["fraction"]) == (3, (), 0.75)
    np.testing.assert_equal(state["x"], np.full((3, 2), 3, np.float32))
    newest = max((tmp_path / "c").glob("*.safetensors"))
    newest.write_bytes(newest.read_bytes()[:-1])
    assert int(points.load()[0]["i"]) == 2
    max((tmp_path / "c").glob("*.json")).write_text("{")
    assert int(points.load()[0]["i"]) == 2
    points.save({"i": np.array(9)}, {"fraction": 0.9})
    assert int(points.load()[0]["i"]) == 9


def test_a_pointer_is_touched_only_when_needed(tmp_path):
    store, clip = Store(tmp_path), tmp_path / "clip.mp4"
    clip.write_bytes(b"")
    content = {"stage": "decode", "key": KEY}
    path = store.pointer_path("decode")

    def age(seconds):
        os.utime(path, (path.stat().st_mtime - seconds,) * 2)
        return path.stat().st_mtime_ns

    store.point("decode", content, touch=False, after=[clip])
    made = path.stat().st_mtime_ns
    store.point("decode", content, touch=False, after=[clip, tmp_path / "absent"])
    assert path.stat().st_mtime_ns == made
    made = age(100)  # now the clip is newer
    store.point("decode", content, touch=False, after=[clip])
    assert path.stat().st_mtime_ns > made
    made = age(1)
    store.point("decode", content, touch=True, after=[])
    assert path.stat().st_mtime_ns > made
    assert store.pointers() == {"decode": content}


def test_one_process_waits_for_the_other(tmp_path):
    store, notes, order = Store(tmp_path), [], []

    def second():
        with Store(tmp_path).lock("decode", KEY, wait=True, note=notes.append, check=lambda: None):
            order.append("second")

    with store.lock("decode", KEY, wait=True, note=notes.append, check=lambda: None):
        assert f"pid {os.getpid()}" in store.holder("decode", KEY)
        with (
            pytest.raises(Locked, match=f"decode is being made by pid {os.getpid()}") as e,
            Store(tmp_path).lock("decode", KEY, wait=False, note=notes.append, check=lambda: None),
        ):
            pass
        assert e.value.exit_code == 75
        thread = threading.Thread(target=second)
        thread.start()
        while not notes:
            time.sleep(0.01)
        order.append("first")
    thread.join()
    assert order == ["first", "second"]
    assert notes[0].startswith(f"waiting for decode: pid {os.getpid()}, `")
    assert store.holder("decode", KEY) is None


def test_unused_artifacts(tmp_path):
    store = Store(tmp_path)
    keys = [str(i) * 64 for i in range(4)]
    for key in keys[:3]:
        store.publish("decode", key, ARTIFACT, {})
    store.checkpoints("decode", keys[3]).save({"x": np.zeros(1)}, {})
    store.point("decode", {"stage": "decode", "key": keys[0]}, touch=True, after=[])
    names = {(p.parents[1].name, p.name[0]) for p in store.unused({("decode", keys[1])})}
    assert names == {("store", "2"), ("partial", "3")}
    with store.lock("decode", keys[3], wait=True, note=print, check=lambda: None):
        assert {p.name[0] for p in store.unused(set())} == {"1", "2"}


def test_npz_time_stamps_are_fixed(tmp_path: Path):
    with open(tmp_path / "x.npz", "wb") as f:
        write_npz(f, {"b": np.zeros(1), "a": np.zeros(1)})
    infos = zipfile.ZipFile(tmp_path / "x.npz").infolist()
    assert [i.filename for i in infos] == ["a.npy", "b.npy"]
    assert {i.date_time for i in infos} == {(1980, 1, 1, 0, 0, 0)}
