"""What the networks see of a frame: a square around the mask with colour, silhouette and the motion that is not the
camera's. Colour and motion are normalised by their own size inside the mask, so that renderings and real footage look
alike; training (on crops that are stored) and inference (on frames) end in the same `normalised`.

Places: a pixel's centre is at integers (u, v), so that the picture's left edge is at -1/2; boxes are counted from that
edge, as array slices are.
"""

from typing import NamedTuple

import cv2
import numpy as np

Array = np.ndarray

MARGIN = 1.25  # side of the box over the longest side of the mask
COLOUR_CLIP = 3.0  # standard deviations
FLOW_CLIP = 3.0  # times the motion that 90 % of the pixels stay below
STILL = 0.004  # of the side: a subject whose motion is smaller than that stands, what is seen is noise
_DARK = 4.0  # grey levels, least spread of a colour channel
_DILATE = 0.03  # of the side: estimated masks and flow are both wrong this close to the edge
_FIT_POINTS = 2500  # background points for the camera's motion
_FIT_LEAST = 40
_FIT_ROUNDS = 8


class Box(NamedTuple):
    """A square of the picture: left and top edge (x0, y0) and side, in px; may stick out of the picture."""

    x0: float
    y0: float
    side: float


def crop_box(mask: Array) -> Box:
    """The square around a mask (H, W) bool, centred on the mask's box.

    Raises:
        ValueError: the mask is empty.
    """
    u, v = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    if not len(u):
        raise ValueError("the mask is empty")
    side = MARGIN * float(max(u[-1] - u[0], v[-1] - v[0]) + 1)
    return Box((u[0] + u[-1] + 1 - side) / 2, (v[0] + v[-1] + 1 - side) / 2, side)


def to_crop(uv: Array, box: Array | Box, size: int) -> Array:
    """Picture px (..., 2) to px of the crop of size x size. `box` is (3,), or (..., 3) with the leading axes of uv."""
    box = np.asarray(box, float)
    return (uv + 0.5 - box[..., :2]) * (size / box[..., 2:]) - 0.5


def from_crop(uv: Array, box: Array | Box, size: int) -> Array:
    """The inverse of `to_crop`."""
    box = np.asarray(box, float)
    return (uv + 0.5) * (box[..., 2:] / size) + box[..., :2] - 0.5


def cut(image: Array, box: Box, size: int) -> Array:
    """The crop (size, size, ...) of a picture (H, W, ...), bilinear, averaged where it shrinks; zero outside."""
    fine = min(4, max(1, round(box.side / size)))  # samples a crop pixel and axis
    n, f = size * fine, box.side / (size * fine)
    x0, y0 = box.x0 + 0.5 * f - 0.5, box.y0 + 0.5 * f - 0.5
    M = np.array([[f, 0, x0], [0, f, y0]])
    out = cv2.warpAffine(image, M, (n, n), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=0)
    return out if fine == 1 else cv2.resize(out, (size, size), interpolation=cv2.INTER_AREA)


def compensate(flow: Array, mask: Array, *, valid: Array | None = None) -> Array:
    """The flow less the camera's share: an affine motion fitted to the background (Geman-McClure weights).

    Args:
        flow: (H, W, 2) px. mask: (H, W) of the subject, above 1/2 inside.
        valid: (H, W) bool, where the flow is known (all of it by default).

    Returns:
        (H, W, 2) float32 px; the flow as it is where there is next to no background.
    """
    h, w = mask.shape
    radius = max(2, round(_DILATE * max(h, w)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    ground = cv2.dilate((mask > 0.5).astype(np.uint8), kernel) == 0
    if valid is not None:
        ground &= valid
    y, x = np.nonzero(ground)
    flow = np.asarray(flow, np.float32)
    if len(x) < _FIT_LEAST:
        return flow
    pick = np.linspace(0, len(x) - 1, min(len(x), _FIT_POINTS)).astype(int)
    x, y = x[pick], y[pick]
    A = np.stack([np.ones(len(x)), 2 * x / w - 1, 2 * y / h - 1], -1)
    seen = flow[y, x].astype(float)
    model = np.zeros((3, 2))
    model[0] = np.median(seen, 0)
    for _ in range(_FIT_ROUNDS):
        r2 = ((seen - A @ model) ** 2).sum(-1)
        s2 = (2 * 1.4826) ** 2 * np.median(r2) + 1e-4
        weighted = A * (1 / (1 + r2 / s2) ** 2)[:, None]
        model = np.linalg.solve(weighted.T @ A + 1e-6 * len(x) * np.eye(3), weighted.T @ seen)
    along = model[1] * (2 * np.arange(w)[:, None] / w - 1)
    down = model[2] * (2 * np.arange(h)[:, None] / h - 1)
    return flow - (model[0] + along[None] + down[:, None]).astype(np.float32)


def normalised(rgb: Array, mask: Array, flow: Array | None) -> Array:
    """The networks' input (..., 6, S, S) float32 from crops.

    Args:
        rgb: (..., S, S, 3) uint8 or float of 0 to 255. mask: (..., S, S) in [0, 1].
        flow: (..., S, S, 2) crop px, the camera's share taken off; None: not known, zeros.
    """
    if mask.ndim > 2:
        flows = flow if flow is not None else [None] * len(mask)
        return np.stack([normalised(*crop) for crop in zip(rgb, mask, flows, strict=True)])
    size = mask.shape[-1]
    mask = np.asarray(mask, np.float32)
    inside = mask > 0.5
    out = np.zeros((6, size, size), np.float32)
    out[3] = mask
    if not inside.any():
        return out
    colours = rgb[inside].astype(np.float32)
    mean, std = colours.mean(0), np.maximum(colours.std(0), _DARK)
    out[:3] = (np.clip((rgb.astype(np.float32) - mean) / std, -COLOUR_CLIP, COLOUR_CLIP) * mask[..., None]).transpose(
        2, 0, 1
    )
    if flow is not None:
        flow = np.asarray(flow, np.float32)
        length = max(float(np.percentile(np.hypot(flow[..., 0], flow[..., 1])[inside], 90)), STILL * size)
        out[4:] = (np.clip(flow / length, -FLOW_CLIP, FLOW_CLIP) * inside[..., None]).transpose(2, 0, 1)
    return out


def network_input(rgb: Array, mask: Array, flow: Array | None, box: Box, size: int) -> Array:
    """What the networks take of a frame, (6, size, size) float32.

    Channels 0 to 2: colour less its mean over its spread inside the mask, 0 outside; 3: the mask in [0, 1]; 4, 5: flow
    without the camera's share, over the length that 90 % of the mask stay below, 0 outside the mask.

    Args:
        rgb: (H, W, 3) uint8. mask: (H, W) bool. flow: (H, W, 2) px to the next frame, or None.
    """
    crop_mask = cut(mask.astype(np.float32), box, size)
    motion = None
    if flow is not None:
        valid = cut(np.ones(mask.shape, np.float32), box, size) > 0.99
        motion = compensate(cut(np.asarray(flow, np.float32), box, size) * (size / box.side), crop_mask, valid=valid)
    return normalised(cut(rgb, box, size), crop_mask, motion)
