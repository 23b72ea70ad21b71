"""Sizes of the neural model: one small set for minutes on a CPU, one as published for a GPU."""

from dataclasses import dataclass
from typing import Self

from slomo.errors import UsageError


@dataclass(frozen=True)
class FieldsConfig:
    """Sizes of the networks and of a rendering.

    Attributes:
        rays: drawn pixels that are rendered in one evaluation. samples: of the field along each. coarse: places along
            each at which the capsules say where the samples belong.
        sdf_layers, width: hidden layers of the signed distance network and their neurons. features: what it hands on
            to the colour network. frequencies: octaves of its positional encoding; the first has a period of two
            body lengths.
        delta_width: neurons of the delta-skinning network.
        background_width, background_frequencies: of the background model.
        beta: width of the surface's density at the start, body lengths.
        queried: samples of a ray, those with the largest weights, that are carried on for flow and cycle consistency.
    """

    rays: int = 512
    samples: int = 16
    coarse: int = 32
    sdf_layers: int = 3
    width: int = 48
    features: int = 16
    frequencies: int = 5
    delta_width: int = 24
    background_width: int = 64
    background_frequencies: int = 8
    beta: float = 0.006
    queried: int = 4

    def __post_init__(self):
        for name, value in vars(self).items():
            if value <= 0:
                raise UsageError(f"must be positive, is {value:g}", where=f"fields.{name}")
        if self.queried > self.samples:
            raise UsageError("must not exceed samples", where="fields.queried", valid=[f"1 ... {self.samples}"])

    @classmethod
    def published(cls) -> Self:
        """Networks and batches of the published pipeline (lab4d; Yang et al. 2023), for a GPU."""
        return cls(
            rays=4096, samples=64, coarse=64, sdf_layers=8, width=256, features=256, frequencies=10, delta_width=64,
            background_width=256, background_frequencies=8, queried=8,
        )  # fmt: skip
