"""Renderings made as bad as real footage is: estimated masks, crops that are off, colours and motion that lie.

All that is changed is what real inputs get wrong; labels follow where geometry moves. A stored sample (crop of the
true mask) comes in, the network's input and its targets go out. Random numbers come from one generator alone, so the
same seed gives the same batches.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slomo.prior import crop
from slomo.prior.labels import Labels

Array = np.ndarray


@dataclass(frozen=True)
class Sample:
    """One stored sample of S0 x S0 px: see `slomo.synth.dataset`. `flow` is float32, `surface` body lengths times
    `SURFACE_UNIT`."""

    rgb: Array
    mask: Array
    flow: Array
    parts: Array
    surface: Array
    keypoints: Array
    visible: Array
    azimuth: float
    up: Array


@dataclass(frozen=True)
class Example:
    """What the network is shown and asked.

    Attributes:
        input: (6, S, S) float32.
        parts: (S/2, S/2) uint8 labels. surface: (3, S/2, S/2) int8, body lengths times `SURFACE_UNIT`, where parts > 0.
        keypoints: (K, 2) float32 px of the crop. visible: (K,) 0 or 1.
        azimuth: rad. up: (3,).
    """

    input: Array
    parts: Array
    surface: Array
    keypoints: Array
    visible: Array
    azimuth: float
    up: Array


@dataclass(frozen=True)
class AugmentConfig:
    """How much of what; px are those of a stored sample of 160. Probabilities unless it says otherwise.

    Attributes:
        mirror: left and right swapped.
        clean_mask: the mask is left as it is.  grow: px, most that a mask grows or shrinks.
        blob: pieces of background added, or of the subject missing.  thin: an end (paw, tail, nose) is missing.
        chop: one side of the mask is cut straight (grass, a fence, the picture's edge).
        turn: rad, most of in-plane rotation.  shift, scale, stretch: s.d., of the side, log, log.
        no_colour, no_flow: the cue is not there at all.  colour, flow: else it is changed.
        residual: of the subject's motion, s.d. of what is left of the camera's.
    """

    mirror: float = 0.5
    clean_mask: float = 0.15
    grow: int = 4
    blob: float = 0.45
    thin: float = 0.3
    chop: float = 0.08
    turn: float = 0.21
    shift: float = 0.025
    scale: float = 0.06
    stretch: float = 0.06
    no_colour: float = 0.3
    colour: float = 0.9
    no_flow: float = 0.3
    flow: float = 0.9
    residual: float = 0.25


def mirrored(sample: Sample, labels: Labels) -> Sample:
    """The sample in a mirror: u turns round, left and right change their names, y its sign in the canonical body."""
    keypoints = sample.keypoints[labels.mirror_keypoint].copy()
    keypoints[:, 0] = sample.mask.shape[1] - 1 - keypoints[:, 0]
    flow, surface = cv2.flip(sample.flow, 1), cv2.flip(sample.surface, 1)
    flow[..., 0] *= -1
    surface[..., 1] *= -1
    swap = np.zeros(256, np.uint8)
    swap[: len(labels.mirror_part)] = labels.mirror_part
    return Sample(
        rgb=cv2.flip(sample.rgb, 1),
        mask=cv2.flip(sample.mask, 1),
        flow=flow,
        parts=cv2.LUT(cv2.flip(sample.parts, 1), swap),
        surface=surface,
        keypoints=keypoints,
        visible=sample.visible[labels.mirror_keypoint],
        azimuth=-sample.azimuth,
        up=sample.up * np.array([-1, 1, 1], np.float32),
    )


def _smooth(rng: np.random.Generator, cells: int, size: int, channels: int = 1) -> Array:
    """(size, size[, channels]) smooth normal noise of `cells` waves or so across."""
    coarse = rng.standard_normal((cells, cells, channels), dtype=np.float32)
    return cv2.resize(coarse, (size, size), interpolation=cv2.INTER_LINEAR)


def _disc(radius: int) -> Array:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def noisy_mask(sample: Sample, config: AugmentConfig, rng: np.random.Generator) -> Array:
    """(S0, S0) uint8: the mask as a segmentation of real footage would have it."""
    true = sample.mask
    if rng.random() < config.clean_mask:
        return true
    size = true.shape[0]
    mask = true.copy()
    edge = np.argwhere(cv2.morphologyEx(true, cv2.MORPH_GRADIENT, _disc(1)))
    if rng.random() < config.thin:
        for k in rng.choice(len(sample.keypoints), rng.integers(1, 4)):
            u, v = sample.keypoints[k]
            if sample.visible[k] and sample.parts[min(max(int(v), 0), size - 1), min(max(int(u), 0), size - 1)] > 1:
                cv2.circle(mask, (int(u), int(v)), int(rng.integers(3, 12)), 0, -1)
    if rng.random() < 0.1:
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(int(rng.integers(2, 5))))
    if rng.random() < config.blob and len(edge):
        for _ in range(rng.integers(1, 4)):
            v, u = edge[rng.integers(len(edge))] + rng.integers(-6, 7, 2)
            axes = rng.integers(2, 13, 2)
            turn = float(rng.uniform(0, 180))
            cv2.ellipse(mask, (int(u), int(v)), (int(axes[0]), int(axes[1])), turn, 0, 360, int(rng.random() < 0.5), -1)
    if rng.random() < config.chop and len(edge):
        across = rng.standard_normal(2) + (0, 1.5)  # mostly from below
        along = edge @ across
        far = np.quantile(along, rng.uniform(0.8, 0.97))
        v, u = np.mgrid[:size, :size]
        mask[v * across[0] + u * across[1] > far] = 0
    grow = int(rng.integers(-config.grow + 1, config.grow + 1))
    if grow:
        mask = (cv2.dilate if grow > 0 else cv2.erode)(mask, _disc(abs(grow)))
    width = 2 * int(rng.integers(1, 6)) + 1
    soft = cv2.blur(mask.astype(np.float32), (width, width))
    noise = _smooth(rng, int(rng.integers(6, 28)), size)
    mask = (soft + rng.uniform(0, 0.18) * noise > rng.uniform(0.35, 0.65)).astype(np.uint8)
    return mask if mask.sum() > 0.4 * true.sum() else true


def _placing(mask: Array, config: AugmentConfig, rng: np.random.Generator) -> tuple[Array, Array, Array, float]:
    """Where the crop is: src = centre + side / size * L @ (dst - middle). Returns centre, L, its rotation, side."""
    c, s = np.cos(a := rng.uniform(-config.turn, config.turn)), np.sin(a)
    turn = np.array([[c, -s], [s, c]])
    stretch = np.exp(rng.normal(0, config.stretch))
    L = turn @ np.diag([stretch, 1 / stretch])
    size = mask.shape[0]
    middle = np.full(2, (size - 1) / 2)
    turned = cv2.warpAffine(
        mask, np.c_[L, middle - L @ middle], (size, size), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    box = crop.crop_box(turned if turned.any() else mask)
    at = np.array([box.x0, box.y0]) + box.side / 2 - 0.5 + rng.normal(0, config.shift, 2) * box.side
    return middle + L @ (at - middle), L, turn, box.side * np.exp(rng.normal(0, config.scale))


def recoloured(rgb: Array, rng: np.random.Generator) -> Array:
    """(S, S, 3) uint8: other channels, contrast, light, sharpness and noise."""
    size = rgb.shape[0]
    kind = rng.random()
    if kind < 0.2:
        rgb = np.repeat(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[..., None], 3, -1)
    elif kind < 0.6:
        mix = np.eye(3)[rng.permutation(3)] + rng.normal(0, 0.15, (3, 3))
        rgb = cv2.transform(rgb, mix / np.abs(mix).sum(1, keepdims=True))
    if rng.random() < 0.6:
        levels = np.linspace(0, 1, 256)[:, None] ** np.exp(rng.normal(0, 0.4, 3))
        levels = rng.uniform(0.6, 1.6) * (levels - 0.5) + rng.uniform(0.35, 0.65)
        rgb = cv2.LUT(rgb, (255 * np.clip(levels, 0, 1)).astype(np.uint8)[None])
    light = np.ones((size, size, 1), np.float32)
    if rng.random() < 0.4:
        light = np.exp(0.3 * _smooth(rng, int(rng.integers(2, 7)), size))[..., None]
    if rng.random() < 0.3:
        width = 2 * int(rng.integers(1, 4)) + 1
        rgb = cv2.blur(rgb, (width, width))
    out = rgb * light
    if rng.random() < 0.3:
        out += rng.uniform(2, 14) * rng.standard_normal(rgb.shape, dtype=np.float32)
    return np.clip(out, 0, 255)


def shaken(flow: Array, inside: Array, config: AugmentConfig, rng: np.random.Generator) -> Array:
    """(S, S, 2) px: what optical flow and the camera's motion get wrong is added to true flow."""
    size = flow.shape[0]
    length = np.sqrt((flow[inside] ** 2).sum(-1).mean()) if inside.any() else 0.0
    pace = np.exp(rng.normal(0, 0.4))
    if rng.random() < 0.6:
        width = 2 * int(rng.integers(1, 6)) + 1
        flow = cv2.blur(flow, (width, width))
    noise = rng.uniform(0, 0.3) * length + rng.uniform(0, 0.004) * size
    flow = pace * flow + noise * _smooth(rng, int(rng.integers(3, 20)), size, 2)
    if rng.random() < 0.5:
        slope = _smooth(rng, 2, size, 2)  # bilinear over the crop: shift, zoom and turn
        flow = flow + config.residual * pace * length * slope
    if rng.random() < 0.15:
        flow = flow * (_smooth(rng, int(rng.integers(2, 6)), size) > -0.5)[..., None]
    return flow


def example(sample: Sample, labels: Labels, config: AugmentConfig, rng: np.random.Generator, *, size: int) -> Example:
    """A stored sample as the network of input side `size` may meet it."""
    if rng.random() < config.mirror:
        sample = mirrored(sample, labels)
    mask = noisy_mask(sample, config, rng)
    centre, L, turn, side = _placing(mask, config, rng)

    def cut(image: Array, n: int, mode: int) -> Array:
        A = side / n * L
        M = np.c_[A, centre - A @ np.full(2, (n - 1) / 2)]
        return cv2.warpAffine(image, M, (n, n), flags=mode | cv2.WARP_INVERSE_MAP, borderValue=0)

    crop_mask = cut(mask.astype(np.float32), size, cv2.INTER_LINEAR)
    inside = crop_mask > 0.5
    inverse = size / side * np.linalg.inv(L)
    flow = None
    if rng.random() >= config.no_flow:
        flow = cut(sample.flow, size, cv2.INTER_LINEAR) @ inverse.T.astype(np.float32)
        if rng.random() < config.flow:
            flow = shaken(flow, inside, config, rng)
    rgb = cut(sample.rgb, size, cv2.INTER_LINEAR)
    if rng.random() < config.colour:
        rgb = recoloured(rgb, rng)
    seen = crop.normalised(rgb, crop_mask, flow)
    if rng.random() < config.no_colour:
        seen[:3] = 0
    turned_up = sample.up.astype(np.float32).copy()
    turned_up[:2] = turn.T @ turned_up[:2]
    return Example(
        input=seen,
        parts=cut(sample.parts, size // 2, cv2.INTER_NEAREST),
        surface=cut(sample.surface, size // 2, cv2.INTER_NEAREST).transpose(2, 0, 1),
        keypoints=((sample.keypoints - centre) @ inverse.T + (size - 1) / 2).astype(np.float32),
        visible=sample.visible,
        azimuth=sample.azimuth,
        up=turned_up,
    )


def without(config: AugmentConfig | None = None) -> AugmentConfig:
    """Nothing changed at all: the true mask, its own crop, colour and motion as they are stored."""
    still = dict(turn=0.0, shift=0.0, scale=0.0, stretch=0.0, clean_mask=1.0)
    cues = dict(mirror=0.0, no_colour=0.0, colour=0.0, no_flow=0.0, flow=0.0)
    return replace(config or AugmentConfig(), **still, **cues)
