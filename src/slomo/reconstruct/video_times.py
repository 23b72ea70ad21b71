"""When the frames of a clip were taken: times, rate, and whether it plays slower than life."""

from pathlib import Path

import av.error
import numpy as np

from slomo.errors import InvalidData

# Times as many frames taken as played: four and more are usual; a plain clip in the dark may hold half of its frames.
_SLOWED = (2.5, 64.0)


def timestamps(container, path: Path) -> np.ndarray:
    """Presentation times of all packets that are shown (s, sorted), without decoding.

    Raises:
        InvalidData: there are none.
    """
    stream = container.streams.video[0]
    stamps, untimed = [], 0
    try:
        for packet in container.demux(stream):
            stamp = packet.pts if packet.pts is not None else packet.dts
            # An edit list (a trimmed clip) hides what is only there to decode the rest.
            if packet.size and not packet.is_corrupt and not packet.is_discard:
                if stamp is None:
                    untimed += 1
                else:
                    stamps.append(stamp * float(stream.time_base or 1))
    except av.error.FFmpegError:
        pass  # what follows the damage cannot be read; the frames before it can
    if stamps:
        return np.unique(stamps)
    if untimed:  # counting them would need a frame rate, and that of a raw stream's header is a guess
        todo = f"give them at the rate they were taken with, for example ffmpeg -r 30 -i {path.name} {path.stem}.mp4"
        raise InvalidData("is a raw stream, its frames have no times", where=path, todo=todo)
    raise InvalidData("the video stream holds no frames", where=path, todo="copy the clip again, it may be truncated")


def frame_rate(pts: np.ndarray, header: float) -> tuple[float, int]:
    """Frames a second, and how many periods the clip lasts where the rate is constant (frames may be missing), else 0.

    Args:
        pts: (n,) s, sorted.
        header: frames a second that the container states, 0 where it states none.
    """
    if len(pts) < 2:
        return 0.0, 0
    typical = float(np.median(np.diff(pts)))
    number = np.cumsum(np.round(np.diff(pts) / typical))
    # The header's rate is the exact one if the times agree with it. Those of Matroska are whole milliseconds: 17 for
    # a sixtieth of a second, and at 240 fps almost a quarter of a period off.
    for rate in (header, float(number[-1] / (pts[-1] - pts[0]))):
        if rate and np.abs((pts[1:] - pts[0]) * rate - number).max() < 0.25:
            return rate, int(number[-1]) + 1
    return 1.0 / typical, 0


def slowed(capture_fps: float, source_fps: float) -> float:
    """How many times slower than life a clip plays, by the rate that its camera says it took it at (0: unknown)."""
    ratio = capture_fps / source_fps if source_fps else 0.0
    return ratio if _SLOWED[0] < ratio < _SLOWED[1] else 1.0
