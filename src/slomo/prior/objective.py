"""What the networks are trained for: one loss a head, nearly all of them logarithms of probabilities."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from slomo.prior.dataset import Batch
from slomo.prior.labels import BINS
from slomo.prior.network import Output

TERMS = ("parts", "surface", "heatmaps", "seen", "view", "up")


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the losses, and how exact labels are taken to be.

    Attributes:
        parts, surface, heatmaps, seen, view, up: weights.
        hidden: weight of a key point that is in the crop but hidden, against one that is seen.
        place: cells of a heat map (4 px of the crop), s.d. of a key point's place.
        azimuth: rad, s.d. of the view: neighbouring bins are not wrong altogether.
    """

    parts: float = 1.0
    surface: float = 0.3
    heatmaps: float = 0.5
    seen: float = 0.3
    view: float = 0.7
    up: float = 1.0
    hidden: float = 0.4
    place: float = 1.2
    azimuth: float = math.radians(12.0)


def places(batch: Batch, cells: int) -> tuple[Tensor, Tensor]:
    """Key points in cells of a heat map (N, K, 2), and whether they are inside it (N, K)."""
    at = (batch.keypoints + 0.5) * (cells / batch.input.shape[-1]) - 0.5
    return at, ((at > -0.5) & (at < cells - 0.5)).all(-1)


def wanted_heat(batch: Batch, cells: int, spread: float) -> tuple[Tensor, Tensor]:
    """(N, K, cells, cells) Gaussians that sum to 1 around the key points, and whether they are inside (N, K)."""
    at, inside = places(batch, cells)
    grid = torch.arange(cells, dtype=torch.float32)
    along = torch.softmax(-((grid - at[..., None].clamp(-1, cells)) ** 2) / (2 * spread**2), -1)  # (N, K, 2, cells)
    return along[..., 1, :, None] * along[..., 0, None, :], inside


def wanted_view(azimuth: Tensor, spread: float) -> Tensor:
    """(N, 36) wrapped Gaussians around azimuths (N,)."""
    bins = torch.arange(BINS, dtype=torch.float32) * (2 * math.pi / BINS)
    away = torch.remainder(bins - azimuth[:, None] + math.pi, 2 * math.pi) - math.pi
    return torch.softmax(-(away**2) / (2 * spread**2), -1)


def losses(out: Output, batch: Batch, class_weight: Tensor, config: ObjectiveConfig) -> dict[str, Tensor]:
    """The loss of each head, unweighted, the mean over its pixels, key points or samples.

    Args:
        class_weight: (P+1,) of part labels, so that a paw counts beside a trunk.
    """
    out = Output(*(x.float() for x in out))
    cells = out.heatmaps.shape[-1]
    heat, inside = wanted_heat(batch, cells, config.place)
    cross = -(heat * torch.log_softmax(out.heatmaps.flatten(2), -1).view_as(heat)).sum((-2, -1))
    weight = inside * (config.hidden + (1 - config.hidden) * batch.visible)
    body = batch.parts > 0
    # Laplace: the network says itself how far off it may be (Kendall and Gal, NeurIPS 2017).
    log_scale = out.surface[:, 3].clamp(-5, 2)
    miss = (out.surface[:, :3] - batch.surface).abs().mean(1)
    nll = miss * torch.exp(-log_scale) + log_scale
    return {
        "parts": functional.cross_entropy(out.parts, batch.parts, class_weight),
        "surface": (nll * body).sum() / body.sum().clamp(min=1),
        "heatmaps": (cross * weight).sum() / weight.sum().clamp(min=1),
        "seen": functional.binary_cross_entropy_with_logits(out.seen, batch.visible * inside),
        "view": functional.cross_entropy(out.view, wanted_view(batch.azimuth, config.azimuth)),
        "up": (1 - functional.cosine_similarity(out.up, batch.up, dim=-1)).mean(),
    }


def total(terms: dict[str, Tensor], config: ObjectiveConfig) -> Tensor:
    """The weighted sum."""
    return sum((getattr(config, name) * terms[name] for name in TERMS), torch.zeros(()))


def class_weights(parts: Tensor, count: int) -> Tensor:
    """(P+1,) one over the square root of how frequent labels are, 1 on average over the pixels of `parts`."""
    share = torch.bincount(parts.flatten(), minlength=count).float() / parts.numel()
    weight = 1 / share.clamp(min=1e-4).sqrt()
    return weight / (weight * share).sum()


class Temperatures:
    """How far logits must be scaled down for their probabilities to be right on samples that were not trained on.

    (Guo et al., ICML 2017.) Of the surface: the factor of the Laplace scale. Never below 1: footage is harder than
    renderings, and what was learnt from widened labels must not be narrowed, or of two modes the larger one grows.
    """

    GRID = torch.logspace(0, math.log10(6.0), 31)

    def __init__(self):
        self._loss = {name: torch.zeros(len(self.GRID)) for name in ("parts", "heatmaps", "seen", "view")}
        self._miss, self._pixels = 0.0, 0

    def add(self, out: Output, batch: Batch) -> None:
        """Count a batch in."""
        cells = out.heatmaps.shape[-1]
        at, inside = places(batch, cells)
        cell = at.round().long().clamp(0, cells - 1)
        place = (cell[..., 1] * cells + cell[..., 0])[inside]
        bin_ = torch.round(batch.azimuth * (BINS / (2 * math.pi))).long() % BINS
        heat, seen = out.heatmaps.flatten(2)[inside], batch.visible * inside
        for i, t in enumerate(self.GRID):
            self._loss["parts"][i] += functional.cross_entropy(out.parts / t, batch.parts)
            self._loss["heatmaps"][i] += functional.cross_entropy(heat / t, place)
            self._loss["seen"][i] += functional.binary_cross_entropy_with_logits(out.seen / t, seen)
            self._loss["view"][i] += functional.cross_entropy(out.view / t, bin_)
        body = batch.parts > 0
        miss = (out.surface[:, :3] - batch.surface).abs().mean(1) * torch.exp(-out.surface[:, 3].clamp(-5, 2))
        self._miss += float(miss[body].sum())
        self._pixels += int(body.sum())

    def best(self) -> dict[str, float]:
        """The temperature of each head."""
        found = {name: round(float(self.GRID[loss.argmin()]), 4) for name, loss in self._loss.items()}
        return found | {"surface": round(max(1.0, self._miss / max(self._pixels, 1)), 4)}
