"""What the fit compares with: masks, distance transforms, chained flow and cameras, at a working resolution.

Fit frames are every n-th frame of the clip; the flow between two of them is the flow of the frames between, chained.
"""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from slomo.errors import InvalidData
from slomo.ground_path import mask_box
from slomo.packed import unpack
from slomo.pinhole import Intrinsics, ground_points
from slomo.prior.frames import every, spread
from slomo.reconstruct.steady import steadied
from slomo.reconstruct.subject_flow import merged

Array = np.ndarray
Tensor = torch.Tensor

STATIC_PX = 0.35  # a pixel moves with the ground when its flow differs by about this many working pixels
LONG_FPS = 15.0  # of a clip with more pixels than those: rather fewer frames than small ones
MOST_PIXELS = 30e6  # working pixels of all fit frames together, each of which takes about 40 bytes


@dataclass(frozen=True)
class Observations:
    """At F fit frames, images flattened to n = height * width working pixels.

    Attributes:
        t: (T,) s of all frames; at: (F,) indices of the fit frames; dt: (F-1,) s between them.
        K: intrinsics of the working resolution; scale: (2,) its pixels per decoded pixel, along u and v.
        T_world_cam: (T, 4, 4) as given, but for its tremble.
        mask: (F, n) bool; edge: (F, 1, h, w) px, signed distance to the mask's edge, positive outside.
        draw_in, draw_out: (F, n) cumulative probabilities for drawing mask and background pixels.
        flow: (F-1, n, 2) px; flow_ok: (F-1, n) bool.
        static: (F, 1, h, w) in [0, 1], how surely a mask pixel moves as a point of the ground there would.
        quality: (F,) in [0, 1]. box: (F, 4) u0, v0, u1, v1 px of the mask; empty: (F,) bool.
        flow_size: px, robust magnitude of the flow inside the mask.
    """

    t: Tensor
    at: Tensor
    dt: Tensor
    K: Intrinsics
    scale: Array
    T_world_cam: Array
    mask: Tensor
    edge: Tensor
    draw_in: Tensor
    draw_out: Tensor
    flow: Tensor
    flow_ok: Tensor
    static: Tensor
    quality: Tensor
    box: Array
    empty: Array
    flow_size: float


def observe(
    frames_t: Array, masks: Mapping[str, Array], flow: Mapping[str, Array], camera: Mapping[str, Array],
    *, fps: float, subject_px: float,
) -> Observations:  # fmt: skip
    """Arrange the artifacts for the fit.

    Args:
        frames_t: (T,) s. masks, flow, camera: the arrays of the upstream artifacts.
        fps: fit frames a second at most; no more than `LONG_FPS` of a clip that would take too much memory.
        subject_px: wanted size of the subject (root of its area) in working pixels; never above the clip's own, and
            less where a long clip with a small subject would take too much memory (`MOST_PIXELS`).

    Raises:
        InvalidData: the artifacts disagree about the number of frames, or no frame has a subject.
    """
    T, height, width = (int(n) for n in masks["shape"])
    counts = dict(frames=len(frames_t), masks=T, flow=len(flow["flow"]) + 1, camera=len(camera["T_world_cam"]))
    if len(set(counts.values())) != 1:
        raise InvalidData(f"the parts disagree about the number of frames: {counts}", where="reconstruct")
    at = np.arange(0, T, every(frames_t, fps))
    area = np.array([unpack(masks, k).sum() for k in at])
    if not (area > 0).any():
        raise InvalidData("no frame shows the subject", where="masks", todo="give masks with --masks")
    scale = min(1.0, subject_px / float(np.sqrt(np.median(area[area > 0]))))
    if len(at) * height * width * scale**2 > MOST_PIXELS:
        at = np.arange(0, T, every(frames_t, min(fps, LONG_FPS)))
        scale = min(scale, float(np.sqrt(MOST_PIXELS / (len(at) * height * width))))
    full = [unpack(masks, k) for k in at]
    w, h = max(16, round(width * scale)), max(16, round(height * scale))
    scale = np.array([w / width, h / height])  # not quite alike: both sides are whole numbers of pixels
    smaller = lambda x: cv2.resize(np.asarray(x, np.float32), (w, h), interpolation=cv2.INTER_AREA)  # noqa: E731
    mask = np.stack([smaller(m) > 0.5 for m in full])
    K0 = np.asarray(camera["K"], float)
    # Pixel centres are at integers: (u + 1/2) scales, not u.
    (fx, fy), (cx, cy) = K0[[0, 1], [0, 1]] * scale, (K0[:2, 2] + 0.5) * scale - 0.5
    K = Intrinsics(float(fx), float(fy), float(cx), float(cy), w, h)
    fl, ok = np.empty((len(at) - 1, h, w, 2), np.float32), np.empty((len(at) - 1, h, w), bool)
    for i, (first, last) in enumerate(itertools.pairwise(at.tolist())):
        total, sure = _chain(flow, first, last, (width, height))
        fl[i], ok[i] = smaller(total) * scale.astype(np.float32), smaller(sure) > 0.7
    T_world_cam = steadied(
        np.asarray(camera["T_world_cam"], float),
        Intrinsics(K0[0, 0], K0[1, 1], K0[0, 2], K0[1, 2], width, height),
        flow["flow"],
        _background(masks, flow),
    )
    static = _static(K, T_world_cam[at], mask, fl, ok)
    distance = lambda m: cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 3)  # noqa: E731
    inside = np.stack([distance(m) for m in mask])
    outside = np.stack([distance(~m) if m.any() else np.zeros((h, w), np.float32) for m in mask])
    empty = np.array([not m.any() for m in mask])
    box = np.array([[0, 0, 0, 0] if not m.any() else mask_box(m) for m in mask], float)
    # Thin parts (legs) are drawn as often as thick ones; background is drawn near the subject and everywhere.
    draw_in = _cumulative(m / (1 + i) for m, i in zip(mask, inside, strict=True))
    draw_out = _cumulative(_beside(m, o) for m, o in zip(mask, outside, strict=True))
    size = np.linalg.norm(fl, axis=-1)[ok & mask[:-1]]
    f = lambda x: torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)  # noqa: E731
    flat = lambda x: torch.as_tensor(np.ascontiguousarray(x)).reshape(len(x), h * w, *x.shape[3:])  # noqa: E731
    return Observations(
        t=f(frames_t), at=torch.as_tensor(at), dt=f(np.diff(np.asarray(frames_t)[at])), K=K, scale=scale,
        T_world_cam=T_world_cam, mask=flat(mask), edge=f(outside - inside)[:, None], draw_in=draw_in, draw_out=draw_out,
        flow=flat(fl), flow_ok=flat(ok & mask[:-1]), static=f(static)[:, None],
        quality=f(masks["quality"][at]) * f(~empty), box=box, empty=empty,
        flow_size=float(np.quantile(size, 0.5)) if len(size) else 1.0,
    )  # fmt: skip


