"""Decisions over a clip with known answers: the side from which it is seen, and which leg is left."""

import numpy as np
import pytest

from slomo.prior import clip, sides
from slomo.prior.clip import CENTRES, up_over_clip, view_over_clip
from slomo.prior.evidence import Shots, from_network
from slomo.prior.frames import Motion, every
from slomo.prior.inference import Prediction, mass_at, peaks
from slomo.prior.labels import BINS, labels, rotation_of
from slomo.skeleton import load_skeleton

FPS = 15.0


def bump(azimuth, *, other=None, share=0.0):
    """(F, 36) probabilities around azimuth (F,), a share of them around `other`."""
    out = 0
    for at, weight in ((azimuth, 1 - share), (azimuth if other is None else other, share)):
        apart = np.abs(np.mod(CENTRES - np.asarray(at)[:, None] + np.pi, 2 * np.pi) - np.pi)
        p = np.exp(-0.5 * (apart / np.radians(15)) ** 2) + 1e-4
        out = out + weight * p / p.sum(1, keepdims=True)
    return out


def apart(a, b):
    return np.abs(np.mod(a - b + np.pi, 2 * np.pi) - np.pi)


def test_mirrored_frames_are_repaired():
    rng = np.random.default_rng(0)
    t = np.arange(60) / FPS
    truth = np.radians(150) + np.radians(25) * t  # through the jump at pi
    said = truth + rng.normal(0, np.radians(8), 60)
    wrong = rng.random(60) < 0.2
    wrong[20:26] = True  # several in a row
    p = bump(np.where(wrong, np.pi - said, said), other=np.where(wrong, said, np.pi - said), share=0.2)
    assert (apart(CENTRES[p.argmax(1)], truth) > np.radians(25)).mean() > 0.15
    marginal, path = view_over_clip(p, t=t)
    assert path.dtype == marginal.dtype == np.float32
    assert np.allclose(marginal.sum(1), 1, atol=1e-5)
    assert apart(path, truth).max() < np.radians(20)
    assert apart(path, truth).mean() < np.radians(7)
    assert (np.where(apart(CENTRES, truth[:, None]) < np.radians(30), marginal, 0).sum(1) > 0.6).all()


def test_what_is_in_doubt_all_along_stays_so():
    t = np.arange(30) / FPS
    front = np.full(30, np.radians(30))
    marginal, _ = view_over_clip(bump(front, other=np.pi - front, share=0.5), t=t)
    assert np.where(apart(CENTRES, np.pi - front[:, None]) < np.radians(30), marginal, 0).sum(1).min() > 0.3


def test_a_gap_allows_a_turn():
    t = np.concatenate([np.arange(10), 60 + np.arange(10)]) / FPS
    truth = np.repeat(np.radians([0.0, 170.0]), 10)
    _, path = view_over_clip(bump(truth), t=t)
    assert apart(path, truth).max() < np.radians(5)


def test_who_spins_is_followed_and_frames_that_jump_are_no_spin():
    """Three turns in four seconds, with a fifth of the frames mirrored; and a body at rest with as many."""
    rng = np.random.default_rng(0)
    t = np.arange(120) / 30
    mirrored = rng.random(120) < 0.2
    for truth in (np.radians(270) * t, np.full(120, 0.5)):
        _, path = view_over_clip(bump(np.where(mirrored, np.pi - truth, truth)), t=t)
        assert np.quantile(apart(path, truth), 0.9) < np.radians(25)


def test_mirrored_frames_far_apart_are_no_spin(monkeypatch):
    """Half a turn from one frame to the next is what a mirror image looks like."""
    rng = np.random.default_rng(0)
    t = 0.35 * np.arange(600)
    azimuth = 0.2 * rng.standard_normal(600)
    said = bump(np.where(rng.random(600) < 0.3, np.pi - azimuth, azimuth))
    _, path = view_over_clip(said, t=t)
    monkeypatch.setattr(clip, "SPINS", np.zeros(0))
    np.testing.assert_array_equal(path, view_over_clip(said, t=t)[1])


def test_one_frame_is_a_clip_too():
    marginal, path = view_over_clip(bump(np.array([1.0])), t=np.zeros(1))
    assert marginal.shape == (1, BINS)
    assert apart(path, 1.0)[0] < np.radians(5)


def test_up_is_averaged_over_frames_that_agree():
    t = np.arange(15) / FPS
    up = np.tile([0.0, -0.8, 0.6], (15, 1))
    up[7, 2] *= -1  # tilted the other way, with the mirrored view
    view = bump(np.where(np.arange(15) == 7, np.pi - 0.4, 0.4))
    got = up_over_clip(up, view, np.full(15, 0.4), t)
    assert np.abs(got - [0.0, -0.8, 0.6]).max() < 0.02


