"""Dark and hazy clips get their contrast back; others are left alone to the bit."""

import av
import numpy as np
import pytest

from slomo.reconstruct import decode_stage
from slomo.reconstruct.exposure import FLAT, FULL, MOST, stretch
from slomo.stage import Inputs
from test_video import Notes


def _frames(low: float, high: float) -> np.ndarray:
    """(3, 40, 60, 3) whose values run from low to high, less bright from frame to frame, and more red than blue."""
    ramp = np.linspace(0, 1, 40 * 60).reshape(40, 60)
    shade = np.array([1.0, 0.95, 0.9])
    return np.stack([(low + (high - low) * ramp * k)[..., None] * shade for k in (1.0, 0.95, 0.9)]).astype(np.uint8)


@pytest.mark.parametrize(("low", "high"), [(2, 70), (5, 20), (120, 190)])
def test_a_clip_without_contrast_gets_it(low: float, high: float):
    frames = _frames(low, high)
    before = frames.astype(int)
    gain = stretch(frames)
    spread = np.percentile(frames.max(-1), 99) - np.percentile(frames.min(-1), 1)
    assert 1.5 < gain <= MOST
    assert spread == pytest.approx(FULL, rel=0.06) or gain == MOST
    inner = (frames > 0) & (frames < 255)
    # One line for all frames and channels: what was alike stays alike.
    fit = np.polyfit(before[inner], frames[inner], 1)
    assert np.abs(np.polyval(fit, before[inner]) - frames[inner]).max() < 1.5
    assert fit[0] == pytest.approx(gain, rel=0.02)


@pytest.mark.parametrize(("low", "high"), [(0, 255), (30, 200), (0, FLAT + 30)])
def test_a_clip_with_contrast_stays_as_it_is(low: float, high: float):
    frames = _frames(low, high)
    before = frames.copy()
    assert stretch(frames) == 1
    np.testing.assert_array_equal(frames, before)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_clip_of_one_grey_stays_that(level: int):
    frames = np.full((2, 20, 30, 3), level, np.uint8)
    assert stretch(frames) == MOST
    assert frames.min() == frames.max() == pytest.approx(level, abs=1)


def test_a_small_animal_before_a_plain_ground_is_no_haze():
    frames = _frames(90, 150)
    frames[:, 4:7, 4:7], frames[:, 4:7, 8:11] = 240, 15
    assert stretch(frames) == 1


def test_a_dark_clip_is_decoded_brighter_and_that_is_said(tmp_path):
    path, ramp = tmp_path / "dark.mp4", np.linspace(10, 60, 96 * 64).reshape(64, 96)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 96, 64, "yuv420p", 4_000_000
        for _ in range(12):
            picture = np.repeat(ramp[..., None], 3, 2).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    notes = Notes()
    artifact = decode_stage.run(Inputs(files={"clip": path}), decode_stage.Config(), notes)
    assert artifact.json["video.json"]["contrast"] == pytest.approx(FULL / 50, rel=0.1)
    assert artifact.npz["frames.npz"]["frames"].max() > 180
    assert any("dark" in note for note in notes.notes)
