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


@pytest.mark.parametrize("hands_first", [True, False])
def test_person_hands_are_told_from_feet(tmp_path, hands_first):
    frames = animal_frames()
    columns = slice(6, 12) if hands_first else slice(12, 18)
    frames[:, columns] += np.tile([0, 0, 1.2], 2)
    motion = load_keypoints(write(tmp_path / "p.json", frames))
    assert motion["left_wrist"][0, 2] > 1 > motion["left_ankle"][0, 2]


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
