"""The procedural animal: its motion, its truth, the embedded clip, and the scorer."""

import importlib.util
import json
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.skeleton import load_skeleton
from slomo.stage import Silent
from slomo.synth import figure
from slomo.synth.actor import moves
from slomo.synth.acts import ACTS, FOLD
from slomo.synth.animal import ANIMALS, BONES, FEET, KEYPOINTS, proportions, rest_joints
from slomo.synth.clip import EMBEDDED as EMBEDDED_CONFIG
from slomo.synth.clip import Config, truth, write_clip
from slomo.synth.creature import create
from slomo.synth.gait import animate
from slomo.synth.score import score

SHARED = Path(__file__).parents[2] / "shared"
EMBEDDED = Path(str(files("slomo"))) / "assets" / "walk"
T = np.arange(90) / 30


@pytest.mark.parametrize(("animal", "gait"), [(a, m) for a in ANIMALS for m in moves(a)])
def test_paws_stand_still_and_bones_keep_their_length(animal, gait):
    p = proportions(animal, 3)
    m = animate(p, gait, T, speed=None, turn=0.0 if gait in ("stand", *ACTS) else 0.2, seed=3)
    rest = rest_joints(p)
    for i, foot in enumerate(FEET):
        path = m.keypoints[:, KEYPOINTS.index(f"{foot}_paw")]
        both = m.contact[1:, i] & m.contact[:-1, i]
        assert np.abs(np.diff(path, axis=0)[both]).max() < 1e-9
        assert np.allclose(path[m.contact[:, i], 2], path[:, 2].min())
    legs = [(a, b) for a, b in BONES if a[0:5] in ("front", "hind_")]
    for a, b in legs:
        length = np.linalg.norm(m.keypoints[:, KEYPOINTS.index(a)] - m.keypoints[:, KEYPOINTS.index(b)], axis=1)
        assert np.allclose(length, np.linalg.norm(rest[a] - rest[b]), rtol=1e-6)


@pytest.mark.parametrize("act", ACTS)
@pytest.mark.parametrize("animal", ["dog", "cat"])
def test_acts_are_what_they_are_called_and_begin_and_end_standing(animal, act):
    p = proportions(animal, 3)
    m = animate(p, act, np.arange(270) / 30, speed=None, turn=0.0, seed=3)
    high = {n: m.keypoints[:, k, 2] / p.height for k, n in enumerate(KEYPOINTS)}
    begins = {n: z[0] for n, z in high.items()}
    assert begins["pelvis"] > 0.65
    assert begins["withers"] > 0.7
    if act in FOLD:
        assert high["pelvis"].min() < 0.35
        assert max(high[f"hind_{s}_hock"].min() for s in ("left", "right")) < 0.12
        assert high["pelvis"][high["pelvis"].argmin() :].max() > 0.65  # up again
        assert (high["withers"].min() > 0.6) == (act == "sit")
        assert (max(high[f"front_{s}_elbow"].min() for s in ("left", "right")) < 0.15) == (act == "lie")
    if act == "reach":
        raised = [float(np.ptp(high[f"{foot}_paw"])) for foot in FEET]
        assert sum(r > 0.2 for r in raised) == 1
        assert max(raised[2:]) == 0
    if act == "graze":
        assert high["nose"].min() < 0.3 < begins["nose"]
    if act == "rear":
        assert high["withers"].max() > 1.3
        assert min(high[f"front_{s}_paw"].max() for s in ("left", "right")) > 0.7
        assert max(np.ptp(high[f"hind_{s}_paw"]) for s in ("left", "right")) == 0
    assert min(z.min() for z in high.values()) > 0


# Hind left, hind right, and then the front feet: on the same lead, or on the other one.
@pytest.mark.parametrize(
    ("gait", "follows"), [("gallop", {2: 3, 3: 0, 0: 1, 1: 2}), ("rotary", {2: 3, 3: 1, 1: 0, 0: 2})]
)
def test_a_gallop_flies_and_lands_its_hind_feet_first(gait, follows):
    m = animate(proportions("dog", 0), gait, np.arange(400) / 200, speed=None, turn=0.0, seed=0)
    assert 0.05 < (m.contact.sum(1) == 0).mean() < 0.6
    touch = [(int(k), i) for i in range(4) for k in np.flatnonzero(np.diff(m.contact[:, i].astype(int)) == 1)]
    order = [i for _, i in sorted(touch)]
    assert len(order) > 8
    assert all(b == follows[a] for a, b in pairwise(order))


