"""The prior's network and its training, on samples so simple that the answers are known."""

import json
from dataclasses import replace

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from slomo.errors import InvalidData, MissingInput, UsageError
from slomo.prior import augment, dataset, metrics, objective
from slomo.prior.export import onnx_bytes
from slomo.prior.inference import OUTPUTS, Prior, mirrored_crops, packaged
from slomo.prior.labels import BINS, labels, rotation_of, view_of
from slomo.prior.network import Network, NetworkConfig, Output, network
from slomo.prior.train import train
from slomo.prior.trainer import TrainConfig, Trainer
from slomo.skeleton import load_skeleton
from slomo.stage import Silent

KNOWN = labels(load_skeleton("quadruped"))
SMALL = NetworkConfig(widths=(8, 8, 8, 16), blocks=(1, 1, 1), heads=2)
S0 = 160


def fake(rng, n=8):
    """Boxes with a head, seen from the left (facing left in the picture) or from the right."""
    P, K = len(KNOWN.parts), len(KNOWN.keypoints)
    out = {
        "rgb": rng.integers(0, 255, (n, S0, S0, 3)).astype(np.uint8),
        "mask": np.zeros((n, S0, S0), np.uint8),
        "flow": np.zeros((n, S0, S0, 2), np.float16),
        "parts": np.zeros((n, S0, S0), np.uint8),
        "surface": np.zeros((n, S0, S0, 3), np.int8),
        "keypoints": np.zeros((n, K, 2), np.float32),
        "visible": np.ones((n, K), np.uint8),
        "azimuth": np.zeros(n, np.float32),
        "up": np.tile(np.array([0.0, -1.0, 0.0], np.float32), (n, 1)),
    }
    for i in range(n):
        left, right = int(rng.integers(20, 30)), int(rng.integers(110, 140))
        height = int(rng.integers(25, 45))
        parts = out["parts"][i]
        parts[80 - height : 80 + height, left:right] = 1
        parts[80 - height : 80, left : left + 30] = 3
        for p in range(4, P + 1):
            u = left + (right - left - 6) * (p - 4) // (P - 3)
            parts[80 + height - 20 : 80 + height, u : u + 6] = p
        out["mask"][i] = parts > 0
        out["surface"][i][parts > 0] = (10, 8, -4)
        out["keypoints"][i] = np.stack([np.linspace(left, right, K), np.linspace(80 - height, 80 + height, K)], -1)
        out["azimuth"][i] = np.pi / 2
        out["flow"][i][parts > 0] = (-2, 0.5)
        if i % 2:
            row = augment.mirrored(sample_of(out, i), KNOWN)
            for name in ("rgb", "mask", "flow", "parts", "surface", "keypoints", "visible", "azimuth", "up"):
                out[name][i] = getattr(row, name)
    return out


def sample_of(arrays, i):
    row = {k: v[i] for k, v in arrays.items()}
    return augment.Sample(**row | {"flow": row["flow"].astype(np.float32), "azimuth": float(row["azimuth"])})


def write_shards(folder, count=3, n=8):
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    names = [f"shard-{i:05d}.npz" for i in range(count)]
    for name in names:
        np.savez(folder / name, **fake(rng, n))
    (folder / "dataset.json").write_text(json.dumps({"recipe": {}, "shards": dict.fromkeys(names, "")}))
    return folder


# ---- the network


