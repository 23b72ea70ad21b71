"""Compose the side-by-side video and its contact sheet from panels."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from slomo.report.panels import SIZE, Panel, side_color
from slomo.runs import runs

BACKGROUND, INK, FAINT = (250, 250, 250), (35, 35, 38), (205, 206, 210)
CAPTION, GAP, ROW, LEFT = 26, 6, 9, 112  # px: caption's height, space, a bar of the foot-fall strip, where bars begin


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


@dataclass(frozen=True)
class FootFalls:
    """When each foot stands, for the strip under the panels.

    Attributes:
        names: C limb names.  reference, rollout: (T, C) bool at reference_t, rollout_t (T,) s, of the robot's motion.
    """

    names: tuple[str, ...]
    reference_t: np.ndarray
    reference: np.ndarray
    rollout_t: np.ndarray
    rollout: np.ndarray


def _text(canvas: Image.Image, xy: tuple[float, float], text: str, *, size: int = 13, bold: bool = False, anchor="lm"):
    ImageDraw.Draw(canvas).text(xy, text, fill=INK, font=_font(size, bold), anchor=anchor)


def _bars(
    draw: ImageDraw.ImageDraw, t: np.ndarray, on: np.ndarray, x: Callable[[float], float], y: float, color
) -> None:
    """One bar for each time that `on` is true."""
    for a, b in runs(on):
        draw.rectangle([x(float(t[a])), y, x(float(t[min(b, len(t) - 1)])), y + ROW // 2 - 1], fill=color)


def _strip(width: int, duration: float, falls: FootFalls) -> Image.Image:
    """The foot-fall diagram: for each foot the reference above and the robot below."""
    height = len(falls.names) * (ROW + 5) + 12
    canvas = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(canvas)

    def x(t: float) -> float:
        return LEFT + (width - LEFT - 10) * min(max(t / duration, 0), 1)

    for c, name in enumerate(falls.names):
        y = 6 + c * (ROW + 5)
        _text(canvas, (LEFT - 8, y + ROW / 2), name.replace("_", " "), size=11, anchor="rm")
        color = tuple(round(255 * v) for v in side_color(name))
        during = (falls.rollout_t >= 0) & (falls.rollout_t <= duration)
        _bars(draw, falls.reference_t, falls.reference[:, c], x, y, color)
        _bars(draw, falls.rollout_t[during], falls.rollout[during, c], x, y + ROW // 2 + 1, (120, 121, 125))
    return canvas


class Composer:
    """Lays the panels out: a grid with captions, the time, and the foot-fall strip with a cursor.

    Args:
        panels: two to four.  duration: s.  speed: factor between the video's clock and the motion's, 1 = real time.
    """

    def __init__(self, panels: Sequence[Panel], falls: FootFalls, *, duration: float, speed: float = 1.0):
        self.panels, self.duration, self.speed = panels, duration, speed
        self.columns = 2 if len(panels) != 3 else 3
        rows = -(-len(panels) // self.columns)
        self.width = self.columns * SIZE[0] + (self.columns + 1) * GAP
        self.width += self.width % 2
        self._strip = _strip(self.width, duration, falls)
        self._top = GAP + rows * (SIZE[1] + CAPTION + GAP)
        height = self._top + CAPTION + self._strip.height
        self.height = height + height % 2

    def frame(self, t: float, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """(H, W, 3) uint8: the pictures of all panels at time t, composed."""
        canvas = Image.new("RGB", (self.width, self.height), BACKGROUND)
        for i, (panel, picture) in enumerate(zip(self.panels, pictures, strict=True)):
            x = GAP + (i % self.columns) * (SIZE[0] + GAP)
            y = GAP + (i // self.columns) * (SIZE[1] + CAPTION + GAP)
            _text(canvas, (x + 2, y + CAPTION / 2), f"{i + 1}", bold=True)
            _text(canvas, (x + 18, y + CAPTION / 2), panel.title)
            canvas.paste(Image.fromarray(picture), (x, y + CAPTION))
        y = self._top + CAPTION / 2
        speed = "real time" if self.speed == 1 else f"{self.speed:g}x real time"
        _text(canvas, (GAP + 2, y), f"{t:5.2f} s of {self.duration:.2f} s", bold=True)
        _text(canvas, (GAP + 160, y), speed)
        _text(
            canvas, (self.width - 10, y), "feet on the ground: colour = reference, grey = robot", size=11, anchor="rm"
        )
        top = self._top + CAPTION
        canvas.paste(self._strip, (0, top))
        cursor = LEFT + (self.width - LEFT - 10) * t / self.duration
        ImageDraw.Draw(canvas).line([cursor, top, cursor, top + self._strip.height - 6], fill=INK, width=2)
        return np.asarray(canvas)


def draw_all(panels: Sequence[Panel], times: np.ndarray) -> Iterator[list[np.ndarray]]:
    """The pictures of all panels at each time, drawn side by side on two threads (a launched kernel frees the lock)."""
    with ThreadPoolExecutor(2) as pool:
        ahead = [pool.submit(p.draw, float(times[0])) for p in panels] if len(times) else []
        for following in [*times[1:], None]:
            pictures = [f.result() for f in ahead]
            if following is not None:
                ahead = [pool.submit(p.draw, float(following)) for p in panels]
            yield pictures


def contact_sheet(titles: Sequence[str], times: np.ndarray, pictures: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """One row for each panel, one column for each moment. Args: pictures[moment][panel]."""
    w, h = 2 * SIZE[0] // 3, 2 * SIZE[1] // 3
    width, height = len(times) * (w + GAP) + GAP, CAPTION + len(titles) * (h + CAPTION)
    canvas = Image.new("RGB", (width, height), BACKGROUND)
    for j, t in enumerate(times):
        x = GAP + j * (w + GAP)
        _text(canvas, (x + w / 2, CAPTION / 2), f"{t:.2f} s", bold=True, anchor="mm")
        for i, picture in enumerate(pictures[j]):
            small = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
            canvas.paste(Image.fromarray(small), (x, CAPTION + i * (h + CAPTION) + CAPTION))
    for i, title in enumerate(titles):
        _text(canvas, (GAP + 2, CAPTION + i * (h + CAPTION) + CAPTION / 2), f"{i + 1}  {title}")
    return np.asarray(canvas)


def sheet(columns: Sequence[Sequence[np.ndarray]], captions: Sequence[str]) -> np.ndarray:
    """Pictures of equal size (H, W, 3), one column below its caption for each moment."""
    h, w = columns[0][0].shape[:2]
    width, height = len(columns) * (w + GAP) + GAP, CAPTION + len(columns[0]) * (h + GAP)
    canvas = Image.new("RGB", (width, height), BACKGROUND)
    for i, (pictures, text) in enumerate(zip(columns, captions, strict=True)):
        x = GAP + i * (w + GAP)
        _text(canvas, (x + w / 2, CAPTION / 2), text, anchor="mm")
        for j, picture in enumerate(pictures):
            canvas.paste(Image.fromarray(picture), (x, CAPTION + j * (h + GAP)))
    return np.asarray(canvas)


def png(picture: np.ndarray) -> bytes:
    """PNG file of (H, W, 3) uint8 RGB."""
    ok, data = cv2.imencode(".png", picture[..., ::-1])
    assert ok
    return data.tobytes()
