"""A network on samples that it was not trained on: losses, temperatures, scores, and the curves of a training."""

import csv
import io
from typing import Any

import numpy as np
import torch

from slomo.prior import metrics
from slomo.prior.dataset import Batch
from slomo.prior.inference import Prior, peaks
from slomo.prior.labels import Labels, rotation_of
from slomo.prior.network import Network, Output
from slomo.prior.objective import TERMS, ObjectiveConfig, Temperatures, losses


@torch.inference_mode()
def check(net: Network, held: list[Batch], weights: torch.Tensor, config: ObjectiveConfig) -> dict[str, float]:
    """Mean losses on batches."""
    found = [losses(Output(*net(b.input)), b, weights, config) for b in held]
    return {k: float(np.mean([float(terms[k]) for terms in found])) for k in TERMS}


@torch.inference_mode()
def temperatures(net: Network, held: list[Batch]) -> dict[str, float]:
    """Fitted on samples that were not trained on."""
    fit = Temperatures()
    for b in held:
        fit.add(Output(*net(b.input)), b)
    return fit.best()


def score(prior: Prior, known: Labels, held: list[Batch]) -> dict[str, Any]:
    """What a network is worth on labelled batches: see `metrics`."""
    names = known.keypoints
    parts, errors, sides, azimuths, rotations = metrics.PartScore(len(known.parts) + 1), [], [], [], []
    for b in held:
        x = b.input.numpy()
        p = prior(np.ascontiguousarray(x))
        parts.add(p.parts.argmax(1), b.parts.numpy())
        size = np.sqrt(np.maximum((x[:, 3] > 0.5).sum((1, 2)), 1))
        true = b.keypoints.numpy().copy()
        true[((true < 0) | (true > p.size - 1)).any(-1)] = np.nan
        places, _ = peaks(p.heat, p.size)
        errors.append(metrics.keypoint_errors(places, true, size))
        sides.append(metrics.sides_right(places, true, size, names))
        R = rotation_of(b.azimuth.numpy().astype(float), b.up.numpy().astype(float))
        a, r = metrics.view_errors(p.view, p.up, R)
        azimuths.append(a)
        rotations.append(r)
    error, azimuth, rotation = np.concatenate(errors), np.concatenate(azimuths), np.concatenate(rotations)
    iou = parts.iou()
    return {
        "samples": len(azimuth),
        "part_iou": float(np.nanmean(iou)),
        "part_iou_each": dict(zip(known.parts, iou.tolist(), strict=True)),
        "pck": metrics.within(error, metrics.PCK),
        "pck_feet": metrics.within(error[:, metrics.feet(names)], metrics.PCK),
        "sides": metrics.share(np.concatenate(sides)),
        "view_azimuth": metrics.within(azimuth, metrics.VIEW),
        "view_rotation": metrics.within(rotation, metrics.VIEW),
        "view_azimuth_median_deg": float(np.degrees(np.median(azimuth))),
    }


def curves(rows: list[list[float]]) -> tuple[bytes, bytes]:
    """The log as CSV and as a picture."""
    from matplotlib.figure import Figure

    names = ["step", "rate", *TERMS, *(f"held_{t}" for t in TERMS)]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *([f"{x:.6g}" for x in row] for row in rows)])
    x = np.array(rows)
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    for i, (axis, term) in enumerate(zip(figure.subplots(2, 3).flat, TERMS, strict=True)):
        axis.plot(x[:, 0], x[:, 2 + i], lw=0.6, color="0.6", label="training")
        held = np.isfinite(x[:, 2 + len(TERMS) + i])
        axis.plot(x[held, 0], x[held, 2 + len(TERMS) + i], "o-", ms=3, label="held out, averaged weights")
        axis.set_title(term)
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
    figure.axes[0].legend()
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=90)
    return text.getvalue().encode(), picture.getvalue()
