"""Decoding: which frame is shown when. Trimmed clips, frame rates, spans of clips without an index, lost beginnings."""

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from slomo.errors import InvalidData
from slomo.reconstruct.video import decode

BITS = 8


def write_numbered(path: Path, periods, rate: Fraction | int = 30, *, gop: int = 15, codec: str = "mpeg4") -> Path:
    """A clip whose frames, at `periods` of 1/rate s, show their number in binary, as black and white stripes."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(rate))
        stream.width, stream.height, stream.pix_fmt = 12 * BITS, 32, "yuv420p"
        stream.gop_size = gop
        stream.bit_rate = 2_000_000
        for number, period in enumerate(periods):
            stripes = np.repeat(255 * (number >> np.arange(BITS) & 1), 12).astype(np.uint8)
            picture = np.broadcast_to(stripes[None, :, None], (32, 12 * BITS, 3))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = int(period), 1 / Fraction(rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def numbers(frames: np.ndarray) -> list[int]:
    """The numbers that (T, H, W, 3) frames show."""
    stripes = frames.mean((1, 3)).reshape(len(frames), BITS, -1).mean(-1) > 128
    return (stripes @ (1 << np.arange(BITS))).tolist()


def copy_packets(source: Path, target: Path, *, shift: float = 0.0, without: int = 0) -> Path:
    """What `ffmpeg -c copy` does: packets as they are, `shift` s earlier, and the first few left out."""
    with av.open(str(source)) as old, av.open(str(target), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in [p for p in old.demux(video=0) if p.size][without:]:
            ticks = round(shift / packet.time_base)
            packet.pts, packet.dts, packet.stream = packet.pts - ticks, packet.dts - ticks, stream
            new.mux(packet)
    return target


def test_what_a_cut_without_encoding_hides_is_not_counted(tmp_path):
    """As of `ffmpeg -ss 1.5 -c copy`: an edit list hides the frames between the key frame and the cut."""
    path = copy_packets(write_numbered(tmp_path / "a.mp4", range(120), gop=60), tmp_path / "cut.mp4", shift=1.5)
    clip = decode(path)
    assert numbers(clip.frames) == list(range(45, 120))
    assert clip.info["frames_lost"] == 0
    assert numbers(decode(path, start=1.2, duration=0.5).frames) == list(range(81, 96))


def test_what_a_telephone_trims_is_not_counted(tmp_path):
    """At both ends: of what the edit list hides, the container does not even give the packets."""
    path = write_numbered(tmp_path / "a.mp4", range(120))
    data = bytearray(path.read_bytes())
    at = data.index(b"elst") + 12
    with av.open(str(path)) as container:
        ticks = round(1 / (30 * container.streams.video[0].time_base))
    (first,) = struct.unpack(">I", data[at + 4 : at + 8])
    data[at : at + 8] = struct.pack(">II", 1000, first + 70 * ticks)  # a second, in milliseconds, and where it begins
    path.write_bytes(data)
    clip = decode(path)
    assert numbers(clip.frames) == list(range(70, 100))
    assert clip.info["frames_lost"] == 0


@pytest.mark.parametrize(
    ("source", "every"),
    [(50, 2), (48, 2), (60, 2), (240, 8), (Fraction(60000, 1001), 2), (100, 4)]
    + [(30, 1), (25, 1), (24, 1), (Fraction(30000, 1001), 1)],
)
@pytest.mark.parametrize("kind", ["mp4", "mkv"])
def test_every_nth_frame_of_a_constant_rate(tmp_path, source, every, kind):
    """Also where times are whole milliseconds (Matroska) and the start is halfway between two frames."""
    path = write_numbered(tmp_path / f"a.{kind}", range(100), source)
    clip = decode(path)
    assert numbers(clip.frames) == list(range(0, 100 // every * every, every))
    assert clip.info["fps"] == pytest.approx(float(source / every), rel=1e-7)
    assert clip.info["source_fps"] == pytest.approx(float(source), rel=1e-7)
    np.testing.assert_allclose(clip.t, np.arange(len(clip.t)) * float(every / source), rtol=1e-7)
    later = decode(path, start=float(12.5 / source))
    steps = np.diff(numbers(later.frames))
    assert (steps == every).all()
    assert later.info["start_s"] == pytest.approx(numbers(later.frames[:1])[0] / float(source))


def test_a_variable_rate_is_resampled(tmp_path):
    """At 30 a second, the frames nearest to a uniform grid."""
    ticks = np.cumsum([0, *np.random.default_rng(1).integers(7, 20, 99)])  # of 600 a second
    clip = decode(write_numbered(tmp_path / "a.mp4", ticks, 600))
    assert clip.info["fps"] == 30
    nearest = np.abs(ticks[None] / 600 - clip.t[:, None]).min(1)
    np.testing.assert_allclose(np.abs(ticks[numbers(clip.frames)] / 600 - clip.t), nearest, atol=1e-9)


@pytest.mark.parametrize("name", ["libx264.ts", "mpeg2video.ts", "mpeg4.ts", "mpeg2video.mpg"])
def test_a_span_of_a_clip_without_an_index(tmp_path, name):
    """Where the demuxer goes to is a key frame after the start, or (MPEG-4) none."""
    path = write_numbered(tmp_path / name, range(240), gop=120, codec=name.split(".")[0])
    clip = decode(path, start=3.0, duration=2.0)
    assert numbers(clip.frames) == list(range(90, 150))
    assert clip.info["frames_lost"] == 0


def test_a_lost_beginning_is_not_filled_with_copies(tmp_path):
    """Without the first key frame there is nothing to see before the next one."""
    whole = write_numbered(tmp_path / "a.ts", range(60), codec="libx264")
    clip = decode(copy_packets(whole, tmp_path / "b.ts", without=1))
    shown = numbers(clip.frames)
    assert shown == list(range(shown[0], 60))
    assert clip.info["frames_lost"] == shown[0] - 1
    assert clip.info["start_s"] == pytest.approx((shown[0] - 1) / 30)


def test_a_raw_stream_has_no_times(tmp_path):
    path = write_numbered(tmp_path / "a.h264", range(60), codec="libx264")
    with pytest.raises(InvalidData, match=r"a\.h264: is a raw stream, its frames have no times; .* -i a\.h264 a\.mp4$"):
        decode(path)


def test_a_folder_is_no_clip(tmp_path):
    with pytest.raises(InvalidData, match="is a folder; give a video file"):
        decode(tmp_path)
