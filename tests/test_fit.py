"""The whole fit on a walk of the skeleton itself: it must find it, resume to the same bits, and say when it cannot."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData, UsageError
from slomo.motion import KeypointMotion
from slomo.packed import pack, unpack
from slomo.pinhole import Intrinsics
from slomo.reconstruct import fit, gaits, hypotheses, observations, preferences, silhouette
from slomo.reconstruct.fit_stage import run_fit
from slomo.reconstruct.hypotheses import GaitHypothesis
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.observations import observe
from slomo.reconstruct.refine_stage import ReconstructConfig, run_refine
from slomo.rotation import umeyama
from slomo.skeleton import load_skeleton
from slomo.stage import Artifact, Inputs, Progress, Silent

T, FPS, LENGTH = 24, 12.0, 0.45
K = Intrinsics(150, 150, 79.5, 44.5, 160, 90)
QUICK = ReconstructConfig(quality="draft", iterations=(40, 40, 20, 90, 30), candidates=4, gait_phases=6, fps=12)
TINY = ReconstructConfig(quality="draft", iterations=(6, 4, 4, 4, 2), candidates=3, gait_phases=2, fps=6)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _camera(height: float = 1.0) -> np.ndarray:
    """A camera above the ground that looks along y, 12 degrees down."""
    c, s = np.cos(np.radians(12)), np.sin(np.radians(12))
    M = np.eye(4)
    M[:3, :3] = np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]])
    M[2, 3] = height
    return M


def _walk() -> tuple[np.ndarray, dict, dict]:
    """True nodes (T, M, 3), masks and flow of a walk to the right, drawn with the capsules."""
    kin = Kinematics(load_skeleton("quadruped"))
    t = np.arange(T) / FPS
    walk = next(g for g in kin.skeleton.gaits if g.name == "walk")
    speed = 1.1
    gait = GaitHypothesis("walk", 1.2, 0.3)
    q, _ = hypotheses.gait_pose(kin, walk, gait, t, clock=t, speed=np.full(T, speed), leg=0.75)
    f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
    position = np.stack([-0.75 + speed * LENGTH * t, np.full(T, 2.3), np.full(T, 0.93 * LENGTH)], 1)
    shape = kin.shape_variables(1)
    shape["log_length"] += float(np.log(LENGTH))
    body = kin.pose(shape, f(position)[None], torch.eye(3).expand(1, T, 3, 3), f(q)[None])
    M = _camera()
    R, centre = f(M[:3, :3].T).expand(1, T, 3, 3), f(M[:3, 3]).expand(1, T, 3)
    a, b = (silhouette.to_camera(R, centre, x) for x in (body.a, body.b))
    out = silhouette.outline(K, a, b, body.radii)
    v, u = torch.meshgrid(torch.arange(90.0), torch.arange(160.0), indexing="ij")
    u, v = u.reshape(1, -1).expand(T, -1), v.reshape(1, -1).expand(T, -1)
    sd, h = silhouette.distances(out, u, v)
    mask = (sd[0].amin(-1) < 0).reshape(T, 90, 160).numpy()
    c, _ = silhouette.visible(K, out, sd, h)
    X = silhouette.surface(K, out, c, u, v)[0].numpy() @ M[:3, :3].T + M[:3, 3]
    links = kin.skeleton.capsule_link[c[0].numpy()]
    Rw, pw = body.R[0].numpy(), body.nodes[0].numpy()
    flow = np.zeros((T - 1, 90 * 160, 2), np.float32)
    for i in range(T - 1):
        local = np.einsum("nji,nj->ni", Rw[i, links[i]], X[i] - pw[i, links[i]])
        Y = np.einsum("nij,nj->ni", Rw[i + 1, links[i]], local) + pw[i + 1, links[i]]
        Y = (Y - M[:3, 3]) @ M[:3, :3]
        moved = np.stack([K.fx * Y[:, 0] / Y[:, 2] + K.cx, K.fy * Y[:, 1] / Y[:, 2] + K.cy], 1)
        flow[i] = moved - np.stack([u[0], v[0]], 1)
    flow = flow.reshape(T - 1, 90, 160, 2) * mask[:-1, ..., None]
    masks = dict(**pack(mask), quality=np.ones(T))
    return pw, masks, dict(flow=flow.astype(np.float16), consistent=np.packbits(np.ones_like(mask[1:]), axis=-1))


def _frames(masks: dict) -> np.ndarray:
    """A dark body in front of noise."""
    inside = unpack(masks)
    frames = np.random.default_rng(0).integers(100, 255, (*inside.shape, 3)).astype(np.uint8)
    frames[inside] //= 3
    return frames


def _inputs(masks: dict, flow: dict) -> Inputs:
    intrinsics = np.array([[K.fx, 0, K.cx], [0, K.fy, K.cy], [0, 0, 1]])
    camera = dict(K=intrinsics, T_world_cam=np.tile(_camera(), (T, 1, 1)))
    return Inputs(
        artifacts={
            "decode": Artifact(npz={"frames.npz": dict(t=np.arange(T) / FPS, frames=_frames(masks))}),
            "masks": Artifact(npz={"masks.npz": masks, "flow.npz": flow}, json={"report.json": dict(quality_mean=1.0)}),
            "camera": Artifact(npz={"camera.npz": camera}, json={"report.json": dict(mode="moving")}),
        }
    )


def reconstruct(inputs: Inputs, config: ReconstructConfig, progress: Progress) -> Artifact:
    """The coarse fit, which may be interrupted, and what is made of it."""
    fitted = run_fit(inputs, config, progress)
    return run_refine(Inputs(artifacts={**inputs.artifacts, "fit": fitted}), config, Silent())


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, dict, dict]:
    return _walk()


@pytest.mark.parametrize(("same", "headings"), [(gaits.SAME, 1), (-1.0, 2)])
def test_one_candidate_leaves_all_gaits_out(walk, monkeypatch, same, headings):
    """And no more: two headings that are as good are both fitted, however few hypotheses are asked for, unless they
    are one: here the way of travel is one of the fixed ways."""
    _, masks, flow = walk
    monkeypatch.setattr(gaits, "SAME", same)
    out = run_fit(_inputs(masks, flow), replace(TINY, candidates=1), Silent())
    tried = out.json["report.json"]["search"]["gait"]
    assert len(tried) == headings
    assert all(entry["gait"] == "none" for entry in tried)


class _Watched(Silent):
    """Remembers how far the work is said to be."""

    def __init__(self):
        self.done = []

    def update(self, fraction: float, message: str = "") -> None:
        self.done.append(fraction)


def test_a_walk_is_found(walk):
    true, masks, flow = walk
    watched = _Watched()
    out = reconstruct(_inputs(masks, flow), QUICK, watched)
    assert watched.done == sorted(watched.done)
    assert 0 < watched.done[-1] <= 1
    assert out.failure is None
    report = out.json["report.json"]
    assert report["hypothesis"]["gait"] == "walk"
    assert report["silhouette_iou"] > 0.8
    assert report["scale_source"] == "typical length of quadruped"
    assert report["swap_margin"] is not None
    assert report["evidence"] == []
    assert report["camera_tremble_deg"] == 0
    assert report["verdict"]["trust"] in ("good", "fair")
    motion = KeypointMotion.from_arrays(out.npz["keypoints.npz"])
    names = load_skeleton("quadruped").names
    Y = true[:, [names.index(n) for n in motion.names]]
    X = motion.positions
    s, R, p = umeyama(X.reshape(-1, 3), Y.reshape(-1, 3))
    error = np.linalg.norm(s * X @ R.T + p - Y, axis=-1)
    assert error.mean() < 0.10 * LENGTH
    legs = [i for i, n in enumerate(motion.names) if n.endswith("paw")]
    swapped = [motion.names.index(motion.names[i].replace("left", "#").replace("right", "left").replace("#", "right")) for i in legs]  # fmt: skip  # noqa: E501
    crossed = np.linalg.norm(s * X[:, swapped] @ R.T + p - Y[:, legs], axis=-1)
    assert error[:, legs].mean() < 0.6 * crossed.mean()
    assert np.linalg.norm(motion["withers"] - motion["tail_base"], axis=-1) == pytest.approx(0.5, abs=0.06)


class Stops(Silent):
    """Saves every few iterations and stops after some saves, as a killed run would; what is loaded has been through the
    checkpoint's format, which keeps no order of its arrays."""

    def __init__(self, saves: int, saved: dict | None = None):
        self.saves, self.saved, self.count = saves, saved, 0

    def checkpoint_due(self) -> bool:
        self.count += 1
        return self.count % 3 == 0

    def save(self, state) -> None:
        self.saved = safetensors.numpy.load(safetensors.numpy.save({k: np.array(v) for k, v in state.items()}))
        self.saves -= 1
        if self.saves == 0:
            raise KeyboardInterrupt

    def load(self):
        return self.saved

    def saved_phase(self) -> int:
        return json.loads(bytes(self.saved["meta"]))["phase"]  # pyright: ignore[reportOptionalSubscript]


