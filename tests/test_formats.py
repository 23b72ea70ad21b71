"""Key-point files: round trips, and the conventions that have to be told from the data."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slomo.errors import InvalidData
from slomo.formats import load_keypoints
from slomo.motion import KeypointMotion

SHARED = Path(__file__).resolve().parents[2] / "shared" / "keypoints"


def animal_frames(*, heading: float = 0.0, up: float = 1.0, swapped: bool = False) -> np.ndarray:
    """(40, 18) in the published layout: an animal that walks along `heading`."""
    t = np.linspace(0, 1, 40)
    forward, left = np.array([np.cos(heading), np.sin(heading), 0]), np.array([-np.sin(heading), np.cos(heading), 0])
    root = np.outer(t, forward) + [0, 0, 1.0]
    feet = []
    for x in (1.0, 0.0):
        for y in (-0.2, 0.2) if swapped else (0.2, -0.2):
            feet.append(root * [1, 1, 0] + x * forward + y * left + np.outer(0.05 * np.sin(9 * t) ** 2, [0, 0, 1]))
    angles = np.tile([heading + 1.2, 0.1, 0.3], (40, 1))
    points = np.stack([root, *feet], axis=1)
    if up < 0:
        points[..., 1:] *= -1
    return np.concatenate([points[:, 0], angles, points[:, 1:].reshape(40, 12)], axis=1)


def write(path: Path, frames: np.ndarray, dt: float = 0.033) -> Path:
    path.write_text(json.dumps({"FrameDuration": dt, "Frames": frames.tolist()}))
    return path


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("up", [1.0, -1.0])
def test_animal_heading_up_and_sides_are_told_from_the_data(tmp_path, heading, up):
    motion = load_keypoints(write(tmp_path / "a.json", animal_frames(heading=heading, up=up)))
    along = motion["withers"][0] - motion["pelvis"][0]
    np.testing.assert_allclose(along / np.linalg.norm(along), [np.cos(heading), np.sin(heading), 0], atol=1e-6)
    across = motion["front_left_paw"][0] - motion["front_right_paw"][0]
    np.testing.assert_allclose(across, 0.4 * np.array([-np.sin(heading), np.cos(heading), 0]), atol=1e-6)
    assert motion["pelvis"][0, 2] > motion["hind_left_paw"][0, 2]


def test_exchanged_sides_are_put_right_and_said(tmp_path):
    notes: list[str] = []
    swapped = load_keypoints(write(tmp_path / "a.json", animal_frames(swapped=True)), note=notes.append)
    straight = load_keypoints(write(tmp_path / "b.json", animal_frames()))
    np.testing.assert_allclose(swapped.positions, straight.positions, atol=1e-9)
    assert any("exchanged" in n for n in notes)


def person_frames(*, hands_first: bool = True, up: float = 1.0, arms: float = 1.0) -> np.ndarray:
    """(60, 18): a person who steps on the spot and moves the arms, whose hands are `arms` over the hips."""
    t = np.linspace(0, 3, 60)
    zero = np.zeros_like(t)
    root = np.stack([zero, 0.02 * np.sin(4 * t), 1.0 + zero], axis=1)
    lift = 0.1 * np.clip(np.sin(5 * t + np.array([[0], [np.pi]])), 0, 1)
    foot = [np.stack([zero, y + zero, z], axis=1) for y, z in zip((0.1, -0.1), lift, strict=True)]
    hand = [root + np.stack([0.2 * np.sin(5 * t), y + zero, arms + 0.3 * np.cos(3 * t)], axis=1) for y in (0.4, -0.4)]
    points = np.stack([root, *(hand + foot if hands_first else foot + hand)], axis=1)
    if up < 0:
        points[..., 1:] *= -1
    angles = np.tile([1.6, 0.0, 1.6], (60, 1))
    return np.concatenate([points[:, 0], angles, points[:, 1:].reshape(60, 12)], axis=1)


@pytest.mark.parametrize("hands_first", [True, False])
@pytest.mark.parametrize("up", [1.0, -1.0])
@pytest.mark.parametrize("arms", [0.8, -0.1])
def test_person_hands_and_up_are_told_from_feet_that_stand(tmp_path, hands_first, up, arms):
    notes: list[str] = []
    frames = person_frames(hands_first=hands_first, up=up, arms=arms)
    motion = load_keypoints(write(tmp_path / "p.json", frames, dt=0.05), note=notes.append)
    assert motion.names == ("pelvis", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
    straight = load_keypoints(write(tmp_path / "q.json", person_frames(arms=arms), dt=0.05))
    np.testing.assert_allclose(motion.positions, straight.positions, atol=1e-9)
    assert any(f"{'hands' if hands_first else 'feet'} first" in n for n in notes)
    assert any("z points down" in n for n in notes) == (up < 0)
    assert any("first of each pair counts as the left one" in n for n in notes)


def test_person_whose_hands_stand_as_still_as_the_feet_is_refused(tmp_path):
    frames = person_frames(arms=0.9)
    frames[:, 6:18] = frames[:1, 6:18]
    with pytest.raises(InvalidData, match=r"cannot tell up from down: with z (up|down) and with z (up|down)"):
        load_keypoints(write(tmp_path / "p.json", frames))


def test_exchanged_hands_are_put_right_and_crossing_ones_refused(tmp_path):
    notes: list[str] = []
    frames = person_frames()
    exchanged = frames[:, [*range(6), 9, 10, 11, 6, 7, 8, *range(12, 18)]]
    got = load_keypoints(write(tmp_path / "a.json", exchanged, dt=0.05), note=notes.append)
    np.testing.assert_allclose(got.positions, load_keypoints(write(tmp_path / "b.json", frames, dt=0.05)).positions)
    assert any("hands exchanged" in n for n in notes)
    half = np.concatenate([frames[:30], exchanged[30:]])
    with pytest.raises(InvalidData, match="which hand is on which foot's side"):
        load_keypoints(write(tmp_path / "c.json", half, dt=0.05))


def test_person_who_would_walk_backwards_is_turned_round(tmp_path):
    notes: list[str] = []
    frames = person_frames()
    walked = np.linspace(0, -4, len(frames))[:, None]
    frames[:, [0, 6, 9, 12, 15]] += walked
    motion = load_keypoints(write(tmp_path / "p.json", frames, dt=0.05), note=notes.append)
    assert any("walk backwards" in n for n in notes)
    assert motion["left_ankle"][0, 1] < motion["right_ankle"][0, 1]


@pytest.mark.parametrize(("order", "sign"), [([0, 2, 1], 1.0), ([0, 2, 1], -1.0), ([2, 1, 0], 1.0)])
def test_another_axis_may_be_up_where_z_makes_no_sense(tmp_path, order, sign):
    notes: list[str] = []
    frames = animal_frames()
    points = np.concatenate([frames[:, :3], frames[:, 6:]], axis=1).reshape(-1, 5, 3)[..., order] * 1.0
    points[..., order.index(2)] *= sign
    points[..., 0 if order[0] == 0 else 1] *= -sign  # a rotation, not a mirror
    moved = np.concatenate([points[:, 0], frames[:, 3:6], points[:, 1:].reshape(len(frames), 12)], axis=1)
    motion = load_keypoints(write(tmp_path / "a.json", moved), note=notes.append)
    assert motion["pelvis"][0, 2] - motion["hind_left_paw"][0, 2] == pytest.approx(1.0)
    assert any("so that z is up" in n for n in notes)
    axes = np.stack([motion["withers"] - motion["pelvis"], motion["front_left_paw"] - motion["front_right_paw"]])[:, 0]
    assert np.cross(axes[0], axes[1])[2] > 0


def test_heading_is_told_where_the_angle_runs_the_other_way(tmp_path):
    frames = animal_frames()
    t = np.linspace(0, 1, len(frames))
    c, s = np.cos(t), np.sin(t)
    points = np.concatenate([frames[:, :3], frames[:, 6:]], axis=1).reshape(-1, 5, 3)
    points[..., :2] = np.stack([c[:, None] * points[..., 0] - s[:, None] * points[..., 1],
                                s[:, None] * points[..., 0] + c[:, None] * points[..., 1]], axis=2)  # fmt: skip
    for sign in (1.0, -1.0):
        frames[:, 3] = sign * t + 0.7
        whole = np.concatenate([points[:, 0], frames[:, 3:6], points[:, 1:].reshape(len(frames), 12)], axis=1)
        motion = load_keypoints(write(tmp_path / "a.json", whole))
        along = (motion["withers"] - motion["pelvis"])[:, :2]
        np.testing.assert_allclose(np.unwrap(np.arctan2(along[:, 1], along[:, 0])), t, atol=0.02)


def test_undecidable_limbs_fail_clearly(tmp_path):
    frames = animal_frames()
    frames[:, 8] += 2.0  # three feet on the ground
    with pytest.raises(InvalidData, match="cannot tell animal from person"):
        load_keypoints(write(tmp_path / "x.json", frames))


def test_bad_files_name_the_file_and_the_place(tmp_path):
    frames = animal_frames()
    frames[7, 3] = np.nan
    path = write(tmp_path / "nan.json", frames)
    with pytest.raises(InvalidData, match=r"nan\.json: not a finite number in frame 7, column 3"):
        load_keypoints(path)
    for content, message in (
        (b"", "empty"),
        (b"hello", "neither"),
        (b"PK\x03\x04cut", "not a readable"),
        (b"[1]", "needs"),
    ):
        path = tmp_path / "bad"
        path.write_bytes(content)
        with pytest.raises(InvalidData, match=message):
            load_keypoints(path)
    with pytest.raises(InvalidData, match="No such file"):
        load_keypoints(tmp_path / "missing.json")


finite = st.floats(-1e3, 1e3, width=32)


@settings(max_examples=30, deadline=None)
@given(
    data=st.data(),
    T=st.integers(2, 6),
    N=st.integers(1, 5),
)
def test_keypoints_npz_round_trip(tmp_path_factory, data, T, N):
    motion = KeypointMotion(
        t=np.cumsum(data.draw(hnp.arrays(float, T, elements=st.floats(0.01, 1)))),
        positions=data.draw(hnp.arrays(float, (T, N, 3), elements=finite)),
        names=tuple(f"k{i}" for i in range(N)),
        confidence=data.draw(hnp.arrays(float, (T, N), elements=st.floats(0, 1))),
        contact=data.draw(hnp.arrays(float, (T, 1), elements=st.floats(0, 1))),
        contact_names=("k0",),
    )
    path = tmp_path_factory.mktemp("npz") / "keypoints.npz"
    np.savez(path, **motion.to_arrays())
    back = load_keypoints(path)
    assert back.names == motion.names
    assert back.contact_names == motion.contact_names
    for name in ("t", "positions", "confidence", "contact"):
        np.testing.assert_array_equal(getattr(back, name), getattr(motion, name))


@pytest.mark.parametrize("name", ["cat00", "dog_cpr"])
def test_published_animals(name):
    path = SHARED / f"{name}.json"
    if not path.exists():
        pytest.skip("shared key-point files are not beside this checkout")
    motion = load_keypoints(path)
    feet = np.mean([motion[f"{e}_{s}_paw"] for e in ("front", "hind") for s in ("left", "right")], axis=0)
    assert np.all(motion["pelvis"][:, 2] > feet[:, 2])
    # The front end rises with the front feet, or the sign of pitch is wrong.
    rise = (motion["withers"] - motion["pelvis"])[26:109, 2]
    step = sum(motion[f"front_{s}_paw"] - motion[f"hind_{s}_paw"] for s in ("left", "right"))[26:109, 2]
    assert np.corrcoef(rise, step)[0, 1] > 0.3


def test_published_person():
    path = SHARED / "human_jumping_jack.json"
    if not path.exists():
        pytest.skip("shared key-point files are not beside this checkout")
    notes: list[str] = []
    motion = load_keypoints(path, note=notes.append)
    assert "z points down in this file: turned by 180 degrees about x" in notes
    assert "a person, hands first" in notes
    feet = np.minimum(motion["left_ankle"], motion["right_ankle"])[:, 2]
    hands = (motion["left_wrist"] + motion["right_wrist"])[:, 2] / 2
    # Jumping jacks: the hands go from the hips to over the head, the feet apart and together, and each side does alike.
    assert np.ptp(hands) > 0.5
    assert motion["pelvis"][0, 2] > feet.max() + 0.5
    assert any("unrolled" in note for note in notes)
    apart = motion["left_ankle"] - motion["right_ankle"]
    assert np.abs(apart[:, 2]).max() < 0.1 < 0.3 < np.ptp(np.linalg.norm(apart, axis=1))


def person(path, roll, *, raised=0.0):
    """A file of five points: jumping jacks of a body that rolls, or one that only raises its left leg."""
    t = 0.1 * np.arange(60)
    open_ = 0.3 + 0.25 * np.sin(2 * t)
    ends = np.zeros((60, 4, 3))
    for i, (side, up, length) in enumerate([(1, 1, 0.7), (-1, 1, 0.7), (1, -1, 0.9), (-1, -1, 0.9)]):
        angle = np.pi - 2.4 * open_ if up > 0 else open_
        if raised and up < 0:
            angle = 0.3 + (raised * (1 + np.sin(2 * t)) if i == 2 else 0 * t)
        ends[:, i, 1], ends[:, i, 2] = side * length * np.sin(angle), -length * np.cos(angle)
    s, c = np.sin(roll * np.sin(2 * t))[:, None], np.cos(roll * np.sin(2 * t))[:, None]
    ends[..., 1], ends[..., 2] = c * ends[..., 1] - s * ends[..., 2], s * ends[..., 1] + c * ends[..., 2]
    root = np.tile([0.0, 0.0, 1.0], (60, 1))
    frames = np.concatenate([root, np.zeros((60, 3)), (ends + root[:, None]).reshape(60, 12)], axis=1)
    path.write_text(json.dumps({"FrameDuration": 0.1, "Frames": frames.tolist()}))
    return load_keypoints(path)


def test_roll_that_arms_and_legs_share_is_the_bodys(tmp_path):
    straight, rolled = person(tmp_path / "a.json", 0.0), person(tmp_path / "b.json", 0.2)
    np.testing.assert_allclose(rolled.positions, straight.positions, atol=1e-9)


def test_roll_of_one_leg_is_its_own(tmp_path):
    motion = person(tmp_path / "a.json", 0.0, raised=0.3)
    assert np.ptp(motion["left_ankle"][:, 2]) > 0.1
    assert np.ptp(motion["right_ankle"][:, 2]) < 1e-9
