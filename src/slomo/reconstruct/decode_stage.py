"""The first part of `reconstruct`, cached on its own: the frames of the file "clip"."""

from dataclasses import dataclass
from pathlib import Path

from slomo.errors import UsageError
from slomo.reconstruct.exposure import stretch
from slomo.reconstruct.video import decode
from slomo.stage import Artifact, Inputs, Progress

VERSION = 8


@dataclass(frozen=True)
class Config:
    """What is taken from the clip.

    Attributes:
        start: s from the clip's first frame, as it plays.
        duration: s; 0 takes everything to the end.
        slow_motion: how many times slower than life the clip plays; 0: what the file says, and nothing else makes it 1.
        fps: frames per second of life at most; a slower clip keeps its own rate.
        max_side: px, the longer side of the decoded frames at most.
        enlarge: a smaller clip is enlarged, by that much at most.
        megapixels: million pixels of all frames together, the bound on memory (about 10 bytes each): a longer clip is
            taken at a half or less of its rate, then smaller, and what is still too much is left out, which is said.
    """

    start: float = 0.0
    duration: float = 0.0
    slow_motion: float = 0.0
    fps: float = 30.0
    max_side: int = 640
    enlarge: float = 2.0
    megapixels: float = 280.0


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """Decode the file "clip" into `frames.npz` (frames (T, H, W, 3) uint8 RGB, t (T,) s) and `video.json`; frames of a
    dark or hazy clip with their contrast stretched (`exposure`).

    Raises:
        InvalidData: the file is no video, or too little of it can be decoded.
        UsageError: a parameter is out of its range.
    """
    bounds = dict(start=0.0, duration=0.0, slow_motion=0.0, fps=1.0, max_side=64, enlarge=1.0, megapixels=1.0)
    for name, least in bounds.items():
        if not getattr(config, name) >= least:
            raise UsageError(f"is {getattr(config, name)}", where=f"decode.{name}", valid=[f"{least:g} and more"])
    clip = decode(
        Path(inputs.files["clip"]), start=config.start, duration=config.duration, fps=config.fps,
        max_side=config.max_side, enlarge=config.enlarge, megapixels=config.megapixels, slow_motion=config.slow_motion,
        progress=lambda f: progress.update(f, "decoding"),
    )  # fmt: skip
    if lost := clip.info["frames_lost"]:
        progress.note(f"decode: the clip is damaged or cut off: {lost} frames are lost, {len(clip.t)} are used")
    if (slow := clip.info["slow_motion"]) != 1:
        says = "" if config.slow_motion else ", its file says (--slow-motion 1 if it does not)"
        progress.note(f"decode: the clip plays {slow:.3g} times slower than life{says}")
    if clip.info["every"] > 1:
        progress.note(f"decode: the clip is long: it is taken at {clip.info['fps'] * slow:.3g} frames a second")
    own = min(config.max_side, max(clip.info["source_width"] * clip.info["pixel_aspect"], clip.info["source_height"]))
    if (side := clip.info["max_side"]) < round(own):
        progress.note(f"decode: the clip is very long: its frames are {side} px, not {own:.0f}")
    if dropped := clip.info["frames_dropped"]:
        left_out = f"its last {dropped / clip.info['fps']:.0f} s are left out (see start, duration)"
        progress.note(f"decode: the clip is too long: {left_out}")
    clip.info["contrast"] = gain = stretch(clip.frames)
    if gain > 1:
        progress.note(f"decode: the clip is dark or hazy: its contrast is taken {gain:g} times")
    return Artifact(npz={"frames.npz": {"frames": clip.frames, "t": clip.t}}, json={"video.json": clip.info})
