"""The refinement: what it may do to a fit, that it goes on to the same bits, and that each part can be switched off."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
import torch

from slomo.mesh import SkinnedMesh
from slomo.reconstruct import refine_stage
from slomo.reconstruct.descent import Plan
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fit_stage import run_fit
from slomo.reconstruct.physics.learn import PhysicsConfig
from slomo.reconstruct.refine_stage import ReconstructConfig, run_refine
from slomo.stage import Artifact, Inputs, Silent
from test_fit import Stops, _inputs, _walk

SMALL = Plan(
    FieldsConfig(rays=64, samples=8, coarse=12, width=16, features=4, delta_width=8, background_width=8),
    PhysicsConfig(iterations=(3, 3), dt=0.005),
    appearance=6, joint=6, rounds=2, render=6,
)  # fmt: skip
CONFIG = ReconstructConfig(iterations=(6, 4, 4, 24, 6), candidates=3, gait_phases=2, fps=6)


@functools.cache
def fit_of_a_walk() -> Inputs:
    torch.set_num_threads(1)
    _, masks, flow = _walk()
    inputs = _inputs(masks, flow)
    return Inputs(artifacts={**inputs.artifacts, "fit": run_fit(inputs, CONFIG, Silent())})


@pytest.fixture(scope="module")
def fitted() -> Inputs:
    return fit_of_a_walk()


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setitem(refine_stage.PLANS, "normal", SMALL)


def _steps(artifact: Artifact) -> list[dict]:
    return artifact.json["report.json"]["search"]["refinement"]


def test_every_step_is_told_and_none_makes_the_picture_worse(fitted):
    out = run_refine(fitted, CONFIG, Silent())
    steps = _steps(out)
    assert [s["step"] for s in steps] == ["appearance", "fields", "round 1", "round 2"]
    for before, after in itertools.pairwise(steps):
        best = before["loss_after"] if before["kept"] else before["loss_before"]
        assert after["loss_before"] == pytest.approx(best, abs=1e-4)
    assert all(s["loss_after"] <= 1.021 * s["loss_before"] for s in steps if s["kept"])
    assert {"windows", "lost_windows"} <= steps[2]["physics"].keys()
    assert SkinnedMesh.from_arrays(out.npz["mesh.npz"]).faces.shape[1] == 3


@pytest.mark.parametrize("saves", [1, 3, 6])
def test_an_interrupted_refinement_resumes_to_the_same_bits(fitted, saves: int):
    whole = run_refine(fitted, CONFIG, Silent())
    first = Stops(saves)
    with pytest.raises(KeyboardInterrupt):
        run_refine(fitted, CONFIG, first)
    again = run_refine(fitted, CONFIG, Stops(99, first.saved))
    assert _steps(again) == _steps(whole)
    for name, arrays in whole.npz.items():
        for k, v in arrays.items():
            np.testing.assert_array_equal(again.npz[name][k], v, err_msg=k)


@pytest.mark.parametrize(
    ("off", "left"),
    [
        ({"fields": False}, ["round 1", "round 2"]),
        ({"physics": False}, ["appearance", "fields"]),
        ({"quality": "draft"}, []),
    ],
)
def test_parts_are_switched_off(fitted, off: dict, left: list[str]):
    out = run_refine(fitted, dataclasses.replace(CONFIG, **off), Silent())
    assert [s["step"] for s in _steps(out)] == left
    assert len(out.npz["mesh.npz"]["vertices"]) > 100