def test_decide_is_the_best_of_all_states_and_knows_how_sure_it_is():
    rng = np.random.default_rng(1)
    F, parent = 4, np.array([-1, 0, 1])
    states = (np.arange(2 ** (3 * F))[:, None] >> np.arange(3 * F)) & 1
    sign = (1.0 - 2 * states).reshape(-1, F, 3)
    for _ in range(5):
        alone, along, together = rng.normal(0, 1, (F, 3)), rng.normal(0, 1, (F, 3)), rng.normal(0, 1.5, (F - 1, 3))
        score = (sign * alone).sum((1, 2)) + (sign[..., 1:] * sign[..., :-1] * along[:, 1:]).sum((1, 2))
        score = 0.5 * (score + (sign[:, 1:] * sign[:, :-1] * together).sum((1, 2)))
        got = sides.decide(alone, along, together, parent)
        best = sign[score.argmax()]
        assert np.array_equal(got.swapped, best < 0)
        opposite = score[(sign == -best).all((1, 2)).argmax()]
        assert score.max() - opposite == pytest.approx(got.margin)
        p = np.exp(score - score.max())
        p /= p.sum()
        assert np.allclose(got.sure, np.einsum("s,sfj->fj", p, sign == best))


def test_two_maps_that_see_both_legs_give_both_places():
    y, x = np.mgrid[:32, :32]
    spot = lambda u, v: np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2)) / (2 * np.pi)  # noqa: E731
    maps = {
        "which is which in doubt": (0.55 * spot(8, 20) + 0.45 * spot(18, 20), 0.6 * spot(8, 20) + 0.4 * spot(18, 20)),
        "one upon the other": (spot(8, 20), 0.98 * spot(8.5, 20) + 0.02 * spot(25, 9)),
        "known": (spot(8, 20), spot(18, 20)),
    }
    left, right = (np.stack([m[i] for m in maps.values()])[:, None] + 1e-6 for i in (0, 1))
    places, own, other, two = sides.assign(left, right, 128)
    cells = (places[:, :, 0] + 0.5) / 4 - 0.5
    assert two[:, 0].tolist() == [True, False, True]
    assert np.abs(cells[0] - [[18, 20], [8, 20]]).max() < 0.3
    assert np.abs(cells[2] - [[8, 20], [18, 20]]).max() < 0.3
    assert own[0, :, 0] == pytest.approx([0.45, 0.6], abs=0.03)
    assert other[0, :, 0] == pytest.approx([0.4, 0.55], abs=0.03)
    nats = sides.preference(own, other)[:, 0]
    assert 0.1 < nats[0] < 0.5  # close to a guess
    assert nats[2] == sides.NATS


def test_seen_from_above_the_nearer_foot_is_lower():
    up = np.array([[0.0, -0.94, -0.34]])  # the camera looks down by 20 degrees
    view = np.zeros((1, 36))
    view[0, 9] = 1  # on the left side
    axes = sides.axes(view, up)
    feet = np.array([[[0.3, 0.08]]])  # left foot far ahead and lower
    assert sides.from_view(feet, axes, np.array([0.2]))[0] > 0.5
    assert sides.from_view(feet * [1, -1], axes, np.array([0.2]))[0] < -0.5
    assert sides.from_view(feet * [-1, 1], axes, np.array([0.2]))[0] > 0.5  # ahead or behind does not matter
    seen = np.array([[[0.9], [0.3]]])
    assert sides.from_visibility(seen, axes) == 0
    assert sides.from_visibility(seen[:, ::-1], axes) < -0.5
    both = np.full((1, 36), 1 / 36)  # from anywhere: nothing is known
    assert np.abs(sides.from_view(feet, sides.axes(both, up), np.array([0.2]))).max() < 1e-6


@pytest.mark.parametrize(
    ("kind", "names"), [("quadruped", ["front_shoulder", "hind_hip"]), ("human", ["shoulder", "hip"])]
)
def test_pairs_of_limbs(kind, names):
    skeleton = load_skeleton(kind)
    known = labels(skeleton)
    pairs = sides.limb_pairs(skeleton, known)
    assert [p.name for p in pairs] == names
    for p in pairs:
        assert all("left" in known.keypoints[k] for k in p.left)
        assert p.parent.tolist() == list(range(-1, len(p.left) - 1))
        assert [known.keypoints[k].replace("right", "left") for k in p.right] == [known.keypoints[k] for k in p.left]
        assert [known.parts[k - 1].replace("right", "left") for k in p.right_parts] == [
            known.parts[k - 1] for k in p.left_parts
        ]
    assert sum(len(p.left) for p in pairs) == sum("left" in n for n in known.keypoints)
    assert sum(len(p.left_parts) for p in pairs) == sum("left" in n for n in known.parts)


