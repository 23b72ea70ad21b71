"""An animal or a person: told from the clip, unless somebody says so."""

import numpy as np
import pytest

from slomo.prior import stage
from slomo.prior.crop import crop_box
from slomo.prior.evidence import Shots
from slomo.prior.inference import packaged_folder
from slomo.prior.kind import kind_of
from slomo.prior.labels import BINS, labels
from slomo.reconstruct.fit_stage import FitConfig, _named
from slomo.skeleton import list_skeletons, load_skeleton
from slomo.stage import Artifact, Inputs
from slomo.synth.dataset import BODY, Config, make_shard
from test_prior_stage import CELLS, Notes, about, constant_network, heatmap, inputs, run


class Flow:
    def __init__(self, flow):
        self.at = flow.__getitem__


@pytest.mark.parametrize("kind", list_skeletons())
def test_slomo_s_networks_tell_animals_from_people(kind):
    """Rendered bodies that no network has seen, from every side, each as a clip of its own."""
    shard = make_shard(Config(kind=kind, seed=90), 0)
    told = []
    for first in range(0, len(shard["rgb"]), BODY):
        rgb, mask, flow = (shard[k][first : first + BODY] for k in ("rgb", "mask", "flow"))
        n = len(rgb)
        shots = Shots(
            index=np.arange(n), t=np.arange(n) / 10, box=np.array([crop_box(m) for m in mask > 0], float),
            quality=np.ones(n), frames=rgb, masks=mask > 0, motion=Flow(flow.astype(np.float32)),  # pyright: ignore
            travel=np.full((n, BINS), 1 / BINS),
        )  # fmt: skip
        told.append(kind_of(packaged_folder(), shots))
    assert [name for name, _ in told] == [kind] * (64 // BODY)
    assert all(set(clear) == set(list_skeletons()) for _, clear in told)


def network(path, kind, blur):
    """Sees everything about a body as unclearly as `blur` says."""
    known = labels(load_skeleton(kind))
    P, K = len(known.parts), len(known.keypoints)
    cells = np.resize(CELLS, (K, 2))
    outputs = {
        "parts": np.zeros((P + 1, 64, 64)), "surface": np.zeros((4, 64, 64)), "heatmaps": heatmap(cells, 32) / blur,
        "seen": np.full(K, 3.0), "view": np.zeros(BINS), "up": np.array([0.0, -1.0, 0.0]),
    }  # fmt: skip
    metadata = about(kind=kind, keypoints=known.keypoints, parts=known.parts)
    return constant_network(path, outputs, shape=["n", 6, "s", "s"], metadata=metadata)


@pytest.mark.parametrize("kind", list_skeletons())
def test_the_clearer_one_is_taken_and_said(tmp_path, kind):
    for name in list_skeletons():
        network(tmp_path / f"{name}.onnx", name, blur=1 if name == kind else 9)
    notes = Notes()
    arrays, report = run(None, notes, prior=tmp_path)
    assert report["skeleton"] == kind
    assert report["prior"] == f"{kind} ({kind}.onnx)"
    assert max(report["seen_as"], key=report["seen_as"].get) == kind
    assert tuple(arrays["keypoint_names"]) == labels(load_skeleton(kind)).keypoints
    assert any(f"skeleton {kind} (how clearly" in n and "--skeleton takes another" in n for n in notes.said)


def test_whoever_names_a_skeleton_is_believed(tmp_path):
    for name in list_skeletons():
        network(tmp_path / f"{name}.onnx", name, blur=1 if name == "human" else 9)
    report = run(stage.Config(skeleton="quadruped"), prior=tmp_path)[1]
    assert (report["skeleton"], report["prior"], report["seen_as"]) == ("quadruped", "quadruped (quadruped.onnx)", {})


def test_one_network_brings_its_own_skeleton(tmp_path):
    assert run(prior=network(tmp_path / "mine.onnx", "human", 1))[1]["skeleton"] == "human"


def test_without_networks_it_is_an_animal_and_that_is_said():
    notes = Notes()
    assert run(stage.Config(prior="none"), notes)[1]["skeleton"] == "quadruped"
    assert any("--skeleton human for a person" in n for n in notes.said)


def test_a_clip_without_a_subject_is_nobody_s(tmp_path):
    for name in list_skeletons():
        network(tmp_path / f"{name}.onnx", name, blur=1)
    given = inputs(prior=tmp_path)
    packed = given.artifacts["masks"].npz["masks.npz"]
    packed["packed"] = np.zeros_like(packed["packed"])
    report = stage.run(given, stage.Config(), Notes()).json["report.json"]
    assert (report["skeleton"], report["prior"], report["frames"]) == ("quadruped", "none", 0)


def test_the_fit_takes_what_the_evidence_is_about(tmp_path):
    said = Inputs(artifacts={"evidence": Artifact(json={"report.json": {"skeleton": "human"}})}, files={})
    assert _named(said, FitConfig()) == "human"
    assert _named(said, FitConfig(skeleton="quadruped")) == "quadruped"
    assert _named(Inputs(artifacts=said.artifacts, files={"skeleton": tmp_path}), FitConfig()) == tmp_path
    assert _named(Inputs(artifacts={}, files={}), FitConfig()) == "quadruped"