def _background(masks: Mapping[str, Array], flow: Mapping[str, Array]) -> Array:
    """(T-1, h, w) bool: cells of the flow's grid that hold no subject and whose flow leads back."""
    rows, columns = flow["flow"].shape[1:3]
    there = np.unpackbits(flow["consistent"], axis=-1)[:, :, :columns].astype(bool)
    for k in range(len(there)):
        mask = cv2.dilate(unpack(masks, k).astype(np.uint8), np.ones((9, 9), np.uint8))
        there[k] &= cv2.resize(mask.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA) == 0
    return there


def _beside(mask: Array, outside: Array) -> Array:
    near, far = np.where(mask, 0, np.exp(-outside / 4.0)), (~mask).astype(float)
    return 0.65 * near / max(near.sum(), 1e-9) + 0.35 * far / max(far.sum(), 1e-9)


def _cumulative(weights: Iterable[Array]) -> Tensor:
    """(F, n) float64 of F pictures of weights (h, w)."""
    c = np.stack([np.cumsum(p.ravel(), dtype=float) for p in weights])
    c /= np.maximum(c[:, -1:], 1e-12)
    return torch.as_tensor(c)


def _chain(flow: Mapping[str, Array], first: int, last: int, size: tuple[int, int]) -> tuple[Array, Array]:
    """Flow between two frames, (H, W, 2) and whether it is sure (H, W): pixels are carried through those between."""

    def at(k: int) -> tuple[Array, Array]:
        field, home = merged(flow, k)
        return spread(field, size), cv2.resize(home.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    total, ok = at(first)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).astype(np.float32)
    for k in range(first + 1, last):
        at_k = grid + total
        step, sure = at(k)
        total = total + _at(step, at_k)
        ok = ok * _at(sure, at_k)
    return total, ok > 0.5


def _at(image: Array, uv: Array) -> Array:
    """Values of an image at the places uv (H, W, 2) px, bilinear."""
    return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)


def _static(K: Intrinsics, T_world_cam: Array, mask: Array, flow: Array, ok: Array) -> Array:
    """How surely each mask pixel moves with the ground under it; the last fit frame repeats the one before."""
    F, h, w = mask.shape
    v, u = np.mgrid[:h, :w].astype(float)
    out = np.zeros((F, h, w), np.float32)
    for i in range(F - 1):
        X = ground_points(K, T_world_cam[i], u, v)
        Y = (X - T_world_cam[i + 1, :3, 3]) @ T_world_cam[i + 1, :3, :3]
        z = np.maximum(Y[..., 2], 1e-6)
        moved = np.stack([K.fx * Y[..., 0] / z + K.cx - u, K.fy * Y[..., 1] / z + K.cy - v], -1)
        error = np.linalg.norm(flow[i] - moved, axis=-1)
        score = np.exp(-((error / STATIC_PX) ** 2) / 2)
        out[i] = np.where(mask[i] & ok[i] & np.isfinite(error), score, 0)
    out[-1] = out[-2] if F > 1 else 0
    return out
