"""Networks of the fields as plain variables with a leading axis of 1: signed distance residual, colour, delta skinning.

All names begin with `F.`, so that the optimiser and the checkpoints of the fit take them along.
"""

import math

import torch

from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.trajectory import mlp, mlp_variables

Tensor = torch.Tensor
Variables = dict[str, Tensor]

PREFIX = "F."


def encode(x: Tensor, frequencies: int) -> Tensor:
    """(N, D (1 + 2 K)): x (N, D) itself and sin, cos of pi 2^k x, k < K (Mildenhall et al. 2020, eq. 4)."""
    octave = math.pi * 2.0 ** torch.arange(frequencies, device=x.device)
    phase = (x[:, None] * octave[:, None]).flatten(1)
    return torch.cat([x, torch.sin(phase), torch.cos(phase)], 1)


def encoded(dimensions: int, frequencies: int) -> int:
    """Columns of `encode`."""
    return dimensions * (1 + 2 * frequencies)


def variables(config: FieldsConfig, *, capsules: int, joints: int, generator: torch.Generator) -> Variables:
    """Everything the fields learn, each with a leading axis of 1.

    The residual of the distance, the delta of the skinning and the colours' last layers start at zero: the first
    surface is the union of the capsules, grey, and moves with its bones.
    """
    c = config
    hidden = (c.width,) * c.sdf_layers
    out = mlp_variables("F.sdf", (encoded(3, c.frequencies), *hidden, 1 + c.features), 1, generator)
    # Only the distance starts at zero; the features for the colour network must not.
    last = f"F.sdf.w{c.sdf_layers}"
    out[last][..., 1:] = torch.randn(c.width, c.features, generator=generator) / math.sqrt(c.width)
    out |= mlp_variables("F.colour", (c.features + encoded(3, 3), c.width, 3), 1, generator)
    out |= mlp_variables("F.delta", (encoded(3, 2), c.delta_width, capsules), 1, generator)
    out["F.delta.pose"] = 0.1 * torch.randn(1, 3 * joints, c.delta_width, generator=generator)
    wide = (c.background_width,) * 2
    ground = 2 * encoded(2, c.background_frequencies) + encoded(3, 2) + 1
    out |= mlp_variables("F.background", (ground, *wide, 3), 1, generator)
    out["F.beta"] = torch.full((1,), math.log(c.beta))
    return out


def residual(v: Variables, x: Tensor, frequencies: int) -> tuple[Tensor, Tensor]:
    """What is added to the capsules' distance at canonical points x (N, 3), (N,) body lengths; features (N, D)."""
    y = mlp(v, "F.sdf", encode(x, frequencies))[0]
    return 0.1 * y[:, 0], y[:, 1:]


def colour(v: Variables, x: Tensor, features: Tensor) -> Tensor:
    """(N, 3) sRGB in [0, 1] at canonical points x (N, 3)."""
    return torch.sigmoid(mlp(v, "F.colour", torch.cat([torch.nn.functional.silu(features), encode(x, 3)], 1))[0])


def delta(v: Variables, x: Tensor, pose: Tensor) -> Tensor:
    """(..., n, C) added to the logits of the skinning at x (..., n, 3), body lengths in the root's frame.

    Args:
        pose: (..., 3 (B - 1)) joint angles over their spread, rad; zeros at rest.
    """
    y = torch.nn.functional.linear(encode(x.flatten(0, -2), 2), v["F.delta.w0"][0].T, v["F.delta.b0"][0, 0])
    y = y.reshape(*x.shape[:-1], y.shape[-1]) + (pose @ v["F.delta.pose"][0])[..., None, :]
    return torch.nn.functional.silu(y) @ v["F.delta.w1"][0] + v["F.delta.b1"][0]