def test_peaks_are_where_the_maps_are():
    y, x = np.mgrid[:32, :32]
    at = np.array([[10.3, 20.7], [4.0, 5.5], [28.8, 24.1]])
    heat = np.stack([np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2)) for u, v in at])
    heat /= heat.sum((1, 2), keepdims=True)
    places, mass = peaks(heat, 128)
    assert np.abs(places - ((at + 0.5) * 4 - 0.5)).max() < 0.4
    assert (mass > 0.9).all()
    assert np.allclose(mass_at(heat, places, 128), mass)
    assert mass_at(heat[:1], places[1:2], 128)[0] < 0.01


def test_frames_that_are_looked_at():
    assert [every(np.arange(60) / f, 15.0) for f in (24.0, 30.0, 60.0, 12.0)] == [2, 2, 4, 1]
    assert every(np.arange(8) / 30.0, 5.0) == 1


def test_points_ride_on_the_subject_s_flow():
    masks = np.zeros((4, 40, 60), bool)
    flow = np.zeros((3, 40, 60, 2), np.float16)
    for f in range(4):
        masks[f, 10:30, 10 + 2 * f : 20 + 2 * f] = True
        if f < 3:
            flow[f][masks[f]] = (2, 0)
    motion = Motion(flow, masks, np.arange(4) / 30)
    points = np.array([[15.0, 20.0], [10.0, 12.0]])  # in the middle, and on the very edge
    assert np.abs(motion.carry(points, 0, 3, 2.0) - points - [6, 0]).max() < 0.02
    assert np.abs(motion.carry(points + [6, 0], 3, 0, 2.0) - points).max() < 0.5
    assert np.array_equal(motion.carry(points, 2, 2, 2.0), points)
    longer = Motion(np.concatenate([flow] * 5), np.concatenate([masks] * 5), np.arange(16) / 30)
    assert np.allclose(longer.at(0)[20, 15], [4, 0])  # a fifteenth of a second is two frames
    assert longer.at(15).shape == (40, 60, 2)


class Walk:
    """A skeleton that walks past the camera, and a network that sees it but calls legs by the wrong side at times."""

    size = 128

    def __init__(self, kind, *, azimuth, frames=40, wrong, far=0.25, seed=0):
        rng = np.random.default_rng(seed)
        self.skeleton = load_skeleton(kind)
        self.labels = labels(self.skeleton)
        self.wrong = wrong  # (F,) bool
        rest = self.skeleton.rest()
        t = np.arange(frames) / FPS
        X = np.tile(rest, (frames, 1, 1))
        limbs = sides.limb_pairs(self.skeleton, self.labels)
        for i, pair in enumerate(limbs):
            for nodes, phase in ((pair.left, 0.0), (pair.right, np.pi)):
                swing = 0.25 * np.sin(2 * np.pi * 1.2 * t + phase + i)
                X[:, nodes, 0] += swing[:, None] * np.arange(len(nodes)) / (len(nodes) - 1)
        self.up = np.array([0.05, -0.95, 0.3]) / np.linalg.norm([0.05, -0.95, 0.3])
        R = rotation_of(np.array(azimuth), self.up)
        view = (X - rest[self.labels.trunk].mean(0)) @ R.T
        self.places = 63.5 + 60 * view[..., :2] + rng.normal(0, 0.7, (*view.shape[:2], 2))  # crop px
        depth = view[..., 2]
        hidden = depth > depth[:, self.labels.mirror_keypoint] + 0.05
        self.seen = np.where(hidden, far, 0.95)
        self.azimuth, self.t = azimuth, t
        # The crop is the picture itself: one px is one px.
        F = frames
        box = np.tile([0.0, 0.0, 128.0], (F, 1))
        flow = np.zeros((F - 1, 128, 128, 2), np.float32)
        grid = np.stack(np.meshgrid(np.arange(1.5, 128, 4), np.arange(1.5, 128, 4)), -1).reshape(-1, 1, 2)
        for f in range(F - 1):
            nearest = np.where(hidden[f], 1e3, 0) + np.linalg.norm(grid - self.places[f], axis=-1)
            moved = (self.places[f + 1] - self.places[f])[nearest.argmin(1)]
            flow[f] = moved.reshape(32, 32, 2).repeat(4, 0).repeat(4, 1)
        masks = np.ones((F, 128, 128), bool)
        frames_rgb = np.zeros((F, 128, 128, 3), np.uint8)
        self.shots = Shots(
            np.arange(F), t, box, np.ones(F), frames_rgb, masks, Motion(flow, masks, t), np.ones((F, 36)) / 36
        )

    def __call__(self, crops):
        F = len(self.places)
        P = len(self.labels.parts)
        mirror = self.labels.mirror_keypoint
        places, seen = self.places.copy(), self.seen.copy()
        places[self.wrong], seen[self.wrong] = places[self.wrong][:, mirror], seen[self.wrong][:, mirror]
        cells = (places + 0.5) / 4 - 0.5
        y, x = np.mgrid[:32, :32]
        gap = (x - cells[..., 0, None, None]) ** 2 + (y - cells[..., 1, None, None]) ** 2
        heat = np.exp(-0.5 * gap) + 0.15 * np.exp(-0.5 * gap[:, mirror]) + 1e-5
        heat /= heat.sum((2, 3), keepdims=True)
        parts = np.full((F, P + 1, 64, 64), 0.01, np.float32)
        for pair in sides.limb_pairs(self.skeleton, self.labels):
            for nodes, labels_of in ((pair.left, pair.left_parts), (pair.right, pair.right_parts)):
                at = np.clip(np.rint((places[:, nodes] + 0.5) / 2 - 0.5).astype(int), 1, 62)
                for f, n in np.ndindex(at.shape[:2]):
                    u, v = at[f, n]
                    parts[f, labels_of[-1], v - 1 : v + 2, u - 1 : u + 2] += 2 * seen[f, nodes[n]]
        parts[:, 0] += 0.3
        parts /= parts.sum(1, keepdims=True)
        left = [p + 1 for p, n in enumerate(self.labels.parts) if "left" in n]
        surface = np.zeros((F, 3, 64, 64), np.float32)
        surface[:, 1] = np.where(np.isin(parts.argmax(1), left), 0.1, -0.1)
        view = bump(np.where(self.wrong & (np.arange(F) % 2 == 0), np.pi - self.azimuth, self.azimuth))
        up = np.tile(self.up, (F, 1))
        return Prediction(128, parts, surface, np.full((F, 64, 64), 0.1), heat, seen, view, up)


