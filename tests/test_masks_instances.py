"""Masks among several: whom the user means, who is who where animals cross, posts, leaving the frame, nobody there.

The network is a stand-in that finds whatever is not the ground, so that what is tested is everything around it.
"""

import cv2
import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.reconstruct.flow import dense_flow
from slomo.reconstruct.instances import Choice, Look, choose, components, follow, tell_apart
from slomo.reconstruct.instances_motion import SharedMotion, foreign
from slomo.reconstruct.saliency import SaliencySegmenter, _Track
from slomo.reconstruct.stage import MasksConfig, run_masks
from slomo.stage import Artifact, Inputs, Silent

H, W = 120, 200


class SeesWhatIsNoGround:
    """The ground's blue is below 100, everything else's above 150."""

    digest = "0"

    def __call__(self, image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur((image[..., 2] > 125).astype(np.float32), (0, 0), 0.8)

    def crop(self, image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
        x0, y0, x1, y1 = box
        out = np.zeros(image.shape[:2], np.float32)
        out[y0:y1, x0:x1] = self(image[y0:y1, x0:x1])
        return out


def texture(seed: int, h: int = 200, w: int = 900) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.mean([cv2.resize(rng.uniform(0, 255, (h // s, w // s, 3)), (w, h)) for s in (3, 8)], axis=0)


def scene(T: int, things, *, camera=lambda t: 0.0) -> tuple[np.ndarray, list[np.ndarray]]:
    """Frames (T, H, W, 3) with `things` (mask of (x, y) about its middle, middle x of t, tint) drawn in order over a
    ground that the camera moves along; and the visible masks (T, H, W) of each."""
    ground = texture(0) * [0.9, 0.9, 0.35]
    coats = [texture(i + 1, 120, 200) for i in range(len(things))]
    y, x = np.mgrid[:H, :W].astype(np.float32)
    frames, masks = [], [[] for _ in things]
    for t in range(T):
        shift = camera(t)
        picture = cv2.getRectSubPix(ground.astype(np.float32), (W, H), (400 + shift, 100))
        shapes = [shape(x - (middle(t) - shift), y) for shape, middle, _ in things]
        for i, ((_, middle, tint), mask) in enumerate(zip(things, shapes, strict=True)):
            coat = cv2.getRectSubPix(coats[i].astype(np.float32), (W, H), (200 - (middle(t) - shift), 60))
            picture[mask] = (0.5 * coat * tint + 0.5 * 255 * np.array(tint))[mask] * [1, 1, 0] + [0, 0, 200]
            seen = mask & ~np.logical_or.reduce([np.zeros_like(mask), *shapes[i + 1 :]])
            masks[i].append(seen)
        frames.append(np.clip(picture, 0, 255).astype(np.uint8))
    return np.array(frames), [np.array(m) for m in masks]


def body(x, y):
    return ((x / 30) ** 2 + ((y - 62) / 19) ** 2 < 1) | ((abs(x - 20) < 4) | (abs(x + 20) < 4)) & (abs(y - 80) < 15)


def small_body(x, y):
    return (x / 20) ** 2 + ((y - 52) / 13) ** 2 < 1


def post(x, y):
    return (abs(x) < 6) & (y < 110)


RED, GREEN, GREY = (0.9, 0.2, 1.0), (0.2, 0.8, 1.0), (0.5, 0.45, 1.0)


def iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a & b).sum((1, 2)) / np.maximum((a | b).sum((1, 2)), 1)


def segment(frames: np.ndarray, choice: Choice | None = None, network: SeesWhatIsNoGround | None = None):
    network = network or SeesWhatIsNoGround()
    segmenter = SaliencySegmenter(network, choice or Choice(), every=2)  # pyright: ignore[reportArgumentType]
    return segmenter.segment(frames, dense_flow(frames), lambda f: None)


def test_one_crosses_behind_the_other_and_each_can_be_picked():
    things = [(small_body, lambda t: 175 - 4.0 * t, GREEN), (body, lambda t: 70 + 1.5 * t, RED)]
    frames, (behind, front) = scene(36, things, camera=lambda t: 0.5 * t)
    found = segment(frames)
    assert iou(found.masks, front).mean() > 0.9
    assert iou(found.masks, front).min() > 0.75
    assert found.report["chosen"] == "largest"
    assert found.report["instances_most"] == 2
    picked = segment(frames, Choice(0, point=(175.0, 52.0)))
    alone = behind.sum((1, 2)) > 0.8 * behind[0].sum()
    before = np.arange(36) < 12
    assert iou(picked.masks, behind)[alone & before].min() > 0.8
    assert iou(picked.masks, front).max() < 0.4  # it never hops to the other
    assert picked.report["chosen"] == "at"


def test_a_small_animal_among_large_things_before_a_camera_that_stands_still():
    def large(x, y):
        return (abs(x) < 28) & (y > 8) & (y < 70)

    def tiny(x, y):
        return (x / 20) ** 2 + ((y - 95) / 11) ** 2 < 1

    things = [(large, lambda t: 40.0, GREY), (large, lambda t: 150.0, GREEN), (tiny, lambda t: 40 + 2.0 * t, RED)]
    frames, (_, _, animal) = scene(30, things)
    found = segment(frames)
    assert iou(found.masks, animal).mean() > 0.85


def test_what_passes_fast_is_no_animal_when_what_stands_out_is_alive():
    """A post near a camera that goes around moves more than an animal that walks on the spot that it looks at."""

    def head(x, y):
        return (x / 14) ** 2 + ((y - 42) / 14) ** 2 < 1

    things = [(post, lambda t: 20 + 1.5 * t, GREY), (body, lambda t: 130 + 0.2 * t, RED),
              (head, lambda t: 100 + 0.8 * t, RED)]  # fmt: skip
    frames, (_, trunk, nods) = scene(20, things)
    assert iou(segment(frames).masks, trunk | nods).min() > 0.8


def test_what_an_animal_walks_up_to_is_not_the_animals():
    """It touches a thing as large as itself in a third of the clip, and moves little."""

    def feeder(x, y):
        return (abs(x) < 24) & (y > 28) & (y < 95)

    things = [(feeder, lambda t: 150.0, GREY), (body, lambda t: 93.5 + 0.25 * t, RED)]
    frames, (_, animal) = scene(40, things)
    found = segment(frames)
    assert iou(found.masks, animal).min() > 0.8


class ForgetsWhatIsNear(SeesWhatIsNoGround):
    """What is at most 40 px to the left of a red body, and does not touch it, does not stand out."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        seen = super().__call__(image)
        red = (seen > 0.5) & (image[..., 0] > image[..., 1] + 60)
        if not red.any():
            return seen
        for piece in components(seen > 0.5, 30):
            if not (piece & red).any():
                away = np.nonzero(red.any(0))[0].min() - np.nonzero(piece.any(0))[0].max()
                seen[piece] *= away > 40
        return seen


class ForgetsAFoot(SeesWhatIsNoGround):
    """What lies under a body does not stand out while the body is at x = 96 to 102."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        seen = super().__call__(image)
        if image.shape[:2] == (H, W) and 96 <= np.nonzero(seen[56] > 0.5)[0].mean() <= 102:
            seen[75:] = 0
        return seen

    def crop(self, image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
        x0, y0, x1, y1 = box
        inside = np.zeros(image.shape[:2], bool)
        inside[y0:y1, x0:x1] = True
        return self(image) * inside


def test_a_foot_that_stands_is_still_the_subjects_when_it_is_seen_again():
    """It is wider than a leg, and does not share the motion of the body over it, like a box; but it was there."""

    def foot(x, y):
        return (abs(x) < 10) & (y > 62) & (y < 96)

    def trunk(x, y):
        return (x / 30) ** 2 + ((y - 56) / 17) ** 2 < 1

    things = [(foot, lambda t: 96.0, RED), (trunk, lambda t: 84 + 1.0 * t, RED)]
    frames, masks = scene(34, things)
    found = segment(frames, Choice(0, point=(84.0, 56.0)), ForgetsAFoot())
    whole = iou(found.masks, masks[0] | masks[1])
    assert whole[:10].min() > 0.85
    assert whole[20:].min() > 0.85


def test_feet_that_stand_before_a_camera_that_goes_around_are_the_subjects(monkeypatch):
    """The nearer a part of a body is to the ground, the less it moves against it. Flow is unsure at the outline."""
    lasting = SharedMotion.lasting
    kernel = np.ones((5, 5), np.uint8)
    monkeypatch.setattr(SharedMotion, "lasting", lambda *a: cv2.erode(lasting(*a).astype(np.uint8), kernel) > 0)

    def slab(top, bottom, half):
        return lambda x, y: (abs(x) < half) & (y >= top) & (y < bottom)

    parts = [(74, 104, 14, 0.0), (56, 74, 14, 0.4), (36, 56, 18, 0.9), (12, 36, 14, 1.4)]
    things = [(slab(*where), lambda t, v=v: 90 + v * t, RED) for *where, v in parts]
    frames, masks = scene(24, things)
    found = segment(frames)
    assert iou(found.masks, np.logical_or.reduce(masks)).min() > 0.85


class Still:
    """Flow and motion of a picture in which nothing moves."""

    def chain(self, source: int, target: int) -> np.ndarray:
        return np.zeros((H, W, 2), np.float32)

    def velocity(self, t: int, mask: np.ndarray) -> np.ndarray:
        return np.zeros(2)

    def calm(self, t: int) -> np.ndarray:
        return np.ones((H, W), bool)


def test_what_was_the_subjects_of_late_is_trusted_to_be(monkeypatch):
    trunk, foot, crate = (np.zeros((H, W), bool) for _ in range(3))
    trunk[40:60, 50:80], foot[70:80, 50:60], crate[40:60, 90:110] = True, True, True
    nothing, asked = np.zeros((H, W), bool), {}

    def look_at(self, t, carried, others, own):
        asked[t] = own
        return trunk | (foot if t < 10 else nothing) | (crate if t in (5, 20, 21, 22, 23, 24) else nothing), nothing

    monkeypatch.setattr(_Track, "_look_at", look_at)
    track = _Track(SeesWhatIsNoGround(), np.zeros((40, H, W, 3), np.uint8), Still(), Still(), 0.15, 1)  # pyright: ignore
    track.start(0, trunk | foot, nothing)
    track.follow(list(range(40)), lambda: None)
    assert all(asked[t][trunk].all() for t in range(40))
    assert [bool(asked[t][foot].all()) for t in (1, 9, 12, 18, 30)] == [True, True, True, True, False]
    assert not any(asked[t][crate].any() for t in range(40))  # a few frames are nothing


def test_furniture_that_did_not_stand_out_for_a_while_is_still_there_when_it_is_touched():
    def feeder(x, y):
        return (abs(x) < 14) & (y > 28) & (y < 95)

    things = [(feeder, lambda t: 30.0, GREY), (body, lambda t: 122 - 0.38 * min(t, 130), RED)]
    frames, (_, animal) = scene(210, things)
    found = segment(frames, Choice(0, point=(122.0, 62.0)), ForgetsWhatIsNear())
    assert iou(found.masks, animal).min() > 0.8
    assert found.report["colour_repaired_frames"] == 0  # by colour legs may go with it


def test_a_box_picks_and_an_empty_place_says_so():
    things = [(small_body, lambda t: 170 + 0.5 * t, GREEN), (body, lambda t: 50 + 1.0 * t, RED)]
    frames, (right, left) = scene(16, things)
    assert iou(segment(frames, Choice(4, box=(145.0, 35.0, 198.0, 70.0))).masks, right).mean() > 0.85
    assert iou(segment(frames, Choice(4, box=(15.0, 40.0, 90.0, 98.0))).masks, left).mean() > 0.85
    with pytest.raises(InvalidData, match="--subject-at"):
        segment(frames, Choice(4, point=(110.0, 15.0)))
    with pytest.raises(InvalidData, match="--subject-box"):
        segment(frames, Choice(4, box=(100.0, 2.0, 130.0, 20.0)))


def test_a_post_in_front_leaves_one_animal():
    things = [(body, lambda t: 60 + 2.5 * t, RED), (post, lambda t: 105.0, GREY)]
    frames, (animal, _) = scene(36, things, camera=lambda t: 1.0 * t)
    masks = segment(frames).masks
    assert iou(masks, animal).mean() > 0.85
    split = [t for t in range(36) if len(components(animal[t], 150)) == 2]
    assert split
    both = [all((masks[t] & c).sum() > 0.5 * c.sum() for c in components(animal[t], 150)) for t in split]
    assert np.mean(both) > 0.7


def test_who_leaves_the_frame_is_not_invented_and_found_again():
    def away(t):
        return 200 * (0.5 - 0.5 * np.cos(2 * np.pi * np.clip((t - 6) / 48, 0, 1)))

    things = [(small_body, lambda t: 300.0, GREEN), (body, lambda t: 70 + 1.0 * t, RED)]
    frames, (_, animal) = scene(60, things, camera=away)
    masks = segment(frames).masks
    gone = animal.sum((1, 2)) == 0
    assert gone.sum() > 5
    assert not masks[gone].any()
    assert iou(masks, animal)[-6:].min() > 0.85
    assert iou(masks, animal)[:6].min() > 0.85


def test_what_stands_out_but_never_moves_is_no_subject():
    frames, _ = scene(20, [(body, lambda t: 100.0, GREY)], camera=lambda t: 0.7 * t)
    with pytest.raises(InvalidData, match="never moves"):
        segment(frames)


def test_motion_follows_the_one_that_is_picked():
    found = {}
    for k in range(6):
        found[k] = np.zeros((H, W), bool)
        found[k][20:60, 10 + k : 60 + k] = True
        found[k][80:100, 120 - k : 150 - k] = True
    frames = np.zeros((6, H, W, 3), np.uint8)
    flow = dense_flow(frames)
    assert all(m[30, 40] and not m[90, 130] for m in follow(found, flow, Choice()).values())
    assert all(m[90, 130] and not m[30, 40] for m in follow(found, flow, Choice(2, point=(130.0, 90.0))).values())
    with pytest.raises(InvalidData, match="nothing moves where --subject-at points"):
        follow(found, flow, Choice(0, point=(190.0, 5.0)))


def test_pieces_stay_and_strangers_do_not():
    subject = np.zeros((H, W), bool)
    subject[40:80, 60:120] = True
    found = subject.copy()
    found[:, 85:95] = False  # a post
    found[30:60, 150:170] = True  # someone else
    mine, theirs, sure = tell_apart(found, subject, np.zeros_like(subject), lambda piece: False)
    np.testing.assert_array_equal(mine, found & subject)
    assert theirs[40, 160]
    assert sure[40, 160]
    merged = subject | np.roll(subject, 30, axis=1)  # the other half is another's
    mine, theirs, _ = tell_apart(merged, subject, np.roll(subject, 60, axis=1), lambda piece: False)
    assert mine[60, 61:115].all()
    assert theirs[60, 125:149].all()


def test_feet_hang_from_the_body_by_legs_that_are_missed():
    """Not seen now, but its own of late; what nothing of its own leads to has come away."""
    trunk, legs, feet, box = (np.zeros((H, W), bool) for _ in range(4))
    trunk[10:50, 60:90], legs[50:80, 60:75], feet[80:90, 60:80], box[80:90, 120:140] = True, True, True, True
    carried, nothing = trunk | feet | box, np.zeros((H, W), bool)
    mine, theirs, _ = tell_apart(trunk | feet | box, carried, nothing, lambda piece: False, own=trunk | legs | feet)
    np.testing.assert_array_equal(mine, trunk | feet)
    np.testing.assert_array_equal(theirs, box)
    mine, _, _ = tell_apart(trunk | feet, carried, nothing, lambda piece: False)
    assert not mine[feet].any()


def test_shared_motion():
    things = [(post, lambda t: 150.0, GREY), (body, lambda t: 60 + 2.0 * t, RED)]
    frames, (still, animal) = scene(12, things, camera=lambda t: 1.0 * t)
    motion = SharedMotion(dense_flow(frames))
    velocity = motion.velocity(6, animal[6])
    np.testing.assert_allclose(velocity, [4 * 2.0 * 256 / W, 0], atol=3.0)  # DIS smooths
    share = motion.share(6, velocity)
    assert share is not None
    assert foreign(animal[6] | still[6], animal[6], share)[still[6]].mean() > 0.5
    assert foreign(animal[6] | still[6], animal[6], share)[animal[6]].mean() < 0.05
    assert motion.share(6, np.zeros(2)) is None
    assert motion.liveliness(6, animal[6]) > 1 > motion.liveliness(6, still[6])


def test_what_a_body_has_for_as_long_as_it_is_seen_is_its_own_though_it_does_not_move():
    things = [(post, lambda t: 150.0, GREY), (body, lambda t: 60 + 2.0 * t, RED)]
    frames, (still, animal) = scene(12, things)
    motion = SharedMotion(dense_flow(frames))
    with_it = {t: animal[t] | still[t] for t in (0, 6, 11)}
    assert motion.lasting(6, still[6], with_it)[still[6]].mean() > 0.9
    passed = with_it | {11: animal[11]}
    assert motion.lasting(6, still[6], passed).sum() < 0.1 * still[6].sum()


def test_a_leg_that_stood_comes_along_and_what_is_passed_is_left_behind():
    """A body that steps from one wide leg onto the next beside a crate, which both its start and its end show."""

    def leg(x, y):
        return (abs(x) < 8) & (y > 70) & (y < 105)

    def crate(x, y):
        return (abs(x) < 12) & (y > 75) & (y < 105)

    step = lambda t: 60.0 if t < 10 else min(60.0 + 8 * (t - 10), 140.0)  # noqa: E731

    def trunk_of(x, y):
        return (x / 32) ** 2 + ((y - 50) / 20) ** 2 < 1

    things = [(crate, lambda t: 90.0, GREY), (leg, step, RED), (trunk_of, lambda t: 60 + 3.0 * t, RED)]
    frames, (still, standing, trunk) = scene(31, things, camera=lambda t: 0.5 * t)
    motion = SharedMotion(dense_flow(frames))
    bodies = {t: standing[t] | trunk[t] for t in (0, 5, 10, 20, 30)}
    gone = motion.gone(5, standing[5] | still[5], frames, bodies)
    assert gone[standing[5]].mean() > 0.9
    assert gone[still[5]].mean() < 0.1
    # Nothing is known of what no other frame shows the place of.
    assert not motion.gone(5, standing[5], frames, {5: bodies[5]}).any()
    assert not motion.gone(5, standing[5], frames, {t: np.ones_like(bodies[5]) for t in bodies}).any()


def test_a_little_motion_is_enough_before_a_camera_that_stands_still():
    things = [(post, lambda t: 150.0, GREY), (body, lambda t: 60 + 0.25 * t, RED)]
    frames, (still, animal) = scene(12, things)
    motion = SharedMotion(dense_flow(frames))
    assert motion.liveliness(6, animal[6]) > 1
    assert motion.liveliness(6, still[6]) < 0.3


def test_look_knows_its_own():
    frames, (a, b) = scene(3, [(small_body, lambda t: 40.0, GREEN), (body, lambda t: 140.0, RED)])
    look = Look()
    for t in range(2):
        look.learn(frames[t], b[t])
    assert look.likeness(frames[2], b[2]) > 0.95
    assert look.likeness(frames[2], a[2]) < 0.6


VIDEO = dict(
    source_width=1280, source_height=720, pixel_aspect=1.0, rotation=0, width=640, height=360, start_s=1.0, fps=20.0
)


def test_what_the_user_points_at():
    assert choose((), (), VIDEO, 50) == Choice()
    assert choose((640, 180), (), VIDEO, 50) == Choice(0, point=(320.0, 90.0))
    assert choose((), (100, 200, 60, 20, 2.0), VIDEO, 50) == Choice(20, box=(30.0, 10.0, 50.0, 100.0))
    turned = VIDEO | dict(rotation=90, width=360, height=640)
    assert choose((360, 1280), (), turned, 50).point == (180.0, 640.0)
    wide = VIDEO | dict(source_width=960, pixel_aspect=4 / 3)  # players show it 1280 px wide
    assert choose((1200, 180), (), wide, 50).point == pytest.approx((600.0, 90.0))
    assert choose((), (0, 0, 320, 720), wide, 50).box == pytest.approx((0.0, 0.0, 160.0, 360.0))
    narrow = wide | dict(rotation=90, width=360, height=640)
    assert choose((360, 1200), (), narrow, 50).point == pytest.approx((180.0, 600.0))
    for at, box, what in (
        ((1, 2), (1, 2, 30, 40), "a point and a box"),
        ((1,), (), "has 1 numbers"),
        ((), (1, 2, 3), "has 3 numbers"),
        ((2000, 10), (), "outside the picture"),
        ((20, 10, 0.5), (), "not used"),
        ((20, 10, 9.0), (), "1 to 3.45 s"),
        ((), (10, 10, 12, 12), "less than 4 px"),
    ):
        with pytest.raises(UsageError, match=what):
            choose(at, box, VIDEO, 50)


def test_own_masks_say_who_it_is(tmp_path):
    decoded = Artifact(npz={"frames.npz": {"frames": np.zeros((8, H, W, 3), np.uint8), "t": np.arange(8) / 30}})
    with pytest.raises(UsageError, match="say who the subject is"):
        run_masks(
            Inputs(artifacts={"decode": decoded}, files={"masks": tmp_path}), MasksConfig(subject_at=(5, 5)), Silent()
        )
