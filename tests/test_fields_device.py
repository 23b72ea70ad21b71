"""The fields on another device: what they look at goes there, and the outcome is that of the CPU. No GPU was here: the
device is the stand-in of `elsewhere`."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from elsewhere import DEVICE, Elsewhere
from slomo.errors import UsageError
from slomo.reconstruct import refine_stage
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.device import find, on
from slomo.reconstruct.fit_stage import run_fit
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.refine_stage import ReconstructConfig, run_refine
from slomo.skeleton import load_skeleton
from slomo.stage import Inputs, Silent
from test_descent import CONFIG, SMALL
from test_fit import Stops, _inputs, _walk

SHORT = dataclasses.replace(SMALL, appearance=2, joint=3, rounds=1, render=2)


@pytest.fixture(scope="module")
def fitted() -> Inputs:
    torch.set_num_threads(1)
    _, masks, flow = _walk()
    inputs = _inputs(masks, flow)
    return Inputs(artifacts={**inputs.artifacts, "fit": run_fit(inputs, CONFIG, Silent())})


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setitem(refine_stage.PLANS, "normal", SHORT)
    # "auto" takes the published sizes there, which are not small.
    monkeypatch.setattr(FieldsConfig, "published", lambda: SMALL.fields)


def test_a_refinement_elsewhere_is_that_of_the_cpu_and_resumes(fitted, monkeypatch: pytest.MonkeyPatch):
    here = run_refine(fitted, CONFIG, Silent())
    monkeypatch.setattr(refine_stage, "find", lambda name: DEVICE)
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
        assert float((a * 2 + torch.tensor(1.0)).sum()) == 9


def test_a_skeletons_tables_go_along():
    kin = Kinematics(load_skeleton("quadruped"))
    with Elsewhere():
        moved = on(kin, DEVICE)
        assert all(v.device == DEVICE for v in vars(moved).values() if isinstance(v, torch.Tensor))
        assert moved.levels[0][0].device == DEVICE
    assert kin.offset.device.type == "cpu"


def test_the_device_is_a_gpu_where_there_is_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert find("auto").type == find("cuda").type == "cuda"
    assert find("cpu").type == "cpu"
    with pytest.raises(UsageError, match="finds 1 GPU"):
        find("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert find("auto").type == "cpu"
    with pytest.raises(UsageError, match=re.escape("cuda: PyTorch finds no GPU")):
        find("cuda")


def test_sizes_are_the_published_ones_on_a_gpu(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    gpu = torch.device("cuda")
    assert ReconstructConfig().plan().fields == FieldsConfig()
    assert ReconstructConfig().plan(gpu).fields == FieldsConfig.published()
    assert ReconstructConfig(networks="small").plan(gpu).fields == FieldsConfig()
    with pytest.raises(UsageError, match="no device 'gpu'"):
        dataclasses.replace(CONFIG, device="gpu")
