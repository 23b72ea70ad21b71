"""The prior's training data: labels that agree with each other, the same bytes by seed, and going on after a stop."""

import numpy as np
import pytest

from slomo.errors import UsageError
from slomo.prior.labels import SURFACE_UNIT, labels, rotation_of, toward, view_of
from slomo.skeleton import load_skeleton
from slomo.stage import Silent
from slomo.synth import dataset
from slomo.synth.creature import create, forward, joint_rotation
from slomo.synth.dataset import Config, make_shard, write_dataset
from slomo.synth.moves import move

KINDS = ("quadruped", "human")


@pytest.fixture(scope="module", params=KINDS)
def shard(request):
    config = Config(kind=request.param, samples=64, seed=3)
    return labels(load_skeleton(request.param)), make_shard(config, 0)


def _random_rotations(n):
    q = np.linalg.qr(np.random.default_rng(0).standard_normal((n, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def test_a_view_says_the_whole_rotation():
    R = _random_rotations(50)
    assert np.allclose(rotation_of(*view_of(R)), R, atol=1e-9)


def test_a_view_names_the_side_that_the_camera_is_on():
    # Camera at (0, 3, 0) of a body that is not turned: it looks along -y, at the left flank.
    R_cam_world = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
    azimuth, up = view_of(R_cam_world)
    assert np.isclose(azimuth, np.pi / 2)
    assert np.allclose(up, [0, -1, 0])


def test_turning_towards_the_subject_is_the_least_turn():
    x = np.array([[0.3, -0.2, 1.0], [0, 0, 2.0]])
    R = toward(x)
    assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3))
    assert np.allclose((R @ x[..., None])[..., 0], [[0, 0, np.linalg.norm(v)] for v in x])
    angle = np.arccos((np.trace(R[0]) - 1) / 2)
    assert np.isclose(angle, np.arccos(x[0, 2] / np.linalg.norm(x[0])))


@pytest.mark.parametrize("kind", KINDS)
def test_canonical_points_of_the_resting_capsules_are_where_they_are(kind):
    s = load_skeleton(kind)
    known = labels(s)
    C = len(known.capsule_part)
    up = np.tile([0.0, 0, 1], (C, 1))
    assert np.allclose(known.canonical(np.arange(C), np.zeros(C), up), known.a + known.radii[:, :1] * up)
    rest = s.rest()
    _, p = forward(s, s.offset, np.zeros((s.link_count, 3)))
    assert np.allclose(p, rest)
    assert np.allclose(known.trunk_rotation(rest), np.eye(3))


def test_joint_rotations_agree_with_the_fit():
    torch = pytest.importorskip("torch")
    from slomo.reconstruct.kinematics import joint_rotation as fitted

    q = np.random.default_rng(1).standard_normal((7, 3))
    assert np.allclose(joint_rotation(q), fitted(torch.as_tensor(q)).numpy())


@pytest.mark.parametrize("kind", KINDS)
def test_a_creature_in_its_bind_pose_is_its_mesh(kind):
    c = create(load_skeleton(kind), 5)
    assert np.allclose(c.skin(c.bind_R, c.bind_p), c.vertices)
    assert np.allclose(c.weights.sum(1), 1)
    left = np.array([p.count("left") for p in ("background", *labels(c.skeleton).parts)], bool)
    right = np.array([p.count("right") for p in ("background", *labels(c.skeleton).parts)], bool)
    assert np.median(c.surface[left[c.part], 1]) > 0 > np.median(c.surface[right[c.part], 1])


@pytest.mark.parametrize("kind", KINDS)
def test_creatures_stand_on_the_ground_and_keep_their_bones(kind):
    c = create(load_skeleton(kind), 6)
    s = c.skeleton
    for seed in range(12):
        m = move(c, np.linspace(0, 1, 9), np.random.default_rng(seed))
        assert m.nodes[..., 2].min() > 0
        bones = np.linalg.norm(m.nodes[:, 1:] - m.nodes[:, s.link[1:]], axis=-1)
        assert np.allclose(bones, np.linalg.norm(c.offset[1:], axis=1), atol=1e-9)


def test_heads_are_carried_high_and_low_and_turned_aside():
    skeleton = load_skeleton("quadruped")
    node = skeleton.names.index
    high, aside = [], []
    for seed in range(60):
        c = create(skeleton, seed)
        m = move(c, np.linspace(0, 1, 3), np.random.default_rng(seed))
        if m.name not in {g.name for g in skeleton.gaits}:
            continue
        high.append(m.nodes[1, node("head"), 2] - m.nodes[1, node("withers"), 2])
        turned = m.R[1, node("pelvis")].T @ m.R[1, node("head")][:, 0]
        aside.append(abs(np.arctan2(turned[1], turned[0])))
    assert np.mean(np.array(high) < 0.1) > 0.15
    assert np.mean(np.array(high) > 0.25) > 0.15
    assert np.mean(np.array(aside) > np.radians(40)) > 0.15


def test_people_differ_in_front_and_behind():
    skeleton = load_skeleton("human")
    link = {n: skeleton.names.index(n) for n in ("head", "chest", "left_ankle")}
    face, dress, foot = [], [], []
    for seed in range(12):
        person = create(skeleton, seed)
        colors, x = person.colors(np.random.default_rng(seed)), person.surface[:, 0]
        for found, of in ((face, "head"), (dress, "chest")):
            front, back = (person.link == link[of]) & (x > 0.03), (person.link == link[of]) & (x < -0.005)
            found.append(np.abs(colors[front].mean(0) - colors[back].mean(0)).max())
        ahead = person.vertices[person.link == link["left_ankle"], 0]
        foot.append(ahead.max() / -ahead.min())
    assert np.median(face) > 0.15  # hair is behind
    assert 0.02 < np.median(dress) < 0.3  # some wear something in front, many do not
    assert min(foot) > 1.2


def test_the_labels_agree(shard):
    known, z = shard
    assert np.array_equal(z["parts"] > 0, z["mask"] > 0)
    assert z["parts"].max() <= len(known.parts)
    assert len(set(z["move"])) > 4
    rows = np.arange(len(z["mask"]))[:, None]
    uv = np.round(z["keypoints"]).astype(int).clip(0, dataset.SIZE - 1)
    on = z["mask"][rows, uv[..., 1], uv[..., 0]] > 0
    assert on[z["visible"] > 0].all()
    assert 0.3 < (z["visible"] > 0).mean() < 0.95


def test_a_camera_on_the_left_sees_the_left(shard):
    known, z = shard
    left = [i + 1 for i, p in enumerate(known.parts) if "left" in p]
    right = [i + 1 for i, p in enumerate(known.parts) if "right" in p]
    more = np.isin(z["parts"], left).sum((1, 2)) - np.isin(z["parts"], right).sum((1, 2))
    square = np.abs(np.sin(z["azimuth"])) > 0.8
    upright = z["up"][:, 1] < -0.8
    agree = np.sign(more) == np.sign(np.sin(z["azimuth"]))
    assert agree[square & upright].mean() > 0.8


def test_the_surface_lies_on_the_resting_body(shard):
    known, z = shard
    x = z["surface"][z["mask"] > 0] / SURFACE_UNIT
    low = np.minimum(known.a, known.b).min(0) - known.radii.max() - 0.05
    high = np.maximum(known.a, known.b).max(0) + known.radii.max() + 0.05
    assert (x > low).all()
    assert (x < high).all()


def test_the_flow_is_the_subjects_own(shard):
    _, z = shard
    size = np.linalg.norm(z["flow"].astype(float), axis=-1)
    around = np.array([np.median(f[m == 0]) for f, m in zip(size, z["mask"], strict=True)])
    inside = np.array([np.percentile(f[m > 0], 90) for f, m in zip(size, z["mask"], strict=True)])
    assert np.median(around) < 0.1 * np.median(inside)
    assert np.isfinite(size).all()


def test_the_same_seed_gives_the_same_shards_and_another_seed_others(shard):
    known, z = shard
    again = make_shard(Config(kind=known.kind, samples=64, seed=3), 0)
    assert all(np.array_equal(z[k], again[k]) for k in z)
    other = make_shard(Config(kind=known.kind, samples=64, seed=4), 0)
    assert not np.array_equal(z["rgb"], other["rgb"])


def test_a_dataset_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    made = []

    def small(config, number):
        made.append(number)
        return dict(x=np.full(3, number), recipe=np.array(dataset.json.dumps(dataset.recipe(config), sort_keys=True)))

    monkeypatch.setattr(dataset, "make_shard", small)
    config = Config(samples=200)
    first = write_dataset(tmp_path, config, Silent()).read_text()
    assert sorted(made) == [0, 1, 2, 3]
    folder = tmp_path / "quadruped"
    torn = folder / "shard-00001.npz"
    torn.write_bytes(torn.read_bytes()[:100])
    (folder / "shard-00003.npz").unlink()
    made.clear()
    assert write_dataset(tmp_path, config, Silent()).read_text() == first
    assert made == [1, 3]
    made.clear()
    write_dataset(tmp_path, Config(samples=200, seed=1), Silent())
    assert made == [0, 1, 2, 3]


def test_bad_requests_are_refused():
    with pytest.raises(UsageError, match="snake"):
        Config(kind="snake")
    with pytest.raises(UsageError, match="samples"):
        Config(samples=0)
