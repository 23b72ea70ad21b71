"""Decoding a clip into upright RGB frames on a uniform time grid."""

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np

from slomo.errors import InvalidData
from slomo.reconstruct.video_times import frame_rate, slowed, timestamps

MIN_FRAMES = 8
LEAST_FPS = 12.0  # frames a second of a clip that is too long to take more of: five of the fastest stride
LEAST_SIDE = 320  # px, likewise
_FASTER = 0.01  # a source that is faster than wanted by no more than this (30.02 fps) is taken as it is
_DIAGONAL_35MM = 43.267  # mm, diagonal of the full frame that "35 mm equivalent" focal lengths refer to
_FOCAL_TAG = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
_CAPTURE_TAG = "com.android.capture.fps"  # frames that the camera took a second, of slow motion more than are played


@dataclass(frozen=True)
class Clip:
    """A decoded clip.

    Attributes:
        frames: (T, H, W, 3) uint8 RGB, upright.
        t: (T,) s of life, uniform, from the first frame kept.
        info: what `video.json` holds.
    """

    frames: np.ndarray
    t: np.ndarray
    info: dict


def decode(
    path: Path,
    *,
    start: float = 0.0,
    duration: float = 0.0,
    fps: float = 30.0,
    max_side: int = 640,
    enlarge: float = 1.0,
    megapixels: float = 280.0,
    slow_motion: float = 0.0,
    progress=lambda fraction: None,
) -> Clip:
    """Decode `path`, resampling to at most `fps` and scaling the longer side to `max_side` px.

    Args:
        start: s from the clip's first frame.
        duration: s; 0 means up to the end.
        fps: upper bound of the frame rate, in a second of life. A slower source keeps its own; of a faster one every
            n-th frame is taken if its rate is constant, else the frames nearest to a grid at `fps`.
        enlarge: by that much at most, a smaller clip.  megapixels: million pixels of all frames together; see `fit_in`.
        slow_motion: how many times slower than life the clip plays; 0: as the file says, and else 1.  `start` and
            `duration` are seconds of the clip as it plays, the times that come out are those of life.

    Raises:
        InvalidData: the file is no video, holds no frame in the wanted span, or fewer than 8.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise InvalidData(what, where=path, todo="give a video file")
    if path.stat().st_size == 0:
        raise InvalidData("the file is empty", where=path, todo="give a video file")
    with closing(_open(path)) as container:
        info = _stream_info(container)
        stream = container.streams.video[0]
        pts = timestamps(container, path)
        promised, header_rate = stream.frames, float(stream.average_rate or 0)
        header_length = float((stream.duration or 0) * (stream.time_base or 1))
        may_hide = "mov" in container.format.name  # MP4 as well
    source_fps, periods = frame_rate(pts, header_rate)
    slow = slow_motion or slowed(info["capture_fps"], source_fps)
    rate = min(source_fps, fps / slow)
    length = float(pts[-1] - pts[0]) + (1.0 / source_fps if source_fps else 0.0)
    if periods:
        # On a grid of another rate some steps would be longer than others, and so would be the speeds seen in them.
        rate = source_fps / max(1, int(np.ceil(source_fps * slow / fps - _FASTER)))
        length = periods / source_fps
    stop = min(length, start + duration) if duration > 0 else length
    wanted = int(np.floor((stop - start) * rate + 1e-6)) if stop > start else 0
    _require_enough(wanted, path, f"the clip lasts {length:.2f} s, {max(stop - start, 0):.2f} s of it were asked for")
    if periods:  # at the time of a frame: halfway between two now the one would be the nearest, now the other
        start = round(start * source_fps) / source_fps

    size = (info["source_width"] * info["pixel_aspect"], info["source_height"])
    every, side, kept = fit_in(wanted, rate * slow, size, max_side, enlarge, megapixels)
    rate /= every
    grid = start + np.arange(kept) / rate
    with closing(_frames(path, float(pts[0]), start)) as frames:
        stack, late, rotation = _fill(grid, frames, 1.0 / rate, info["pixel_aspect"], side, progress)
    count = len(stack)
    _require_enough(count, path, f"only {count} frames could be decoded")
    lost = max(0, promised - len(pts))
    if may_hide:  # what an edit list hides counts among the frames that the header promises, but not in its length
        lost = min(lost, max(0, round((header_length - length) * source_fps)))
    info |= {
        "fps": rate,
        "source_fps": source_fps,
        "slow_motion": slow,
        "width": int(stack.shape[2]),
        "height": int(stack.shape[1]),
        "rotation": rotation,
        "frames_total": count,
        "frames_lost": lost + kept - count,
        "frames_dropped": (wanted + every - 1) // every - kept,
        "every": every,
        "max_side": round(side),
        "start_s": start + late / rate,
    }
    if info["focal_35mm"]:
        info["focal_px_hint"] = info["focal_35mm"] / _DIAGONAL_35MM * float(np.hypot(*stack.shape[1:3]))
    return Clip(stack, np.arange(len(stack)) / (rate * slow), info)


def fit_in(
    frames: int, rate: float, size: tuple[float, float], max_side: int, enlarge: float, megapixels: float
) -> tuple[int, float, int]:
    """What is taken of a clip. A small one is enlarged as far as that fits in. Of a long one every n-th frame, at least
    `LEAST_FPS` a second and `MIN_FRAMES`; then smaller frames, at least `LEAST_SIDE`; the end is left out if need be.

    Args:
        frames: wanted, `rate` of them a second.  size: px, of the source, width and height.

    Returns:
        n, the longer side in px, and the number of frames.
    """
    budget, longer = 1e6 * megapixels, max(size)
    flat = min(size) / longer
    own = min(max_side, longer)
    large = min(max_side, enlarge * longer, np.sqrt(budget / (max(1, frames) * flat)))
    if large >= own:
        return 1, float(large), frames
    most = max(1, min(int(rate / LEAST_FPS), frames // MIN_FRAMES))
    every = next((n for n in range(1, most) if -(-frames // n) * flat * own**2 <= budget), most)
    taken = -(-frames // every)
    if taken * flat * own**2 <= budget:
        return every, own, taken
    side = min(own, max(LEAST_SIDE, int(np.sqrt(budget / (taken * flat)))))
    return every, side, min(taken, max(MIN_FRAMES, int(budget / (flat * side**2))))


def _require_enough(count: int, path: Path, why: str) -> None:
    if count < MIN_FRAMES:
        raise InvalidData(
            f"too short: {why}", where=path, todo=f"give at least {MIN_FRAMES} frames, better two seconds or more"
        )


def _open(path: Path):
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, ValueError) as error:
        raise InvalidData(
            f"not a readable video ({getattr(error, 'strerror', None) or error})",
            where=path,
            todo="give a video file (mp4, mov, webm, mkv, avi...); a file cut off while copying has to be copied again",
        ) from None
    if not container.streams.video:
        container.close()
        raise InvalidData("has no video stream", where=path, todo="give a video file")
    return container


def _frames(path: Path, origin: float, start: float) -> Generator[tuple[float, av.VideoFrame], None, None]:
    """Decoded frames with their time (s from the clip's first frame), from one at `start` or before it."""
    if start > 1.0:
        with closing(_open(path)) as container:
            stream = container.streams.video[0]
            container.seek(int((origin + start - 0.5) / float(stream.time_base or 1)), stream=stream)
            frames = _decoded(stream, origin)
            first = next(frames, None)
            # Without an index (MPEG-TS) that may be a key frame after the start, or none and so no whole picture.
            if first and first[1].key_frame and first[0] <= start + 1e-6:
                yield first
                yield from frames
                return
    with closing(_open(path)) as container:
        yield from _decoded(container.streams.video[0], origin)


def _decoded(stream, origin: float) -> Iterator[tuple[float, av.VideoFrame]]:
    """Frames from where the stream is, with their time (s from the clip's first frame); damaged packets are skipped."""
    last = -np.inf
    try:
        for packet in stream.container.demux(stream):
            try:
                frames = packet.decode()
            except av.error.InvalidDataError:
                continue
            for frame in frames:
                # MPEG-PS does not time every frame. One before all that are timed cannot be placed and is left out.
                time = frame.time - origin if frame.time is not None else last + 1.0 / float(stream.average_rate or 30)
                if time > last and not frame.is_corrupt:
                    last = time
                    yield time, frame
    except av.error.FFmpegError:
        return


def _stream_info(container) -> dict:
    stream = container.streams.video[0]
    tags = {**container.metadata, **stream.metadata}

    def number(tag: str) -> float:
        try:
            return float(tags.get(tag, 0.0))
        except ValueError:
            return 0.0

    return {
        "codec": stream.codec_context.name,
        "source_width": stream.width,
        "source_height": stream.height,
        "pixel_aspect": float(stream.sample_aspect_ratio or 0) or 1.0,  # width over height of a source pixel
        "focal_35mm": number(_FOCAL_TAG),
        "capture_fps": number(_CAPTURE_TAG),
    }


def _fill(grid, frames, step: float, aspect: float, side: float, progress) -> tuple[np.ndarray, int, int]:
    """The source frame nearest to each grid time, as far as there are any; how many grid times before the first frame
    are left out; and the rotation applied (degrees)."""
    stack, count, rotation, late = np.zeros((0, 0, 0, 3), np.uint8), 0, 0, 0
    previous: tuple[float, av.VideoFrame] | None = None

    def take_until(limit: float):
        nonlocal stack, count, rotation
        rgb = None
        while previous and count < len(grid) and grid[count] <= limit:
            rgb = _to_rgb(previous[1], aspect, side) if rgb is None else rgb
            if not count:
                stack, rotation = np.empty((len(grid), *rgb.shape), np.uint8), int(previous[1].rotation) % 360
            stack[count] = rgb
            count += 1
            progress(count / len(grid))

    for time, frame in frames:
        if previous:
            take_until(0.5 * (previous[0] + time))
        else:  # the first packets may be damaged: no copies of a later frame in their place
            late = int(np.searchsorted(grid, time - 0.5 * step))
            grid = grid[late:]
        previous = (time, frame)
        if count == len(grid):
            break
    if previous:  # the last frame stands for the time until the next one would have come
        take_until(previous[0] + 0.999 * step)
    return stack[:count], late, rotation


def _to_rgb(frame: av.VideoFrame, aspect: float, side: float) -> np.ndarray:
    """(H, W, 3) uint8, square pixels, the longer side of `side` px, upright."""
    width, height = frame.width * aspect, float(frame.height)
    scale = side / max(width, height)
    width, height = (max(2, 2 * round(scale * n / 2)) for n in (width, height))  # even, for encoders
    how = "BICUBIC" if scale > 1 else "AREA"
    rgb = frame.reformat(width=width, height=height, format="rgb24", interpolation=how).to_ndarray()
    return np.ascontiguousarray(np.rot90(rgb, round(frame.rotation / 90) % 4))