def test_a_tempo_plays_the_same_strides_at_another_pace():
    """What is passed and what stands is as in the steady clip, at other times; who stops stays where it is."""
    made = {tempo: truth(Config(gait="trot", tempo=tempo, seconds=3.0)) for tempo in ("steady", "slower", "stops")}
    length = float(made["steady"]["body_length"])
    root = {tempo: arrays["keypoints"][:, KEYPOINTS.index("withers"), :2] for tempo, arrays in made.items()}
    speed = {tempo: np.linalg.norm(np.diff(x, axis=0), axis=1) * 30 for tempo, x in root.items()}
    assert np.mean(speed["slower"][:10]) / np.mean(speed["slower"][-10:]) == pytest.approx(4.0, rel=0.25)
    assert speed["stops"][-25:].max() < 1e-9
    foot = KEYPOINTS.index("hind_left_paw")
    places = {tempo: arrays["keypoints"][arrays["foot_contact"][:, 2], foot] for tempo, arrays in made.items()}
    for tempo in ("slower", "stops"):
        away = np.linalg.norm(places[tempo][:, None] - places["steady"], axis=-1).min(1)
        assert away[: len(away) // 2].max() < 0.02 * length


@pytest.mark.parametrize("move", figure.MOVES)
def test_people_stand_still_and_over_their_soles(move):
    skeleton = load_skeleton("human")
    c = create(skeleton, 3)
    walks = move in figure.STRIDES
    m = figure.pose(c, move, T, height=1.7, speed=None, turn=0.2 if walks else 0.0, seed=3)
    rest = np.linalg.norm(c.offset, axis=1)
    at = {n: j for j, n in enumerate(skeleton.names)}
    balls = m.nodes[:, [at["left_toe"], at["right_toe"]]]
    both = m.contact[1:] & m.contact[:-1]
    assert both.mean() > 0.2
    assert np.abs(np.diff(balls, axis=0)[both]).max() < 1e-6
    assert np.allclose(balls[..., 2][m.contact], skeleton.sole, atol=1e-6)
    assert balls[..., 2].min() > 0.5 * skeleton.sole
    for j in range(1, len(skeleton.names)):
        length = np.linalg.norm(m.nodes[:, j] - m.nodes[:, skeleton.link[j]], axis=1)
        assert np.allclose(length, rest[j])
    ankles = m.nodes[:, [at["left_ankle"], at["right_ankle"]]]
    away = (m.nodes[:, at["pelvis"]] - (ankles + balls).mean(1) / 2)[:, :2]
    assert np.abs(away.mean(0)).max() < 0.08
    knees = m.nodes[:, [at["left_knee"], at["right_knee"]]]
    hips = m.nodes[:, [at["left_hip"], at["right_hip"]]]
    ahead = m.R[:, 0, :, 0]
    bent = ((knees - (hips + ankles) / 2) * ahead[:, None]).sum(-1)
    assert bent.min() > -0.01  # knees do not bend backwards
    smooth = np.abs(np.diff(m.nodes[:, 0, 2], 2)).max() * 30**2 * 1.7
    assert smooth < (30 if move == "jump" else 20)  # m/s^2 of the pelvis, up and down; landings are hard
    high = m.nodes[..., 2]
    hands = high[:, [at["left_wrist"], at["right_wrist"]]]
    if move == "bend":
        assert hands.min() < 0.35 < 0.4 < hands.max()
    if move == "stretch":
        assert hands.max(0).min() > high[:, at["head_top"]].min()
    if move == "jump":
        flies = ~m.contact.any(1)
        assert 0.05 < balls[..., 2].max() - skeleton.sole < 0.2
        assert flies.any()
        assert (balls[flies, :, 2] > skeleton.sole).all()


def test_who_is_on_the_spot_does_not_travel():
    with pytest.raises(UsageError, match="on the spot"):
        truth(Config(animal="person", gait="squat", speed=1.0))
    with pytest.raises(UsageError, match="on the spot"):
        truth(Config(gait="sit", turn=10.0))
    with pytest.raises(UsageError, match="valid: walk, pace, trot, gallop, rotary, stand, reach, graze"):
        Config(animal="horse", gait="sit")
    with pytest.raises(UsageError, match="valid: walk, run"):
        Config(animal="person", gait="trot")
    z = truth(Config(animal="person", gait="walk", speed=1.2, camera="static", seed=2))
    assert np.linalg.norm((z["keypoints"][-1, 0] - z["keypoints"][0, 0])[:2]) == pytest.approx(1.2 * T[-1], rel=0.05)
    assert z["kind"] == "human"
    assert 1.5 < z["body_length"] < 1.95


def test_a_walk_is_a_lateral_sequence_that_always_has_support():
    m = animate(proportions("dog", 0), "walk", np.arange(400) / 100, speed=None, turn=0.0, seed=0)
    touch = [(int(k), f) for i, f in enumerate(FEET) for k in np.flatnonzero(np.diff(m.contact[:, i].astype(int)) == 1)]
    order = [f for _, f in sorted(touch)]
    follows = {
        "hind_left": "front_left",
        "front_left": "hind_right",
        "hind_right": "front_right",
        "front_right": "hind_left",
    }
    assert len(order) > 8
    assert all(b == follows[a] for a, b in pairwise(order))
    assert m.contact.sum(1).min() >= 2
    assert m.contact.mean() > 0.55


def test_it_moves_at_the_speed_and_turns_as_asked():
    m = animate(proportions("dog", 1), "walk", T, speed=0.5, turn=0.0, seed=0)
    path = m.keypoints[:, KEYPOINTS.index("spine_mid")]
    assert np.linalg.norm(path[-1, :2] - path[0, :2]) == pytest.approx(0.5 * T[-1], rel=0.01)
    m = animate(proportions("dog", 1), "walk", T, speed=0.5, turn=0.5, seed=0)
    a = np.unwrap(np.arctan2(m.lateral[:, 1], m.lateral[:, 0]))
    assert a[-1] - a[0] == pytest.approx(0.5 * T[-1], rel=1e-6)


def test_too_fast_is_one_line_for_the_user():
    with pytest.raises(UsageError, match="reach"):
        truth(Config(speed=9.0))
    with pytest.raises(UsageError, match="valid: follow"):
        Config(camera="drone")
    for speed in (-1.0, float("nan")):
        with pytest.raises(UsageError, match="speed is"):
            Config(speed=speed)


def test_truth_is_deterministic_and_depends_on_the_seed():
    a, b, c = truth(Config(seed=1)), truth(Config(seed=1)), truth(Config(seed=2))
    for k in a:
        np.testing.assert_array_equal(a[k], b[k])
    assert not np.allclose(a["keypoints"], c["keypoints"])


@pytest.mark.parametrize("camera", ["follow", "orbit", "pan", "static"])
def test_cameras(camera):
    z = truth(Config(camera=camera, seed=4))
    R, c = z["T_world_cam"][:, :3, :3], z["T_world_cam"][:, :3, 3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
    assert np.all(R[:, 2, 1] < -0.8)  # the image's down is the world's down
    moved = np.linalg.norm(c - c[0], axis=1).max() / z["body_length"]
    assert moved < 0.1 if camera in ("pan", "static") else moved > 0.5
    x = np.einsum("tji,tnj->tni", R, z["keypoints"] - c[:, None])
    uv = (x @ z["K"].T)[..., :2] / x[..., 2:]
    assert (uv > 0).all()  # the whole animal is in the picture, all the time
    assert (uv < z["image_size"]).all()


def test_a_clip_has_what_it_promises(tmp_path):
    config = Config(seconds=0.2, width=160, height=90, animal="cat", gait="trot", seed=5)
    write_clip(tmp_path, config, Silent())
    with av.open(str(tmp_path / "clip.mp4")) as c:
        assert c.streams.video[0].codec_context.name == "h264"
        frames = [f.to_ndarray(format="rgb24") for f in c.decode(video=0)]
    assert len(frames) == 6
    assert frames[0].shape == (90, 160, 3)
    with np.load(tmp_path / "masks.npz") as z:
        masks = np.unpackbits(z["packed"], axis=-1)[..., : z["shape"][2]].astype(bool)
    with np.load(tmp_path / "truth.npz") as z:
        arrays = dict(z)
    assert masks.shape == (6, 90, 160)
    # The silhouette holds the projected joints.
    x = np.einsum(
        "tji,tnj->tni", arrays["T_world_cam"][:, :3, :3], arrays["keypoints"] - arrays["T_world_cam"][:, None, :3, 3]
    )
    uv = np.rint((x @ arrays["K"].T)[..., :2] / x[..., 2:]).astype(int)
    inside = np.stack([m[p[:, 1], p[:, 0]] for m, p in zip(masks, uv, strict=True)])
    assert inside.mean() > 0.85


def test_embedded_clip_is_what_its_config_renders():
    with np.load(EMBEDDED / "truth.npz") as z:
        stored = dict(z)
    config = Config(**json.loads(str(stored["config"])))
    assert config == EMBEDDED_CONFIG
    again = truth(config)
    assert set(again) == set(stored)
    for k in ("keypoints", "T_world_cam", "K", "body_length"):
        np.testing.assert_allclose(again[k], stored[k], atol=1e-9)
    np.testing.assert_array_equal(again["foot_contact"], stored["foot_contact"])
    assert (EMBEDDED / "clip.mp4").stat().st_size < 600_000
    with av.open(str(EMBEDDED / "clip.mp4")) as c:
        frames = sum(1 for _ in c.decode(video=0))
    assert frames == len(stored["keypoints"]) == 90


def _motion(z, keypoints: np.ndarray) -> KeypointMotion:
    t = np.arange(len(keypoints)) / float(z["fps"])
    names = tuple(map(str, z["keypoint_names"]))
    return KeypointMotion(t, keypoints, names, np.ones(keypoints.shape[:2]))


def test_score_ignores_a_similarity_and_measures_noise():
    z = truth(Config())
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    out = score(_motion(z, 1.7 * z["keypoints"] @ turn.T + [3.0, 1, 0]), z)
    assert out["w_mpjpe_percent"] < 1e-9
    assert out["pa_mpjpe_percent"] < 1e-9
    assert out["gravity_error_degrees"] < 1e-3
    moved = z["keypoints"] + 0.02 * np.random.default_rng(0).standard_normal(z["keypoints"].shape)
    expected = 100 * 0.02 * np.sqrt(8 / np.pi) / z["body_length"]  # mean length of a normal vector in space
    assert score(_motion(z, moved), z)["w_mpjpe_percent"] == pytest.approx(expected, rel=0.03)
    with pytest.raises(InvalidData, match="four"):
        score(KeypointMotion(T, np.zeros((90, 2, 3)), ("a", "b"), np.ones((90, 2))), z)


def test_score_agrees_with_the_judge():
    path = SHARED / "truth" / "score.py"
    if not path.exists():
        pytest.skip("needs ../shared/truth/score.py")
    spec = importlib.util.spec_from_file_location("judge", path)
    assert spec is not None
    assert spec.loader is not None
    judge = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(judge)
    z = truth(Config(seed=6))
    rng = np.random.default_rng(1)
    drift = np.cumsum(0.004 * rng.standard_normal((90, 1, 3)), 0)
    m = _motion(z, 0.8 * z["keypoints"] + drift + 0.01 * rng.standard_normal(z["keypoints"].shape))
    ours = score(m, z)
    theirs = judge.score(m.to_arrays(), {k: np.asarray(v) for k, v in z.items()})
    for mine, his in (
        ("pa_mpjpe_percent", "pa_mpjpe_pct"),
        ("w_mpjpe_percent", "w_mpjpe_pct"),
        ("foot_mpjpe_percent", "foot_mpjpe_pct"),
        ("root_path_error_percent", "root_traj_error_pct_of_distance"),
        ("gravity_error_degrees", "gravity_error_deg"),
        ("foot_slide_mps", "foot_slide_mps_in_true_contact"),
    ):
        assert ours[mine] == pytest.approx(theirs[his], abs=1e-3)
