"""Decoding: rotation, variable frame rate, spans, and files that are no clips."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.reconstruct import decode_stage
from slomo.reconstruct.video import decode, fit_in
from slomo.stage import Inputs, Silent


def write_clip(path: Path, times, *, size=(96, 64), codec="mpeg4", faststart=True, tags=()) -> Path:
    """A clip whose frame shown at time s has the gray level 60 s, with a white upper left corner."""
    flags = ["faststart"] * faststart + ["use_metadata_tags"] * bool(tags)
    options = {"movflags": "+".join(flags)} if flags and path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        container.metadata.update(tags)
        stream = container.add_stream(codec, rate=30, options={})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.bit_rate = 4_000_000
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        for time in times:
            picture = np.full((size[1], size[0], 3), round(60 * time), np.uint8)
            picture[:16, :16] = 255
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = round(600 * time), Fraction(1, 600)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def level(frames: np.ndarray) -> np.ndarray:
    return frames[:, 32:, 32:].mean((1, 2, 3)) / 60


def test_uniform_clip(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(60) / 30))
    assert clip.frames.shape == (60, 64, 96, 3)
    assert clip.info["fps"] == pytest.approx(30)
    np.testing.assert_allclose(np.diff(clip.t), 1 / 30, rtol=1e-6)
    np.testing.assert_allclose(level(clip.frames), clip.t, atol=0.06)


def test_faster_source_is_thinned(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(120) / 60), fps=20)
    assert len(clip.t) == 40
    np.testing.assert_allclose(level(clip.frames), clip.t, atol=0.06)


def test_slower_source_keeps_its_rate(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(20) / 10))
    assert clip.info["fps"] == pytest.approx(10)
    assert len(clip.t) == 20


def test_variable_frame_rate_is_resampled_by_nearest_time(tmp_path):
    gaps = np.where(np.arange(60) % 10 == 9, 4 / 30, 1 / 30)  # every tenth frame stays for four
    times = np.concatenate([[0], np.cumsum(gaps)[:-1]])
    clip = decode(write_clip(tmp_path / "a.mkv", times))
    np.testing.assert_allclose(np.diff(clip.t), 1 / 30, rtol=1e-3)
    farther = abs(level(clip.frames) - clip.t) - abs(times[None] - clip.t[:, None]).min(1)
    assert farther.max() < 0.06  # a twentieth of a second is three gray levels


def test_start_and_duration(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(120) / 30), start=2.0, duration=1.0)
    assert len(clip.t) == 30
    assert clip.t[0] == 0
    np.testing.assert_allclose(level(clip.frames), clip.t + 2.0, atol=0.06)


def test_slow_motion_has_the_times_of_life(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(120) / 30)
    clip = decode(path, slow_motion=4.0)
    assert clip.info["slow_motion"] == 4
    np.testing.assert_allclose(clip.t, np.arange(30) / 30)  # of 120 a second every fourth
    np.testing.assert_allclose(level(clip.frames), 4 * clip.t, atol=0.06)


def test_the_span_of_slow_motion_is_one_of_the_clip_as_it_plays(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(120) / 30)
    clip = decode(path, start=1.0, duration=2.0, slow_motion=4.0)
    np.testing.assert_allclose(clip.t, np.arange(15) / 30)
    np.testing.assert_allclose(level(clip.frames), 1.0 + 4 * clip.t, atol=0.06)
    # What asks for a second of the clip (`--subject-at`, key points of the user's) is told of the clip's own, too.
    assert clip.info["start_s"] == pytest.approx(1.0)
    assert clip.info["fps"] == pytest.approx(7.5)


def test_slow_motion_that_keeps_all_of_its_few_frames(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(20) / 10), slow_motion=2.0)
    np.testing.assert_allclose(clip.t, np.arange(20) / 20)


@pytest.mark.parametrize(
    ("capture", "slow"), [("240.000000", 8), ("119.88", 3.996), ("30.0", 1), ("60", 1), ("2", 1), ("inf", 1), ("?", 1)]
)
def test_slow_motion_that_the_file_tells_of(tmp_path, capture, slow):
    path = write_clip(tmp_path / "a.mp4", np.arange(120) / 30, tags={"com.android.capture.fps": capture})
    assert decode(path).info["slow_motion"] == pytest.approx(slow)
    assert decode(path, slow_motion=1.0).info["slow_motion"] == 1


def test_slow_motion_is_said(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(120) / 30, tags={"com.android.capture.fps": "120"})
    told = []

    class Heard(Silent):
        def note(self, message):
            told.append(message)

    decode_stage.run(Inputs(files={"clip": path}), decode_stage.Config(), Heard())
    assert told == ["decode: the clip plays 4 times slower than life, its file says (--slow-motion 1 if it does not)"]
    told.clear()
    decode_stage.run(Inputs(files={"clip": path}), decode_stage.Config(slow_motion=2.0), Heard())
    assert told == ["decode: the clip plays 2 times slower than life"]
    with pytest.raises(UsageError, match="slow_motion"):
        decode_stage.run(Inputs(files={"clip": path}), decode_stage.Config(slow_motion=-1.0), Heard())


@pytest.mark.parametrize(("quarter_turns", "corner"), [(1, (0, -1)), (2, (-1, -1)), (3, (-1, 0))])
def test_rotation_tag(tmp_path, quarter_turns, corner):
    """The display matrix written by hand into the track header: the white corner goes round clockwise."""
    path = write_clip(tmp_path / "a.mp4", np.arange(12) / 30)
    data = bytearray(path.read_bytes())
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter_turns]
    matrix = np.array([c, s, 0, -s, c, 0, 0, 0, 0x4000], float)
    fixed = (matrix * 65536).astype(">i4")
    fixed[8] = 0x40000000
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = fixed.tobytes()
    path.write_bytes(data)
    clip = decode(path)
    assert clip.frames.shape[1:3] == ((96, 64) if quarter_turns % 2 else (64, 96))
    y, x = (4 if i == 0 else -5 for i in corner)
    assert clip.frames[0, y, x].min() > 200
    assert clip.info["rotation"] != 0


def test_long_side_is_bounded(tmp_path):
    clip = decode(write_clip(tmp_path / "a.mp4", np.arange(10) / 30, size=(640, 320)), max_side=160)
    assert clip.frames.shape[1:3] == (80, 160)


def test_small_clips_are_enlarged_where_that_fits_in(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(60) / 30)
    for sides, options in (((96, 144), {"max_side": 144}), ((128, 192), {}), ((124, 188), {"megapixels": 1.4})):
        clip = decode(path, **({"enlarge": 2.0} | options))
        assert clip.frames.shape[1:3] == sides, options
        assert len(clip.t) == 60
        assert clip.info["every"] == 1
        np.testing.assert_allclose(clip.frames[:, 2 * sides[0] // 3 :].mean((1, 2, 3)) / 60, clip.t, atol=0.06)


@pytest.mark.parametrize(("seconds", "every", "side"), [(40, 1, 640), (60, 2, 640), (200, 2, 421), (1000, 2, 320)])
def test_long_clips_fit_in(seconds, every, side):
    """4K at 30 frames a second: the rate is lowered first, then the size; only then is anything left out."""
    got = fit_in(30 * seconds, 30.0, (3840, 2160), 640, 1.0, 300.0)
    assert got[:2] == (every, side)
    assert got[2] * side**2 * 9 / 16 <= 300e6
    assert got[2] == 15 * seconds * (3 - every) or (side == 320 and got[2] < 15 * seconds)


def test_a_slow_source_is_not_thinned_below_what_a_stride_needs():
    assert fit_in(25 * 600, 25.0, (1280, 720), 640, 1.0, 300.0)[0] == 2
    assert fit_in(20 * 600, 20.0, (1280, 720), 640, 1.0, 300.0)[0] == 1
    assert fit_in(100, 30.0, (320, 240), 640, 1.0, 300.0) == (1, 320, 100)
    assert fit_in(17, 60.0, (3840, 2160), 640, 1.0, 1.0)[::2] == (2, 9)  # a third of them would be too few for a fit


def test_long_clip_is_thinned_and_said(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(60) / 30)
    clip = decode(path, megapixels=0.2)
    assert clip.info["every"] == 2
    assert len(clip.t) == 30
    assert clip.info["frames_dropped"] == 0
    np.testing.assert_allclose(np.diff(clip.t), 1 / 15, rtol=1e-6)
    np.testing.assert_allclose(level(clip.frames), clip.t, atol=0.06)
    short = decode(path, megapixels=0.06)
    assert len(short.t) * short.frames[0, ..., 0].size <= 60_000
    assert short.info["frames_dropped"] == 30 - len(short.t)


def _message(path, **options) -> str:
    with pytest.raises(InvalidData) as caught:
        decode(path, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text
    return text


def test_bad_files(tmp_path):
    (tmp_path / "empty.mp4").touch()
    assert "empty" in _message(tmp_path / "empty.mp4")
    (tmp_path / "text.mp4").write_text("this is no video\n" * 50)
    assert "not a readable video" in _message(tmp_path / "text.mp4")
    assert "no such file" in _message(tmp_path / "none.mp4")
    assert "too short" in _message(write_clip(tmp_path / "short.mp4", np.arange(4) / 30))
    whole = write_clip(tmp_path / "span.mp4", np.arange(30) / 30)
    assert "too short" in _message(whole, start=5.0)


def test_sound_without_picture(tmp_path):
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    assert "no video stream" in _message(path)


class Notes(Silent):
    def __init__(self):
        self.notes = []

    def note(self, message: str) -> None:
        self.notes.append(message)


def test_truncated_clip_gives_what_there_is(tmp_path):
    path = write_clip(tmp_path / "a.mp4", np.arange(90) / 30, size=(192, 128))
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data))])
    notes = Notes()
    artifact = decode_stage.run(Inputs(files={"clip": path}), decode_stage.Config(), notes)
    kept = len(artifact.npz["frames.npz"]["t"])
    info = artifact.json["video.json"]
    assert 8 <= kept < 90
    assert kept + info["frames_lost"] == pytest.approx(90, abs=2)
    assert any("lost" in note for note in notes.notes)
    # With the index at the end, the cut takes it away and nothing can be read.
    path = write_clip(tmp_path / "b.mp4", np.arange(90) / 30, faststart=False)
    path.write_bytes(path.read_bytes()[:-2000])
    assert "not a readable video" in _message(path)


def test_parameters_out_of_range(tmp_path):
    with pytest.raises(UsageError, match=r"decode\.fps"):
        decode_stage.run(Inputs(files={"clip": tmp_path / "a.mp4"}), decode_stage.Config(fps=0.0), Silent())
