"""The fields on another device: what they look at goes there, and the outcome is that of the CPU. No GPU was here: the
device is the stand-in of `elsewhere`."""

import dataclasses

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from elsewhere import DEVICE, Elsewhere
from slomo.cli import app
from slomo.errors import StageFailed, UsageError
from slomo.reconstruct import refine_stage
from slomo.reconstruct.fields.device import VARIABLE, find, on
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.refine_stage import run_refine
from slomo.skeleton import load_skeleton
from slomo.stage import Inputs, Silent
from test_descent import CONFIG, SMALL, fit_of_a_walk
from test_fit import Stops

SHORT = dataclasses.replace(SMALL, appearance=2, joint=3, rounds=1, render=2)


@pytest.fixture(scope="module")
def fitted() -> Inputs:
    return fit_of_a_walk()


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setitem(refine_stage.PLANS, "normal", SHORT)
    monkeypatch.setitem(refine_stage.NETWORKS, "small", lambda: SMALL.fields)
    monkeypatch.delenv(VARIABLE, raising=False)


def test_a_refinement_elsewhere_is_that_of_the_cpu_and_resumes(fitted, monkeypatch: pytest.MonkeyPatch):
    here = run_refine(fitted, CONFIG, Silent())
    monkeypatch.setattr(refine_stage, "find", lambda large: DEVICE)
    first = Stops(1)  # in the step that changes fields and pose
    with Elsewhere() as elsewhere:
        there = run_refine(fitted, CONFIG, Silent())
        with pytest.raises(KeyboardInterrupt):
            run_refine(fitted, CONFIG, first)
        again = run_refine(fitted, CONFIG, Stops(99, first.saved))
    assert elsewhere.count > 1000
    assert there.json["report.json"]["device"] == str(DEVICE)
    points, wanted = (out.npz["keypoints.npz"]["keypoints"] for out in (there, here))
    np.testing.assert_allclose(points, wanted, atol=1e-5)  # m; sums may round in another order
    for k, v in there.npz["keypoints.npz"].items():
        np.testing.assert_array_equal(again.npz["keypoints.npz"][k], v, err_msg=k)
    np.testing.assert_array_equal(again.npz["mesh.npz"]["vertices"], there.npz["mesh.npz"]["vertices"])


def test_what_mixes_devices_is_found_out():
    """The stand-in is as strict as a GPU."""
    with Elsewhere():
        a, b = torch.ones(3, device=DEVICE), torch.ones(3)
        with pytest.raises(AssertionError, match="of both devices"):
            _ = a + b
        with pytest.raises(AssertionError, match="values on the CPU"):
            _ = b[torch.zeros(1, dtype=torch.long, device=DEVICE)]
        with pytest.raises(AssertionError, match="of both devices"):
            a.index_put((torch.tensor([0]),), b[:1])
        with pytest.raises(AssertionError, match="of both devices"):
            _ = torch.stack([a.sum(), torch.tensor(1.0)])
        assert float((a * 2 + torch.tensor(1.0)).sum()) == 9


def test_a_skeletons_tables_go_along():
    kin = Kinematics(load_skeleton("quadruped"))
    with Elsewhere():
        moved = on(kin, DEVICE)
        assert all(v.device == DEVICE for v in vars(moved).values() if isinstance(v, torch.Tensor))
        assert moved.levels[0][0].device == DEVICE
    assert kin.offset.device.type == "cpu"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that PyTorch finds")
def test_a_refinement_on_a_gpu_is_that_of_the_cpu_to_rounding(fitted, monkeypatch: pytest.MonkeyPatch):
    here = run_refine(fitted, CONFIG, Silent())
    monkeypatch.setenv(VARIABLE, "cuda")
    there = run_refine(fitted, CONFIG, Silent())
    points, wanted = (out.npz["keypoints.npz"]["keypoints"] for out in (there, here))
    np.testing.assert_allclose(points, wanted, atol=1e-3)


def test_the_device_is_a_gpu_where_there_is_one_and_networks_are_large(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert find(large=True).type == "cuda"
    assert find(large=False).type == "cpu"
    monkeypatch.setenv(VARIABLE, "cuda:0")
    assert find(large=False).type == "cuda"
    monkeypatch.setenv(VARIABLE, "cpu")
    assert find(large=True).type == "cpu"
    monkeypatch.setenv(VARIABLE, "cuda:1")
    with pytest.raises(UsageError, match="finds 1 GPU"):
        find(large=True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="PyTorch finds no GPU"):
        find(large=True)
    monkeypatch.setenv(VARIABLE, "gpu")
    with pytest.raises(UsageError, match="no device 'gpu'"):
        find(large=True)


def test_a_gpu_is_asked_for_only_where_the_fields_would_use_it(fitted, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VARIABLE, "gpu")
    out = run_refine(fitted, dataclasses.replace(CONFIG, quality="draft"), Silent())
    assert out.json["report.json"]["device"] == "cpu"
    with pytest.raises(UsageError, match="no device"):
        run_refine(fitted, CONFIG, Silent())


def test_a_wrong_device_is_told_of_before_anything_begins(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Nothing is made of the clip, which is none; who does without the fields does without their device."""
    monkeypatch.setenv(VARIABLE, "gpu")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.mp4").write_text("no clip")
    call = lambda *more: CliRunner().invoke(app, ["reconstruct", "clip.mp4", *more])  # noqa: E731
    named = call()
    assert named.exit_code == 2
    assert "no device 'gpu'" in named.stderr
    assert "no device" not in call("--quality", "draft").stderr


def test_a_whole_run_needs_a_device_only_for_a_clip_whose_fields_are_fitted(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VARIABLE, "gpu")
    (tmp_path / "clip.mp4").write_text("no clip")
    (tmp_path / "points.npz").write_text("no key points")

    def told(name: str, *more: str) -> bool:
        project = tmp_path / "-".join(("of", name, *more))
        call = ["run", str(tmp_path / name), "--project", str(project), "--robot", "go1", *more]
        return "no device 'gpu'" in CliRunner().invoke(app, call).stderr

    assert told("clip.mp4")
    assert not told("clip.mp4", "--quality", "draft")
    assert not told("points.npz")


def test_a_gpu_with_too_little_memory_is_no_crash(fitted, monkeypatch: pytest.MonkeyPatch):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(refine_stage, "descend", full)
    with pytest.raises(StageFailed, match="networks = small"):
        run_refine(fitted, CONFIG, Silent())