@pytest.mark.parametrize("kind", ["quadruped", "human"])
@pytest.mark.parametrize("azimuth", [1.4, -1.3, 0.5, 2.6])
def test_swapped_legs_are_put_right(kind, azimuth):
    rng = np.random.default_rng(3)
    wrong = rng.random(40) < 0.2
    wrong[12:20] = True
    walk = Walk(kind, azimuth=azimuth, wrong=wrong)
    columns, dense, report = from_network(walk, walk.skeleton, walk.labels, walk.shots, lambda x: None)
    error = np.linalg.norm(columns.places - walk.places, axis=-1)
    mirrored = np.linalg.norm(columns.places - walk.places[:, walk.labels.mirror_keypoint], axis=-1)
    sided = np.linalg.norm(walk.places - walk.places[:, walk.labels.mirror_keypoint], axis=-1) > 6
    assert wrong.mean() > 0.35
    assert (error < mirrored)[sided].mean() > 0.9
    assert all(pair["margin"] > 0 for pair in report["left_right"].values())
    assert apart(dense.arrays["view_path"], azimuth).max() < np.radians(12)
    assert report["view_certainty"] > 0.8
    # The parts follow, and the side of the surface with them: where a leg's part is, its own side is.
    parts, surface = dense.arrays["parts"], dense.arrays["surface"]
    left = [p + 1 for p, n in enumerate(walk.labels.parts) if "left" in n]
    right = walk.labels.mirror_part[left]
    label = parts.argmax(1)
    assert (surface[:, 1][np.isin(label, left)] > 0).mean() > 0.95
    assert (surface[:, 1][np.isin(label, right)] < 0).mean() > 0.95
    truth = Walk(kind, azimuth=azimuth, wrong=np.zeros(40, bool))(None).parts.argmax(1)
    legs = np.isin(truth, [*left, *right])
    assert (label == truth)[legs].mean() > 0.85


def test_what_is_right_already_stays():
    walk = Walk("quadruped", azimuth=1.2, wrong=np.zeros(40, bool))
    columns, _, report = from_network(walk, walk.skeleton, walk.labels, walk.shots, lambda x: None)
    mirrored = walk.places[:, walk.labels.mirror_keypoint]
    wrong = np.linalg.norm(columns.places - walk.places, axis=-1) > np.linalg.norm(columns.places - mirrored, axis=-1)
    assert wrong[np.linalg.norm(walk.places - mirrored, axis=-1) > 12].mean() < 0.01
    assert min(p["certainty"] for p in report["left_right"].values()) > 0.9
    assert min(p["margin"] for p in report["left_right"].values()) > 20
    assert np.median(np.abs(columns.places - walk.places)) < 0.5
    assert columns.confidence.max() <= 1