@pytest.mark.parametrize(
    ("saves", "phase", "more"),
    [(1, "heading", ()), (5, "final", ()), (7, "alike", ("alike",)), (8, "overtaking", ("alike", "overtaking"))],
)
def test_an_interrupted_fit_resumes_to_the_same_bits(walk, monkeypatch, saves: int, phase: str, more: tuple[str, ...]):
    """In the phases that few clips get to, too: what is chosen there is what the report is of."""
    _, masks, flow = walk
    legs = lambda *motion: [("hind", *hypotheses.exchanged(*motion))]  # noqa: E731
    monkeypatch.setattr(fit, "overtaking", legs if "overtaking" in more else lambda *a: [])
    strides = lambda _, x, guess, **k: (x, guess)  # noqa: E731
    monkeypatch.setattr(fit.alike, "borrowed", strides if "alike" in more else lambda *a, **k: None)
    whole = reconstruct(_inputs(masks, flow), TINY, Silent())
    first = Stops(saves)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(_inputs(masks, flow), TINY, first)
    assert fit.PHASES[first.saved_phase()] == phase
    again = reconstruct(_inputs(masks, flow), TINY, Stops(99, first.saved))
    for k, v in whole.npz["keypoints.npz"].items():
        np.testing.assert_array_equal(again.npz["keypoints.npz"][k], v, err_msg=k)
    search = whole.json["report.json"]["search"]
    assert again.json["report.json"]["search"] == search
    assert tuple(name for name in ("alike", "overtaking") if name in search) == more
    for name in more:
        assert [name in entry for entry in search[name]].count(True) == 1
    name = more[-1] if more else "limbs"
    last, hypothesis = search[name], whole.json["report.json"]["hypothesis"]
    assert {k: v for k, v in last[0].items() if k not in ("loss", "picture")} == hypothesis
    if name == "overtaking":
        assert last == sorted(last, key=lambda e: e["picture"] * (1 - preferences.TURNS * (name in e)))
    elif name != "alike":  # there the loss may be higher by a little
        assert last == sorted(last, key=lambda e: e["loss"])


