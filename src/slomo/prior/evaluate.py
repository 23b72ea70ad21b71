"""A network alone on a clip, frame by frame, against the truth: what it is worth before anything makes frames agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from slomo.prior import metrics
from slomo.prior.crop import Box, crop_box, from_crop, network_input
from slomo.prior.inference import Prediction, Prior, peaks
from slomo.prior.labels import Labels, toward

Array = np.ndarray


@dataclass(frozen=True)
class Truth:
    """What is known about a clip; NaN where nothing is.

    Attributes:
        frames: (F,) indices of frames that are judged.
        keypoints: (F, K, 2) px.
        R_view_body: (F, 3, 3).
    """

    frames: Array
    keypoints: Array
    R_view_body: Array


def trunk_rotation(labels: Labels, names: Sequence[str], keypoints: Array) -> Array:
    """(T, 3, 3) body to world by those key points (T, N, 3) of the trunk that have a name the skeleton knows."""
    wanted = [labels.keypoints[i] for i in labels.trunk]
    there = [i for i, name in enumerate(wanted) if name in names]
    subset = replace(labels, trunk=np.arange(len(there)), trunk_rest=labels.trunk_rest[there])
    return subset.trunk_rotation(keypoints[:, [list(names).index(wanted[i]) for i in there]])


def truth_of(labels: Labels, arrays: dict[str, Array], frames: Array) -> Truth:
    """Truth from `truth.npz`: `keypoints` (T, N, 3) m with `keypoint_names`, `K` (3, 3), `T_world_cam` (T, 4, 4)."""
    names = [str(n) for n in arrays["keypoint_names"]]
    T, X = arrays["T_world_cam"][frames], arrays["keypoints"][frames]
    R = trunk_rotation(labels, names, X)
    x = (X - T[:, None, :3, 3]) @ T[:, :3, :3]  # camera frame
    uv = x @ arrays["K"].T
    uv = uv[..., :2] / uv[..., 2:]
    trunk = [i for i, n in enumerate(names) if n in {labels.keypoints[k] for k in labels.trunk}]
    R_view_body = toward(x[:, trunk].mean(1)) @ np.swapaxes(T[:, :3, :3], 1, 2) @ R
    keypoints = np.full((len(frames), len(labels.keypoints), 2), np.nan)
    for k, name in enumerate(labels.keypoints):
        if name in names:
            keypoints[:, k] = uv[:, names.index(name)]
    return Truth(frames, keypoints, R_view_body)


def predict(
    prior: Prior, frames: Array, masks: Array, at: Array, *, apart: int = 2, size: int | None = None
) -> tuple[Prediction, list[Box], Array]:
    """The network on frames `at` of a clip (T, H, W, 3) with masks (T, H, W).

    Args:
        apart: frames between the two that flow is taken from, about 1/15 s.
        size: px of the crop; the network's own by default.

    Returns:
        what it says; the boxes; the crops (F, 6, S, S).
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    size = size or prior.size
    boxes, crops = [], []
    for t in at:
        # The last frames have nothing after them: their motion is what came before.
        a = min(t, len(frames) - 1 - apart)
        grey = [cv2.cvtColor(frames[i], cv2.COLOR_RGB2GRAY) for i in (a, a + apart)]
        flow = dis.calc(grey[0], grey[1], None)  # type: ignore[call-overload]
        boxes.append(crop_box(masks[t]))
        crops.append(network_input(frames[t], masks[t], flow, boxes[-1], size))
    crops = np.stack(crops)
    return prior(crops), boxes, crops


def judge(labels: Labels, prediction: Prediction, boxes: Sequence[Box], masks: Array, truth: Truth) -> dict[str, Any]:
    """Shares that are right. Args: masks (F, H, W) of the judged frames.

    Returns:
        `azimuth`, `rotation`: of the frames, root view within 20 degrees; `azimuth_deg`, `rotation_deg`: median errors;
        `pck`, `pck_feet`, `pck_each`: key points within 0.2 sqrt(mask area); `sides`: of the pairs of legs and
        frames, left is left; `sides_clip`: 1 if that is so for most of them.
    """
    places, _ = peaks(prediction.heat, prediction.size)
    places = from_crop(places, np.array(boxes)[:, None], prediction.size)
    size = np.sqrt(masks.sum((1, 2)))
    error = metrics.keypoint_errors(places, truth.keypoints, size)
    azimuth, rotation = metrics.view_errors(prediction.view, prediction.up, truth.R_view_body)
    sides = metrics.share(metrics.sides_right(places, truth.keypoints, size, labels.keypoints))
    each = {name: metrics.within(error[:, k], metrics.PCK) for k, name in enumerate(labels.keypoints)}
    return {
        "frames": len(masks),
        "azimuth": metrics.within(azimuth, metrics.VIEW),
        "rotation": metrics.within(rotation, metrics.VIEW),
        "azimuth_deg": float(np.degrees(np.median(azimuth))),
        "rotation_deg": float(np.degrees(np.median(rotation))),
        "pck": metrics.within(error, metrics.PCK),
        "pck_feet": metrics.within(error[:, metrics.feet(labels.keypoints)], metrics.PCK),
        "sides": sides,
        "sides_clip": float(sides > 0.5) if np.isfinite(sides) else float("nan"),
        "pck_each": {name: x for name, x in each.items() if np.isfinite(x)},
    }
