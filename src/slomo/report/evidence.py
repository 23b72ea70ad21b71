"""The picture of what was seen in the clip: parts, key points and the view, over some of its frames."""

import colorsys
from collections.abc import Sequence

import cv2
import numpy as np

from slomo.prior.crop import Box, cut, to_crop
from slomo.prior.labels import rotation_of
from slomo.report.panels import bones, side_color
from slomo.report.video import png, sheet
from slomo.stage import Arrays

TILE = 256  # px, side of a frame's square
DIAL = 30  # px, radius of the compass in its corner
BLEND = 0.55  # of the parts' colour over the picture
SURE = 0.05  # key points of less confidence are not drawn


def evidence_picture(evidence: Arrays, frames: np.ndarray, t: np.ndarray, *, moments: int = 8) -> bytes | None:
    """PNG: the subject at some moments of the clip, below it the same with what was seen; None when nobody spoke.

    Left is orange, right is blue, the median plane yellow to green. The compass shows how the forward axis lies in
    the picture; its head is filled when the body looks towards the camera. Surer key points are larger.

    Args:
        evidence: the arrays of evidence.npz. frames: (T, H, W, 3) uint8, t: (T,) s, of the decoded clip.
    """
    F = len(evidence["frame"])
    if not F:
        return None
    chosen = np.unique(np.linspace(0, F - 1, min(moments, F)).round().astype(int))
    columns = [_column(evidence, int(f), frames[evidence["frame"][f]]) for f in chosen]
    captions = [_caption(evidence, int(f), float(t[evidence["frame"][f]])) for f in chosen]
    return png(sheet(columns, captions))


def colours(parts: Sequence[str]) -> np.ndarray:
    """(P, 3) in [0, 1]: left parts from red to yellow, right ones from violet to cyan, the others grey to green."""
    out = np.zeros((len(parts), 3))
    ranges = (("left", (0.02, 0.14), 0.95), ("right", (0.72, 0.52), 0.8), ("", (0.25, 0.42), 0.35))
    for side, (low, high), saturation in ranges:
        of = [i for i, n in enumerate(parts) if (side in n if side else "left" not in n and "right" not in n)]
        for k, i in enumerate(of):
            hue = low + (high - low) * k / max(len(of) - 1, 1)
            out[i] = colorsys.hsv_to_rgb(hue, saturation, 0.95)
    return out


def _column(evidence: Arrays, f: int, frame: np.ndarray) -> list[np.ndarray]:
    """Two squares: the frame, and what was seen in it."""
    box = Box(*(float(x) for x in evidence["box"][f]))
    plain = cut(frame, box, TILE)
    drawn = plain.copy()
    if len(evidence["parts"]):
        p = cv2.resize(evidence["parts"][f].transpose(1, 2, 0), (TILE, TILE), interpolation=cv2.INTER_LINEAR) / 255.0
        grey = np.repeat(cv2.cvtColor(plain, cv2.COLOR_RGB2GRAY)[..., None], 3, 2)
        colour = p[..., 1:] @ (255 * colours([str(n) for n in evidence["part_names"]]))
        drawn = (grey * (1 - BLEND * p[..., 1:].sum(-1, keepdims=True)) + BLEND * colour).clip(0, 255).astype(np.uint8)
    _keypoints(drawn, evidence, f, box)
    if len(evidence["view_path"]):
        _compass(drawn, rotation_of(evidence["view_path"][f], np.asarray(evidence["view_up"][f], float)))
    return [plain, drawn]


def _keypoints(picture: np.ndarray, evidence: Arrays, f: int, box: Box) -> None:
    names = [str(n) for n in evidence["keypoint_names"]]
    sure = evidence["keypoint_confidence"][f]
    uv = to_crop(np.asarray(evidence["keypoints"][f], float), box, TILE)
    at = [tuple(np.rint(16 * p).astype(int).tolist()) for p in np.clip(np.nan_to_num(uv), -TILE, 2 * TILE)]
    count = len(names) if len(set(names)) == len(names) else next(i for i, n in enumerate(names) if n in names[:i])
    first = tuple(names[:count])  # of the first source
    for i, j in bones(first):
        if min(sure[i], sure[j]) > SURE:
            colour = [round(255 * c) for c in side_color(names[j])]
            cv2.line(picture, at[i], at[j], colour, 1, cv2.LINE_AA, shift=4)
    for i, name in enumerate(names):
        if sure[i] > SURE:
            radius = round(16 * (1.5 + 3 * float(sure[i])))
            cv2.circle(picture, at[i], radius + 16, (20, 20, 20), -1, cv2.LINE_AA, shift=4)
            cv2.circle(picture, at[i], radius, [round(255 * c) for c in side_color(name)], -1, cv2.LINE_AA, shift=4)


def _compass(picture: np.ndarray, R_view_body: np.ndarray) -> None:
    """An arrow along the body's forward axis, from a disc in the upper right corner."""
    centre = np.array([TILE - DIAL - 6.0, DIAL + 6.0])
    ahead = R_view_body[:, 0]
    tip = tuple(np.rint(centre + DIAL * ahead[:2]).astype(int).tolist())
    tail = tuple(np.rint(centre).astype(int).tolist())
    cv2.circle(picture, tail, DIAL, (250, 250, 250), -1, cv2.LINE_AA)
    cv2.circle(picture, tail, DIAL, (35, 35, 38), 1, cv2.LINE_AA)
    cv2.line(picture, tail, tip, (35, 35, 38), 2, cv2.LINE_AA)
    cv2.circle(picture, tip, 5, (35, 35, 38), -1 if ahead[2] < 0 else 2, cv2.LINE_AA)


def _caption(evidence: Arrays, f: int, t: float) -> str:
    if not len(evidence["view_path"]):
        return f"{t:.2f} s"
    return f"{t:.2f} s, seen from {np.degrees(float(evidence['view_path'][f])):.0f}°"