def test_without_time_for_them_no_limbs_are_moved(walk):
    _, masks, flow = walk
    config = replace(TINY, iterations=(*TINY.iterations[:-1], 0))
    search = reconstruct(_inputs(masks, flow), config, Silent()).json["report.json"]["search"]
    assert search["limbs"] == search["final"][:1]


def test_the_same_seed_gives_the_same_bits_and_another_seed_others(walk):
    _, masks, flow = walk
    a, b, c = (
        reconstruct(_inputs(masks, flow), dataclasses.replace(TINY, seed=s), Silent()).npz["keypoints.npz"]["keypoints"]
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 1e-6


def test_a_length_sets_the_scale(walk):
    _, masks, flow = walk
    a, b = (reconstruct(_inputs(masks, flow), dataclasses.replace(TINY, length_m=m), Silent()) for m in (0.0, 1.0))
    ratio = b.npz["keypoints.npz"]["keypoints"] / a.npz["keypoints.npz"]["keypoints"]
    assert np.median(ratio) == pytest.approx(2.0, rel=0.02)
    assert b.json["report.json"]["scale_source"] == "length_m"


def test_a_trembling_camera_is_taken_back(walk):
    _, masks, flow = walk
    inputs = _inputs(masks, flow)
    axis = np.random.default_rng(1).standard_normal((T, 3))
    turn = Rotation.from_rotvec(np.radians(0.5) * axis / np.linalg.norm(axis, axis=1, keepdims=True)).as_matrix()
    inputs.artifacts["camera"].npz["camera.npz"]["T_world_cam"][:, :3, :3] @= turn
    out = reconstruct(inputs, TINY, Silent())
    assert out.json["report.json"]["camera_tremble_deg"] == pytest.approx(0.5, abs=0.15)
    R = Rotation.from_matrix(out.npz["keypoints.npz"]["T_world_cam"][:, :3, :3])
    left = np.degrees((R.mean().inv() * R).magnitude())
    assert left.mean() < 0.2, left


def test_masks_of_something_else_fail(walk):
    _, masks, flow = walk
    junk = np.zeros((T, 90, 160), bool)
    junk[:, 10:80:9, ::3] = True
    out = reconstruct(_inputs(masks | pack(junk), flow), TINY, Silent())
    assert out.failure
    assert "silhouette_iou" in out.failure
    assert out.json["report.json"]["verdict"]["trust"] == "unusable"


def test_a_clip_too_large_for_the_memory_is_seen_in_fewer_frames_first(walk, monkeypatch):
    _, masks, flow = walk
    z = {k: _inputs(masks, flow).artifacts[k].npz for k in ("masks", "camera")}

    def seen():
        t = np.arange(T) / 30  # the same frames as if there were 30 a second
        return observe(
            t, z["masks"]["masks.npz"], z["masks"]["flow.npz"], z["camera"]["camera.npz"], fps=30, subject_px=999
        )

    whole = seen()
    monkeypatch.setattr(observations, "MOST_PIXELS", T * 90 * 160 / 2)
    half = seen()
    monkeypatch.setattr(observations, "MOST_PIXELS", T * 90 * 160 / 8)
    small = seen()
    assert (len(whole.at), len(half.at), len(small.at)) == (T, T // 2, T // 2)
    assert whole.scale.tolist() == half.scale.tolist() == [1.0, 1.0]
    assert small.scale == pytest.approx(0.5, abs=0.02)
    # The sides are whole numbers of pixels, which no one scale makes of the clip's.
    monkeypatch.setattr(observations, "MOST_PIXELS", T * 90 * 160 / 9)
    odd = seen()
    assert odd.scale.tolist() == [odd.K.width / 160, odd.K.height / 90]
    assert abs(odd.scale[0] - odd.scale[1]) > 1e-3
    assert (odd.K.fx / whole.K.fx, odd.K.fy / whole.K.fy) == pytest.approx(odd.scale.tolist())
    assert (odd.K.cy + 0.5) / (whole.K.cy + 0.5) == pytest.approx(odd.scale[1])


def test_who_goes_there_and_back_has_travelled(walk):
    _, masks, flow = walk
    z = {k: a.npz for k, a in _inputs(masks, flow).artifacts.items()}
    obs = observe(
        np.arange(T) / FPS, z["masks"]["masks.npz"], z["masks"]["flow.npz"], z["camera"]["camera.npz"], fps=FPS,
        subject_px=60,
    )  # fmt: skip
    there_and_back = 2 * np.minimum(np.arange(T), T - 1 - np.arange(T))
    skeleton = load_skeleton("quadruped")
    once = hypotheses.root_guess(obs, skeleton)
    again = hypotheses.root_guess(replace(obs, box=obs.box[there_and_back]), skeleton)
    assert np.linalg.norm(again.middle[-1] - again.middle[0]) < 0.2 * again.length
    assert once.travelled > 1.5
    assert again.travelled > 0.6 * once.travelled  # the path is smoothed where it turns back


def test_parts_that_disagree_are_refused(walk):
    _, masks, flow = walk
    with pytest.raises(InvalidData, match="disagree about the number of frames"):
        reconstruct(_inputs(masks, dict(flow, flow=flow["flow"][:-2])), TINY, Silent())


def test_no_subject_is_refused(walk):
    _, masks, flow = walk
    with pytest.raises(InvalidData, match="no frame shows the subject"):
        reconstruct(_inputs(masks | dict(packed=np.zeros_like(masks["packed"])), flow), TINY, Silent())


def test_wrong_parameters():
    with pytest.raises(UsageError, match="length_m"):
        ReconstructConfig(length_m=-1)
    with pytest.raises(UsageError, match="iterations"):
        ReconstructConfig(iterations=(1, 2))
    with pytest.raises(UsageError, match="draft, normal, high"):
        ReconstructConfig(quality="best")
    with pytest.raises(UsageError, match="small, published"):
        ReconstructConfig(networks="large")
    with pytest.raises(UsageError, match="--skeleton PATH"):
        ReconstructConfig(skeleton="horse.toml")


@pytest.mark.parametrize(
    ("name", "value"),
    [("iterations", (0,) * 5), ("fps", 0.0), ("width", 0), ("candidates", -3), ("weight_mask", -1.0), ("seed", -1)],
)
def test_values_out_of_range(name: str, value):
    with pytest.raises(UsageError, match=name):
        ReconstructConfig(**{name: value})


def test_networks_of_the_published_size():
    plan = ReconstructConfig(networks="published").plan()
    assert plan.fields is not None
    assert (plan.fields.sdf_layers, plan.fields.width, plan.fields.rays) == (8, 256, 4096)
    assert ReconstructConfig(networks="published", quality="draft").plan().fields is None
