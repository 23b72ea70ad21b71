"""Write H.264 in MP4 that browsers play (libx264 through PyAV, yuv420p, index at the front)."""

import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def encode_mp4(frames: Iterable[np.ndarray], fps: float, *, crf: int = 20, preset: str = "medium") -> bytes:
    """The bytes of an MP4 file.

    Args:
        frames: (H, W, 3) uint8 RGB each, even H and W.
        fps: frames a second.
        crf: constant quality, 0 (lossless) to 51.  preset: libx264's speed.
    """
    # The index moves to the front by reading the file again, so it needs a name.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.mp4"
        with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.pix_fmt = "yuv420p"
            # One thread: the bytes then depend on the frames alone.
            stream.options = {"crf": str(crf), "preset": preset, "threads": "1"}
            for i, frame in enumerate(frames):
                if i == 0:
                    stream.height, stream.width = frame.shape[:2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
            container.mux(stream.encode())
        return path.read_bytes()