@pytest.mark.parametrize("kind", ["quadruped", "human"])
def test_shapes_at_any_multiple_of_32_and_size(kind):
    known = labels(load_skeleton(kind))
    net = network(known).eval()
    P, K = len(known.parts), len(known.keypoints)
    assert sum(p.numel() for p in net.parameters()) <= 1.4e6
    for side in (64, 96, 160):
        with torch.inference_mode():
            out = net(torch.zeros(2, 6, side, side))
        assert [tuple(x.shape[1:]) for x in out] == [
            (P + 1, side // 2, side // 2),
            (4, side // 2, side // 2),
            (K, side // 4, side // 4),
            (K,),
            (BINS,),
            (3,),
        ]


def test_export_says_the_same_as_torch_and_stores_halves(tmp_path):
    torch.manual_seed(0)
    net = Network(5, 3, SMALL)
    for _ in range(3):  # batch norms that are not the identity
        net(torch.randn(4, 6, 64, 64) * 2 + 1)
    about = {"kind": "quadruped", "keypoints": ["a"], "parts": ["b"], "size": 64, "temperature": {"view": 1.5}}
    data = onnx_bytes(net, about)
    assert data == onnx_bytes(net, about)
    model = onnx.load_from_string(data)
    stored = sum(
        np.prod(w.dims) * (2 if w.data_type == onnx.TensorProto.FLOAT16 else 4) for w in model.graph.initializer
    )
    numbers = sum(p.numel() for p in net.parameters())
    assert stored < 2.2 * numbers + 2000
    path = tmp_path / "net.onnx"
    path.write_bytes(data)
    prior = Prior(path)
    assert (prior.kind, prior.size, prior.temperature["view"], prior.temperature["up"]) == ("quadruped", 64, 1.5, 1.0)
    session = onnxruntime.InferenceSession(data)
    net.eval()
    for n, side in ((1, 64), (3, 96)):
        x = torch.randn(n, 6, side, side)
        with torch.inference_mode():
            wanted = net(x)
        for name, mine, its in zip(OUTPUTS, wanted, session.run(OUTPUTS, {"input": x.numpy()}), strict=True):
            mine = mine.numpy()
            assert its.shape == mine.shape
            assert np.abs(its - mine).max() < 0.02 * max(np.abs(mine).max(), 1), name


@pytest.mark.parametrize("kind", ["quadruped", "human"])
def test_a_mirrored_crop_gets_the_mirrored_answer(kind):
    crops = np.random.default_rng(0).normal(size=(2, 6, 64, 64)).astype(np.float32)
    path, known = packaged(kind), labels(load_skeleton(kind))
    assert path is not None
    prior = Prior(path)
    one, other = prior(crops), prior(mirrored_crops(crops))
    np.testing.assert_allclose(other.parts, one.parts[:, known.mirror_part, :, ::-1], atol=1e-5)
    np.testing.assert_allclose(other.heat, one.heat[:, known.mirror_keypoint, :, ::-1], atol=1e-5)
    np.testing.assert_allclose(other.seen, one.seen[:, known.mirror_keypoint], atol=1e-5)
    np.testing.assert_allclose(other.view[:, 5], one.view[:, -5], atol=1e-5)
    np.testing.assert_allclose(other.surface[:, 1], -one.surface[:, 1, :, ::-1], atol=1e-4)
    np.testing.assert_allclose(other.up, one.up * [-1, 1, 1], atol=1e-4)


# ---- augmentation


def test_a_mirror_swaps_left_and_right_and_two_give_the_sample_back():
    sample = sample_of(fake(np.random.default_rng(1)), 0)
    other = augment.mirrored(sample, KNOWN)
    k, p = KNOWN.keypoints.index, KNOWN.parts.index
    u, v = sample.keypoints[k("front_left_paw")]
    assert np.allclose(other.keypoints[k("front_right_paw")], (S0 - 1 - u, v))
    v, u = np.argwhere(sample.parts == 1 + p("hind_left_lower"))[0]
    assert other.parts[v, S0 - 1 - u] == 1 + p("hind_right_lower")
    assert other.surface[v, S0 - 1 - u].tolist() == [10, -8, -4]
    assert other.flow[v, S0 - 1 - u].tolist() == [2, 0.5]
    assert other.azimuth == -sample.azimuth
    again = augment.mirrored(other, KNOWN)
    for name in ("rgb", "mask", "flow", "parts", "surface", "keypoints", "visible", "azimuth", "up"):
        assert np.allclose(getattr(again, name), getattr(sample, name), atol=1e-4), name


def test_the_view_of_a_mirrored_body_is_what_the_mirror_says():
    rng = np.random.default_rng(2)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    azimuth, up = view_of(R)
    seen = np.diag([-1, 1, 1]) @ R @ np.diag([1, -1, 1])  # mirrored picture of a body that is its own mirror image
    assert np.allclose(view_of(seen)[0], -azimuth)
    assert np.allclose(view_of(seen)[1], up * (-1, 1, 1))


def test_labels_follow_the_crop_when_it_is_turned():
    """A marked pixel at each key point is found where the key point goes; the body's up turns as the picture does."""
    sample = sample_of(fake(np.random.default_rng(3)), 0)
    parts = np.zeros((S0, S0), np.uint8)
    k = KNOWN.keypoints.index("hind_left_hip")
    sample.keypoints[k] = (60, 70)
    cv2.circle(parts, (60, 70), 4, 9, -1)
    sample = replace(sample, parts=parts)
    config = replace(augment.without(), turn=0.5, shift=0.05, scale=0.1, stretch=0.1)
    for seed in range(5):
        e = augment.example(sample, KNOWN, config, np.random.default_rng(seed), size=128)
        at = np.argwhere(e.parts == 9).mean(0)[::-1]
        assert np.abs((at + 0.5) * 2 - 0.5 - e.keypoints[k]).max() < 1.2
        # up is -v of the stored sample: two key points one above the other tell where that went, but for the stretch
        above = replace(sample, keypoints=sample.keypoints + np.array([0, -20], np.float32))
        moved = (
            augment.example(above, KNOWN, config, np.random.default_rng(seed), size=128).keypoints[k] - e.keypoints[k]
        )
        assert np.degrees(np.arccos(moved @ e.up[:2] / np.linalg.norm(moved))) < 12
        assert np.isclose(np.linalg.norm(e.up), 1)
        # the flow turns and scales as the picture does
        inside = e.input[3] > 0.99
        u, v = e.input[4][inside].mean(), e.input[5][inside].mean()
        a = augment.example(
            replace(sample, keypoints=sample.keypoints + np.array([-2, 0.5], np.float32)),
            KNOWN, config, np.random.default_rng(seed), size=128,
        ).keypoints[k] - e.keypoints[k]  # fmt: skip
        assert abs(np.cross(np.r_[u, v, 0], np.r_[a, 0])[2]) < 0.02 * np.hypot(u, v) * np.hypot(*a)


def test_without_augmentation_the_sample_is_its_own_crop():
    sample = sample_of(fake(np.random.default_rng(4)), 0)
    e = augment.example(sample, KNOWN, augment.without(), np.random.default_rng(0), size=128)
    assert e.azimuth == sample.azimuth
    assert np.isclose(np.hypot(e.input[4], e.input[5])[e.input[3] > 0.99].mean(), 1, atol=0.05)
    assert abs((e.input[3] > 0.5).any(0).sum() - 128 / 1.25) <= 2 or abs((e.input[3] > 0.5).any(1).sum() - 102.4) <= 2


def test_noisy_masks_differ_from_the_true_one_and_keep_most_of_it():
    sample = sample_of(fake(np.random.default_rng(5)), 0)
    found = []
    for seed in range(40):
        mask = augment.noisy_mask(sample, augment.AugmentConfig(clean_mask=0.0), np.random.default_rng(seed))
        assert set(np.unique(mask)) <= {0, 1}
        found.append((mask & sample.mask).sum() / (mask | sample.mask).sum())
    assert min(found) > 0.35
    assert 0.6 < np.mean(found) < 0.97


# ---- what is wanted


def test_wanted_heat_and_view_are_distributions_around_the_truth():
    e = [
        augment.example(
            sample_of(fake(np.random.default_rng(6)), i), KNOWN, augment.without(), np.random.default_rng(0), size=128
        )
        for i in range(2)
    ]
    batch = dataset.collate(e)
    heat, inside = objective.wanted_heat(batch, 32, 1.2)
    assert torch.allclose(heat.sum((-2, -1)), torch.ones(heat.shape[:2]), atol=1e-4)
    v, u = np.divmod(heat[0, 3].flatten().argmax().item(), 32)
    assert inside[0, 3]
    assert np.abs(np.array([u, v]) - (e[0].keypoints[3] + 0.5) / 4 + 0.5).max() <= 0.51
    view = objective.wanted_view(torch.tensor([0.0, np.pi / 2, -np.pi + 1e-3]), 0.2)
    assert view.argmax(1).tolist() == [0, 9, 18]
    assert torch.allclose(view[0, 1], view[0, -1])
    assert np.allclose(metrics.azimuth_of(view.numpy()), [0, np.pi / 2, -np.pi], atol=0.02)


def test_temperatures_calm_a_network_that_is_too_sure():
    torch.manual_seed(0)
    batch = dataset.collate(
        [
            augment.example(
                sample_of(fake(np.random.default_rng(i)), 0),
                KNOWN,
                augment.without(),
                np.random.default_rng(0),
                size=64,
            )
            for i in range(4)
        ]
    )
    K, P = len(KNOWN.keypoints), len(KNOWN.parts)
    sure = torch.zeros(4, BINS)
    sure[:, [9, 27]] = 20.0  # right or its mirror image: half of the samples are wrong by as much as can be
    batch = batch._replace(azimuth=torch.tensor([np.pi / 2, -np.pi / 2, np.pi / 2 + 0.5, 0.3]))
    surface = torch.cat([batch.surface + 0.2, torch.full((4, 1, 32, 32), np.log(0.1))], 1)
    out = Output(torch.randn(4, P + 1, 32, 32), surface, torch.randn(4, K, 16, 16), torch.randn(4, K), sure, batch.up)
    fit = objective.Temperatures()
    fit.add(out, batch)
    best = fit.best()
    assert best["view"] == pytest.approx(6.0)
    assert best["surface"] == pytest.approx(2.0, rel=1e-3)


def test_weighted_classes_are_taken_back_out_of_the_logits():
    """What is learnt with weights w from pixels of which a share p is of a class is w p; less log w it is p."""
    net = Network(4, 2, SMALL)
    parts = torch.tensor([0] * 90 + [1] * 9 + [2])
    weights = objective.class_weights(parts, 3)
    assert torch.isclose((weights[parts]).mean(), torch.tensor(1.0))
    share = torch.tensor([0.9, 0.09, 0.01])
    with torch.no_grad():
        net.dense.weight[:3] = 0
        net.parts_bias.copy_(torch.log(share * weights))
        net.parts_bias.sub_(torch.log(weights))
        got = torch.softmax(net.eval()(torch.randn(1, 6, 64, 64)).parts, 1)[0, :, 3, 3]
    assert torch.allclose(got, share, atol=1e-5)


def test_sides_and_views_have_known_scores():
    names = KNOWN.keypoints
    rng = np.random.default_rng(7)
    true = rng.uniform(0, 100, (5, len(names), 2))
    size = np.full(5, 30.0)
    assert metrics.share(metrics.sides_right(true, true, size, names)) == 1
    assert metrics.share(metrics.sides_right(true[:, KNOWN.mirror_keypoint], true, size, names)) == 0
    assert len(metrics.leg_pairs(names)) == 6
    R = rotation_of(np.array([0.3, -2.0]), np.array([[0.1, -1, 0.2], [0, -1, -0.3]]))
    view = objective.wanted_view(torch.tensor([0.3, -2.0 + 0.5]), 0.2).numpy()
    azimuth, rotation = metrics.view_errors(view, R[..., :, 2], R)
    assert np.allclose(azimuth, [0, 0.5], atol=0.03)
    assert np.allclose(rotation, azimuth, atol=1e-4)


# ---- training


def test_eight_samples_are_learnt_by_heart(tmp_path):
    paths, _ = dataset.find_shards(write_shards(tmp_path / "quadruped", 1))
    config = TrainConfig(
        steps=100,
        batch=8,
        size=64,
        network=NetworkConfig(widths=(16, 16, 16, 16), blocks=(1, 1, 1)),
        rate=1e-2,
        augment=augment.without(),
    )
    batch = next(dataset.batches(paths, KNOWN, config.augment, size=64, batch=8, seed=0))
    trainer = Trainer(KNOWN, config)
    weights = objective.class_weights(batch.parts, len(KNOWN.parts) + 1)
    terms = [trainer.train(batch, weights) for _ in range(config.steps)]
    assert terms[-1]["parts"] < 0.4 * terms[0]["parts"]
    assert terms[-1]["surface"] < terms[0]["surface"] - 1
    assert terms[-1]["heatmaps"] < terms[0]["heatmaps"] - 1
    assert terms[-1]["up"] < 0.02
    assert terms[-1]["view"] < 2.2  # both sides told apart: the spread of what is wanted alone is 1.6
    assert np.isfinite(list(terms[-1].values())).all()


def test_a_stopped_training_ends_as_one_that_was_not(tmp_path, monkeypatch):
    torch.set_num_threads(1)
    data = write_shards(tmp_path / "data" / "quadruped").parent
    config = TrainConfig(steps=6, batch=8, size=64, network=SMALL)
    monkeypatch.setattr("slomo.prior.train.LOG_EVERY", 2)
    monkeypatch.setattr("slomo.prior.train.SAVE_EVERY", 0.0)

    class Killed(Silent):
        def update(self, fraction, message=""):
            if fraction > 0.5:
                raise KeyboardInterrupt

    whole = train(data, tmp_path / "a", config, Silent())
    with pytest.raises(KeyboardInterrupt):
        train(data, tmp_path / "b", config, Killed())
    assert whole.read_bytes() == train(data, tmp_path / "b", config, Silent()).read_bytes()
    record = json.loads((tmp_path / "b" / "quadruped.json").read_text())
    assert record["digest"] == Prior(whole).digest
    assert record["metrics"]["true masks"]["samples"] == 8
    assert record["config"]["steps"] == 6
    rows = (tmp_path / "b" / "quadruped.csv").read_text().splitlines()
    assert rows == (tmp_path / "a" / "quadruped.csv").read_text().splitlines()
    assert [r.split(",")[0] for r in rows] == ["step", "2", "4", "6"]
    assert (tmp_path / "b" / "quadruped.png").stat().st_size > 1000


def test_what_is_wrong_with_the_data_is_said_in_a_line(tmp_path):
    with pytest.raises(MissingInput, match="slomo dataset"):
        dataset.find_shards(tmp_path)
    folder = write_shards(tmp_path / "quadruped", 2)
    (folder / "shard-00001.npz").unlink()
    with pytest.raises(InvalidData, match=r"shard-00001\.npz: a shard of the data set is missing"):
        dataset.find_shards(folder)
    with pytest.raises(InvalidData, match="fewer than a batch"):
        next(dataset.batches([folder / "shard-00000.npz"], KNOWN, augment.without(), size=64, batch=99, seed=0))
    with pytest.raises(InvalidData, match="other key points"):
        dataset.Shards([folder / "shard-00000.npz"], labels(load_skeleton("human")))
    with pytest.raises(UsageError, match="multiples of 32"):
        TrainConfig(size=100)


def test_batches_follow_from_the_step_alone(tmp_path):
    paths, _ = dataset.find_shards(write_shards(tmp_path / "quadruped", 3))
    view = dict(size=64, batch=8, seed=5)
    stream = dataset.batches(paths, KNOWN, augment.AugmentConfig(), **view)
    first = [next(stream) for _ in range(6)]
    later = dataset.batches(paths, KNOWN, augment.AugmentConfig(), **view, start=4)
    for a, b in zip(first[4], next(later), strict=True):
        assert torch.equal(a, b)
    assert dataset.split(paths, held_out=0.04) == (paths[:2], paths[2:])
