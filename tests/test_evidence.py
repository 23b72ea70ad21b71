"""Evidence in the fit: gradients, left against right, what is absent, and how arrays are arranged."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest
import torch

from slomo.packed import pack
from slomo.pinhole import Intrinsics
from slomo.prior.labels import BINS, labels
from slomo.reconstruct import evidence_terms, fit, hypotheses, losses, silhouette
from slomo.reconstruct.evidence import Evidence, gather, nearest
from slomo.reconstruct.hypotheses import GaitHypothesis, exchanged
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.observations import Observations, observe
from slomo.reconstruct.problem import Draw, Problem, Schedule, optimise
from slomo.reconstruct.run import Run, join
from slomo.reconstruct.trajectory import Guess, Trajectory
from slomo.skeleton import load_skeleton

T, FPS, LENGTH, W, H, GRID = 12, 12.0, 0.45, 96, 72, 32
K = Intrinsics(110, 110, 47.5, 35.5, W, H)
SKELETON = load_skeleton("quadruped")
KIN = Kinematics(SKELETON)
KNOWN = labels(SKELETON)
BOX = np.array([12.0, 0.0, 72.0])


def _f(x) -> torch.Tensor:
    return torch.as_tensor(x, dtype=torch.float32)


def _camera() -> np.ndarray:
    """One unit above the ground, looks along y, a little from behind the animal and 15 degrees down."""
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    M = np.eye(4)
    M[:3, :3] = np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]])
    M[:3, 3] = 0.0, -1.5, 0.75
    return M


def _guess(*, phase: float) -> Guess:
    """A walk on the spot, heading 40 degrees towards the camera."""
    t = np.arange(T) / FPS
    walk = next(g for g in SKELETON.gaits if g.name == "walk")
    q, _ = hypotheses.gait_pose(
        KIN, walk, GaitHypothesis("walk", 1.2, phase), t, clock=t, speed=np.full(T, 1.1), leg=0.75
    )
    position = np.tile([0.0, 0.0, 0.93 * LENGTH], (T, 1))
    return Guess(
        _f(position)[None], torch.full((1, T), -0.7), torch.zeros(1, T, 2), _f(q)[None], torch.full((1, T, 4), -1.0)
    )


def _variables(path: Trajectory) -> dict[str, torch.Tensor]:
    shape = {f"shape.{k}": v for k, v in KIN.shape_variables(1).items()}
    shape["shape.log_length"] = shape["shape.log_length"] + float(np.log(LENGTH))
    return shape | {"tilt": torch.zeros(1, 2)} | path.variables(1, torch.Generator().manual_seed(0))


def _observations(mask: np.ndarray) -> Observations:
    masks = dict(**pack(mask), quality=np.ones(T))
    flow = dict(flow=np.zeros((T - 1, H, W, 2), np.float16), consistent=np.packbits(mask[1:], axis=-1))
    camera = dict(K=np.array([[K.fx, 0, K.cx], [0, K.fy, K.cy], [0, 0, 1]]), T_world_cam=np.tile(_camera(), (T, 1, 1)))
    return observe(np.arange(T) / FPS, masks, flow, camera, fps=FPS, subject_px=200)


class Scene:
    """A true walk, its observations, and evidence that is right."""

    def __init__(self) -> None:
        blank = _observations(np.ones((T, H, W), bool))
        path = Trajectory(blank.t, KIN.B, joint_hz=4, root_hz=2, width=16)
        self.x, self.true = _variables(path), _guess(phase=0.1)
        pixels = torch.arange(W * H).expand(T, -1)
        whole = Draw(torch.arange(T), pixels, 0)
        s = Problem(blank, KIN, path, {}, 0.01).state(self.x, self.true, whole, stance_weight=0.0)
        mask = (s.sd[0].amin(-1) < 0).reshape(T, H, W).numpy()
        self.obs, self.path = _observations(mask), path
        u, v, _ = silhouette.project(K, silhouette.to_camera(s.R_cam, s.centre, s.body.nodes))
        c, _ = silhouette.visible(K, s.out, s.sd, s.h)
        X = silhouette.surface(K, s.out, c, s.u, s.v)[0].numpy()
        self.arrays = self._arrays(s, torch.stack([u, v], -1)[0].numpy(), c[0].numpy(), X, mask)
        self.said = gather(self.arrays, self.obs, SKELETON)

    def _arrays(self, s, uv, c, X, mask) -> dict[str, np.ndarray]:
        body, M = s.body, _camera()
        world = X @ M[:3, :3].T + M[:3, 3]
        link = SKELETON.capsule_link[c]
        frames = np.arange(T)[:, None]
        local = world - body.nodes[0].numpy()[frames, link]
        local = np.einsum("tnji,tnj->tni", body.R[0].numpy()[frames, link], local) / LENGTH
        canonical = local + SKELETON.rest()[link]
        row, column = np.mgrid[:GRID, :GRID]
        at = (np.stack([column, row], -1) + 0.5) * BOX[2] / GRID + BOX[:2] - 0.5
        flat = np.round(at[..., 1]).astype(int) * W + np.round(at[..., 0]).astype(int)
        label = np.where(mask.reshape(T, -1), KNOWN.capsule_part[c], 0)[:, flat]
        to_camera = np.arctan2(-1.5, 0.0) + 0.7
        apart = (2 * np.pi * np.arange(BINS) / BINS - to_camera + np.pi) % (2 * np.pi) - np.pi
        view = np.exp(-0.5 * (apart / 0.25) ** 2)
        return dict(
            frame=np.arange(T), box=np.tile(BOX, (T, 1)), view=np.tile(view / view.sum(), (T, 1)),
            view_up=np.tile([0.0, -np.cos(np.radians(15)), -np.sin(np.radians(15))], (T, 1)),
            view_path=np.full(T, to_camera), keypoint_names=np.array(SKELETON.names), keypoints=uv,
            keypoint_confidence=np.ones(uv.shape[:2]), part_names=np.array(KNOWN.parts),
            parts=(255 * (np.arange(len(KNOWN.parts) + 1)[:, None, None] == label[:, None])).astype(np.uint8),
            surface=canonical[:, flat].transpose(0, 3, 1, 2), surface_scale=np.full((T, GRID, GRID), 0.05),
        )  # fmt: skip

    def problem(self, said: Evidence | None, weights: Mapping[str, float]) -> Problem:
        terms = evidence_terms.terms(said) if said else {}
        return Problem(self.obs, KIN, self.path, weights, 0.01, {**losses.TERMS, **terms}, said)

    def value(self, name: str, guess: Guess) -> float:
        problem = self.problem(self.said, {name: 1.0})
        return float(problem.loss(self.x, guess, problem.draw(T, 400, torch.Generator().manual_seed(1)))[0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


NAMES = ("view", "keypoints", "parts", "surface")


def _mirrored(guess: Guess) -> Guess:
    """Left and right legs exchanged, all else as it is."""
    other = torch.as_tensor(SKELETON.mirror[: KIN.B])
    return dataclasses.replace(guess, q=guess.q[:, :, other] * torch.tensor([-1.0, 1.0, -1.0]))


def test_all_groups_are_there(scene: Scene):
    assert scene.said.groups == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_gradients_against_finite_differences(scene: Scene, name: str):
    problem = scene.problem(scene.said, {name: 1.0})
    draw = problem.draw(T, 400, torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(2)
    off = {k: 0.05 * torch.randn(v.shape, generator=generator) for k, v in scene.x.items() if k.startswith(("Q", "G"))}
    x = {k: (v + off.get(k, 0)).detach().requires_grad_() for k, v in scene.x.items()}
    problem.loss(x, scene.true, draw)[0].sum().backward()
    slope = {k: v.grad for k, v in x.items() if v.grad is not None and v.grad.abs().max() > 0}
    assert slope
    along = {k: g / torch.stack([(s**2).sum() for s in slope.values()]).sum().sqrt() for k, g in slope.items()}
    want = float(sum((g * along[k]).sum() for k, g in slope.items()))
    ends = []
    for h in (2e-3, -2e-3):
        moved = {k: (v + h * along[k] if k in along else v).detach() for k, v in x.items()}
        ends.append(float(problem.loss(moved, scene.true, draw)[0]))
    # The silhouette's distances leave out how the taper of a capsule changes (see `silhouette._Distance`).
    assert (ends[0] - ends[1]) / 4e-3 == pytest.approx(want, rel=0.1 if name == "parts" else 0.02)


@pytest.mark.parametrize("name", ["keypoints", "parts", "surface"])
def test_right_legs_cost_less_than_swapped_ones(scene: Scene, name: str):
    assert scene.value(name, scene.true) < 0.8 * scene.value(name, _mirrored(scene.true))


@pytest.mark.parametrize("name", NAMES)
def test_the_right_heading_costs_less_than_a_turned_one(scene: Scene, name: str):
    right = scene.value(name, scene.true)
    for turn in (0.5, -0.5, 1.7, np.pi):
        assert right < 0.8 * scene.value(name, dataclasses.replace(scene.true, yaw=scene.true.yaw + turn))


def test_the_view_may_be_off_by_twenty_degrees_and_not_by_forty(scene: Scene):
    turned = [
        scene.value("view", dataclasses.replace(scene.true, yaw=scene.true.yaw + np.radians(a))) for a in (0, 15, 40)
    ]
    assert turned[1] - turned[0] < 0.1 * (turned[2] - turned[0])


def test_key_points_that_are_met_cost_nothing_and_the_surface_next_to(scene: Scene):
    assert scene.value("keypoints", scene.true) < 1e-4
    assert scene.value("surface", scene.true) < 0.05


def test_key_points_alone_put_swapped_legs_right(scene: Scene):
    problem = scene.problem(scene.said, {"keypoints": 1.0, "limits": 0.02})
    start = _mirrored(scene.true)
    x = optimise(
        problem, {k: v.clone() for k, v in scene.x.items()}, start,
        Schedule(150, T, 8, ("Q",)), torch.Generator().manual_seed(0),
    )  # fmt: skip
    draw = problem.draw(T, 8, torch.Generator().manual_seed(3))
    paws = [limb.contact for limb in SKELETON.limbs]

    def nodes(x, guess):
        return problem.state(x, guess, draw, stance_weight=0.0).body.nodes[0][:, paws].detach()

    true = nodes(scene.x, scene.true)
    before, after = ((n - true).norm(dim=-1).mean() for n in (nodes(scene.x, start), nodes(x, start)))
    assert after < 0.35 * before


def test_legs_exchanged_twice_are_as_they_were(scene: Scene):
    problem, every = scene.problem(None, {}), torch.arange(T)
    off = {k: v + 0.1 if k.startswith("Q") else v for k, v in scene.x.items()}
    q = [problem.path(x, g, torch.ones(1), every)[2] for x, g in _exchanges(problem, off, scene.true)]
    torch.testing.assert_close(q[2], q[0])
    legs = hypotheses.leg_links(SKELETON)
    rest = [j for j in range(KIN.B) if j not in legs]
    torch.testing.assert_close(q[1][:, :, rest], q[0][:, :, rest])
    left, right = (SKELETON.names.index(f"hind_{side}_knee") for side in ("left", "right"))
    torch.testing.assert_close(q[1][:, :, left, 1], q[0][:, :, right, 1])


def _exchanges(problem: Problem, x: dict[str, torch.Tensor], guess: Guess) -> list[tuple[dict, Guess]]:
    out = [(x, guess)]
    for _ in range(2):
        out.append(exchanged(problem, *out[-1]))
    return out


@pytest.mark.parametrize("empty", [{}, {"frame": np.zeros(0, int), "keypoint_names": np.zeros(0, "<U1")}])
def test_without_evidence_the_loss_is_the_same_bit_for_bit(scene: Scene, empty: dict):
    said = gather(empty, scene.obs, SKELETON)
    assert said.groups == ()
    assert said.paths() == []
    weights = dict.fromkeys((*losses.TERMS, *NAMES), 0.3)
    a, b = (
        p.loss(scene.x, scene.true, p.draw(T, 60, torch.Generator().manual_seed(4)))[0]
        for p in (scene.problem(said, weights), scene.problem(None, weights))
    )
    assert torch.equal(a, b)


def test_frames_are_matched_within_half_a_step(scene: Scene):
    late = {k: v[::6] if len(v) == T else v for k, v in scene.arrays.items()}
    said = gather(late, scene.obs, SKELETON)
    spoken = (said.confidence > 0).any(1).numpy()
    np.testing.assert_array_equal(np.flatnonzero(spoken), [0, 6])
    np.testing.assert_array_equal(said.view_weight.numpy() > 0, spoken)
    # The azimuth of the clip is known in between as well.
    assert np.isfinite(said.path).all()


def test_names_that_the_skeleton_lacks_are_left_out(scene: Scene):
    names = scene.arrays["keypoint_names"].copy()
    names[3] = "antler"
    said = gather({**scene.arrays, "keypoint_names": names}, scene.obs, SKELETON)
    assert len(said.node) == len(names) - 1
    assert said.uv.shape == (T, len(names) - 1, 2)


def test_a_likely_mirror_image_is_a_heading_of_its_own(scene: Scene):
    assert [name for name, _ in scene.said.paths()] == ["decided"]
    view = scene.arrays["view"][0]
    mirrored = view[(BINS // 2 - np.arange(BINS)) % BINS]
    said = gather({**scene.arrays, "view": np.tile(0.6 * view + 0.4 * mirrored, (T, 1))}, scene.obs, SKELETON)
    paths = dict(said.paths())
    assert list(paths) == ["decided", "back to front"]
    root = hypotheses.RootGuess(np.zeros((T, 2)), LENGTH, np.zeros(T), 0.0, np.zeros(T))
    headings = dict(hypotheses.said_headings(scene.obs, said, root))
    np.testing.assert_allclose(headings["decided"], -0.7, atol=1e-6)
    # The mirror image in the picture's plane: heading h seen along y becomes -h.
    np.testing.assert_allclose((headings["back to front"] - 0.7 + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-6)


def test_the_nearest_place_of_the_body_undoes_the_canonical_coordinate():
    rng = np.random.default_rng(0)
    c, s = rng.integers(0, len(KNOWN.a), 200), rng.uniform(0.05, 0.95, 200)
    axis = KNOWN.b[c] - KNOWN.a[c]
    n = np.cross(axis, rng.normal(size=(200, 3)))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    X = KNOWN.canonical(c, s, n)
    found = nearest(X, KNOWN.capsule_part[c], KNOWN)
    np.testing.assert_allclose(KNOWN.canonical(*found), X, atol=2e-3)


def test_a_tail_that_the_masks_miss_costs_little_and_a_leg_much(scene: Scene):
    path, kin = scene.path, KIN
    s = Problem(scene.obs, kin, path, {}, 0.01).state(
        scene.x, scene.true, Draw(torch.arange(T), torch.arange(W * H).expand(T, -1), 0), stance_weight=0.0
    )
    owner, mask = s.sd[0].argmin(-1).reshape(T, H, W).numpy(), scene.obs.mask.reshape(T, H, W).numpy()

    def cost(*parts: str) -> dict[str, float]:
        missing = np.isin(owner, [i for i, n in enumerate(SKELETON.capsule_names) if n in parts])
        obs = _observations(mask & ~missing)
        problem = Problem(obs, kin, path, {"mask": 1.0, "reach": 1.0}, 0.01)
        draw = problem.draw(T, 2000, torch.Generator().manual_seed(1))
        _, terms = problem.loss(scene.x, scene.true, draw)
        return {k: float(v[0]) for k, v in terms.items()}

    whole, tail, leg = cost(), cost("tail_1", "tail_2"), cost("hind_left_shank", "hind_left_foot")
    assert tail["mask"] - whole["mask"] < 0.5 * (leg["mask"] - whole["mask"])
    assert tail["reach"] - whole["reach"] < 0.3 * (leg["reach"] - whole["reach"])


def test_the_surface_is_that_of_the_body_the_network_learnt_whatever_the_bones_of_this_one(scene: Scene):
    longer = dataclasses.replace(SKELETON, offset=1.25 * SKELETON.offset)
    said = gather(scene.arrays, scene.obs, longer)
    torch.testing.assert_close(said.capsule, scene.said.capsule)
    torch.testing.assert_close(said.along, scene.said.along)
    torch.testing.assert_close(said.normal, scene.said.normal)
    fewer = dataclasses.replace(longer, capsule_names=("another", *SKELETON.capsule_names[1:]))
    assert not torch.equal(gather(scene.arrays, scene.obs, fewer).along, scene.said.along)


def test_doubted_sides_cost_no_more_than_their_odds_and_prefer_the_right_way(scene: Scene):
    N = len(SKELETON.names)
    doubted = gather({**scene.arrays, "keypoint_side": np.full(N, 0.75)}, scene.obs, SKELETON)
    sided = int((SKELETON.mirror != np.arange(N)).sum())
    assert doubted.pairs.shape == (2, sided // 2)
    assert all(SKELETON.mirror[doubted.node[i]] == doubted.node[j] for i, j in doubted.pairs.T.tolist())
    assert sorted([*doubted.alone.tolist(), *doubted.pairs.flatten().tolist()]) == list(range(N))
    assert not len(scene.said.pair_side)  # the user's own are never exchanged

    def value(said: Evidence, guess: Guess) -> float:
        problem = scene.problem(said, {"keypoints": 1.0})
        return float(problem.loss(scene.x, guess, problem.draw(T, 400, torch.Generator().manual_seed(1)))[0])

    swapped = _mirrored(scene.true)
    right = value(doubted, scene.true)
    assert right < value(doubted, swapped)
    wrong = scene.arrays | {"keypoints": scene.arrays["keypoints"][:, SKELETON.mirror]}
    exchanged = gather({**wrong, "keypoint_side": np.full(N, 0.75)}, scene.obs, SKELETON)
    cost = value(exchanged, scene.true) - right
    assert 0 < cost <= np.log(3) * sided / 2 / N + 1e-6
    assert cost < 0.7 * value(gather(wrong, scene.obs, SKELETON), scene.true)


def test_parts_of_doubted_sides_speak_for_both_limbs(scene: Scene):
    even = gather({**scene.arrays, "part_side": np.float32(0.5)}, scene.obs, SKELETON)
    left = KNOWN.parts.index("front_left_lower")
    seen = even.part[..., 0] == left
    assert seen.any()
    assert (even.part[..., 1][seen] == left + 1).all()  # the right one is as likely
    assert torch.allclose(even.chance[..., 0][seen], even.chance[..., 1][seen])
    sided = KNOWN.mirror_part[KNOWN.capsule_part] != KNOWN.capsule_part
    assert (even.sure[torch.as_tensor(sided)[even.capsule]] == 0).all()


@pytest.mark.parametrize(("side", "trunk"), [(0.5, 0.0), (0.75, 0.5), (1.0, 1.0)])
def test_a_person_whose_sides_are_in_doubt_may_as_well_be_seen_from_behind(scene: Scene, side: float, trunk: float):
    """The surface of the trunk tells front from back, so it counts no more than the sides do."""
    person = load_skeleton("human")
    known = labels(person)
    label = 1 + known.parts.index("trunk")
    parts = np.zeros((T, len(known.parts) + 1, GRID, GRID), np.uint8)
    parts[:, label] = 255
    arrays = dict(
        frame=np.arange(T), box=np.tile(BOX, (T, 1)), part_names=np.array(known.parts), parts=parts, part_side=side,
        surface=np.zeros((T, 3, GRID, GRID)), surface_scale=np.zeros((T, GRID, GRID)),
    )  # fmt: skip
    sure = gather(arrays, scene.obs, person).sure
    np.testing.assert_allclose(sure, trunk, atol=1e-6)


def test_the_same_gait_half_a_stride_later_goes_into_the_final(scene: Scene):
    """It is the left-right opposite, though it is called the same; a hypothesis whose legs are as the best's is not."""
    labels = [{"gait": "walk", "phase": p} for p in (0.1, 0.12, 0.6)]
    poses = [_guess(phase=label["phase"]) for label in labels]
    x = {k: v.repeat(3, *[1] * (v.ndim - 1)) for k, v in scene.x.items()}
    run = Run(2, x, join(poses), labels)
    problem = scene.problem(None, {"mask": 1.0})
    chosen = fit._to_final(problem, run, torch.tensor([1.0, 1.001, 1.01]), _went(3.0))
    assert [label["phase"] for label in chosen.labels] == [0.1, 0.6]
    alone = fit._to_final(problem, run, torch.tensor([1.0, 1.001, 1.1]), _went(3.0))
    assert [label["phase"] for label in alone.labels] == [0.1]


def _went(travelled: float) -> hypotheses.RootGuess:
    return hypotheses.RootGuess(np.zeros((T, 2)), LENGTH, np.zeros(T), travelled, np.ones(T))


@pytest.mark.parametrize(("travelled", "walk", "wins"), [(3.0, 1.03, "walk"), (3.0, 1.06, "none"), (0.3, 1.03, "none")])
def test_who_travels_takes_steps_unless_it_looks_much_better_without(scene: Scene, travelled, walk, wins):
    labels = [{"gait": "none", "loss": 1.0}, {"gait": "walk", "loss": walk}]
    x = {k: v.repeat(2, *[1] * (v.ndim - 1)) for k, v in scene.x.items()}
    run = Run(3, x, join([_guess(phase=0.1)] * 2), labels, {"final": list(labels)})
    root = _went(travelled)
    effort = fit.Effort((Schedule(0, 1, 2, ()),) * len(fit.PHASES), 8, 12)  # no time for limbs
    best = fit._to_limbs(scene.problem(None, {"mask": 1.0}), run, torch.tensor([1.0, walk]), root, effort)
    assert [label["gait"] for label in best.labels] == [wins]
    assert best.log["final"][0]["gait"] == wins
