"""Long clips in chunks: where they are cut, what a cut leaves, and that joining gives back the motion."""

import numpy as np
import pytest
import torch

from slomo.reconstruct import chunks
from slomo.reconstruct.fit_stage import prepare, run_fit
from slomo.reconstruct.kinematics import yaw_pitch_roll
from slomo.reconstruct.refine_stage import ReconstructConfig, run_refine
from slomo.reconstruct.run import from_arrays
from slomo.stage import Artifact, Inputs, Silent
from test_fit import FPS, Stops, T, _inputs, _walk

CONFIG = ReconstructConfig(quality="draft", iterations=(4, 3, 3, 4, 2), candidates=3, gait_phases=2, fps=6)


@pytest.fixture
def short(monkeypatch):
    """Two seconds are a long clip, cut into three."""
    monkeypatch.setattr(chunks, "LONG", 1.5)
    monkeypatch.setattr(chunks, "LENGTH", 1.0)
    monkeypatch.setattr(chunks, "OVERLAP", 0.4)


@pytest.fixture(scope="module")
def walk() -> Inputs:
    torch.set_num_threads(1)
    _, masks, flow = _walk()
    return _inputs(masks, flow)


@pytest.mark.parametrize("seconds", [3.0, 12.0, 12.5, 20.0, 61.3])
def test_chunks_cover_a_clip_and_overlap(seconds):
    t = np.arange(0, seconds + 1e-9, 1 / 15)
    found = chunks.bounds(t)
    assert found[0][0] == 0
    assert found[-1][1] == len(t)
    assert (len(found) == 1) == (seconds <= chunks.LONG)
    for (_, end), (start, _) in zip(found, found[1:], strict=False):  # noqa: RUF007
        assert end - start >= 0.9 * chunks.OVERLAP * 15
    assert all(t[b - 1] - t[a] <= chunks.LENGTH + 0.1 for a, b in found if len(found) > 1)


def test_a_chunk_that_hardly_shows_the_subject_is_none_of_its_own():
    where = [(0, 10), (8, 20), (18, 30), (28, 40)]
    shown = np.ones(40, bool)
    assert chunks.with_subject(where, shown) == where
    shown[:12] = False
    assert chunks.with_subject(where, shown) == [(0, 20), (18, 30), (28, 40)]
    shown[:] = np.arange(40) < 27
    assert chunks.with_subject(where, shown) == [(0, 10), (8, 20), (18, 40)]
    assert chunks.with_subject(where, np.arange(40) == 35) == [(0, 40)]


def test_a_cut_is_the_clip_of_those_frames(walk):
    said = dict(
        frame=np.arange(0, T, 2), view=np.tile(np.eye(36)[5], (T // 2, 1)), keypoint_names=np.array(["nose"]),
        keypoints=np.arange(T)[::2, None, None] * np.ones((1, 1, 2)), keypoint_side=np.ones(1),
    )  # fmt: skip
    about = {"report.json": {"skeleton": "quadruped"}}
    whole = Inputs(artifacts={**walk.artifacts, "evidence": Artifact(npz={"evidence.npz": said}, json=about)})
    part = chunks.cut(whole, 6, 18)
    obs = prepare(part, CONFIG).problem.obs
    assert len(obs.t) == 12
    assert float(obs.t[0]) == pytest.approx(6 / FPS)
    z = part.artifacts["evidence"].npz["evidence.npz"]
    assert z["frame"].tolist() == [0, 2, 4, 6, 8, 10]
    assert z["keypoints"][:, 0, 0].tolist() == [6, 8, 10, 12, 14, 16]
    assert z["keypoint_names"].tolist() == ["nose"]


def test_joined_chunks_move_as_the_chunks_did(walk, short):
    where = chunks.bounds(np.arange(T) / FPS)
    assert len(where) == 3
    whole = prepare(walk, CONFIG).problem
    parts = [prepare(chunks.cut(walk, *w), CONFIG).problem for w in where]
    one = from_arrays(run_fit(walk, CONFIG, Silent()).npz["fit.npz"])
    runs = []
    for (a, b), part in zip(where, parts, strict=True):  # each says what one fit of the whole says
        position, R, q = whole.path(one.x, one.guess, one.x["shape.log_length"].exp(), torch.arange(a, b))
        yaw, pitch, roll = (a.numpy() for a in yaw_pitch_roll(R[0].double()))
        guess = one.guess.pick(torch.zeros(1, dtype=torch.long))
        f = lambda x: torch.as_tensor(x, dtype=torch.float32)[None]  # noqa: E731
        guess = type(guess)(position, f(yaw), f(np.stack([pitch, roll], -1)), q, guess.stance[:, a:b])
        x = part.variables(1, torch.Generator().manual_seed(0)) | {k: v for k, v in one.x.items() if "shape" in k}
        runs.append(type(one)(one.phase, x, guess, one.labels, one.log))
    run = chunks.join(whole, [p.path for p in parts], runs, where)
    wanted = whole.path(one.x, one.guess, one.x["shape.log_length"].exp(), torch.arange(T))
    found = whole.path(run.x, run.guess, run.x["shape.log_length"].exp(), torch.arange(T))
    for x, y in zip(found, wanted, strict=True):
        torch.testing.assert_close(x, y, atol=1e-4, rtol=1e-4)


def test_a_long_clip_is_fitted_in_chunks_and_resumes_to_the_same_bits(walk, short):
    whole = run_fit(walk, CONFIG, Silent())
    report = whole.json["report.json"]
    assert len(report["search"]["chunks"]) == 3
    assert report["hypothesis"]["chunks"] == 3
    first = Stops(7)
    with pytest.raises(KeyboardInterrupt):
        run_fit(walk, CONFIG, first)
    assert int(first.saved["chunks"]) > 0
    again = run_fit(walk, CONFIG, Stops(99, first.saved))
    for k, v in whole.npz["fit.npz"].items():
        np.testing.assert_array_equal(again.npz["fit.npz"][k], v, err_msg=k)
    out = run_refine(Inputs(artifacts={**walk.artifacts, "fit": whole}), CONFIG, Silent())
    assert np.isfinite(out.npz["keypoints.npz"]["keypoints"]).all()
    assert out.npz["keypoints.npz"]["keypoints"].shape[0] == T
