"""The network: from a masked crop to parts, canonical surface, key points, and the root view.

A residual encoder to 1/16 of the crop, self-attention there (left and right are decided by the whole figure, not by
a leg), and a decoder with skips (Ronneberger et al., MICCAI 2015) to 1/2 of it. What the pooled features say of the
whole is added to every place before the decoder. Plain 3x3 convolutions: on a CPU they are faster than separable ones.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from slomo.prior.labels import BINS, Labels

CHANNELS = 6  # of the input: colour, silhouette, motion
STRIDE = 32  # the input's side is a multiple


class Output(NamedTuple):
    """What the network says of N crops of S x S; `prior.export` gives them these names.

    Attributes:
        parts: (N, P+1, S/2, S/2) logits, background first.
        surface: (N, 4, S/2, S/2) canonical x, y, z (body lengths) and the logarithm of the scale of its Laplace error.
        heatmaps: (N, K, S/4, S/4) logits of where a key point is; a softmax over places.
        seen: (N, K) logits that it is visible.
        view: (N, 36) logits of azimuth bins.  up: (N, 3) of the body's up axis in the view frame, any length.
    """

    parts: Tensor
    surface: Tensor
    heatmaps: Tensor
    seen: Tensor
    view: Tensor
    up: Tensor


@dataclass(frozen=True)
class NetworkConfig:
    """Channels at 1/2, 1/4, 1/8 and 1/16 of the crop, and residual blocks at the last three; heads of the attention."""

    widths: tuple[int, int, int, int] = (32, 48, 80, 112)
    blocks: tuple[int, int, int] = (1, 1, 2)
    heads: int = 4


def _conv(c_in: int, c_out: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(c_out), nn.ReLU(inplace=True)
    )


class _Residual(nn.Module):
    def __init__(self, c: int):
        super().__init__()
        self.first = _conv(c, c)
        self.second = nn.Sequential(nn.Conv2d(c, c, 3, 1, 1, bias=False), nn.BatchNorm2d(c))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class _Attention(nn.Module):
    """Self-attention over places. The places themselves are given by the zero padding of the convolutions before."""

    def __init__(self, c: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.BatchNorm2d(c)
        self.qkv = nn.Conv2d(c, 3 * c, 1)
        self.out = nn.Conv2d(c, c, 1)

    def forward(self, x: Tensor) -> Tensor:
        n, c, h, w = x.shape
        q, k, v = self.qkv(self.norm(x)).reshape(n, 3, self.heads, c // self.heads, h * w).unbind(1)
        weight = torch.softmax(q.transpose(-1, -2) @ k * (c // self.heads) ** -0.5, -1)
        return x + self.out((v @ weight.transpose(-1, -2)).reshape(n, c, h, w))


def _larger(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


class Network(nn.Module):
    """Called with (N, 6, S, S), S a multiple of 32, as `crop.network_input` makes it; returns `Output`."""

    def __init__(self, keypoints: int, parts: int, config: NetworkConfig | None = None):
        super().__init__()
        config = config or NetworkConfig()
        a, b, c, d = config.widths
        self.parts, self.keypoints = parts, keypoints
        self.enc2 = _conv(CHANNELS, a, stride=2)
        self.enc4 = nn.Sequential(_conv(a, b, stride=2), *(_Residual(b) for _ in range(config.blocks[0])))
        self.enc8 = nn.Sequential(_conv(b, c, stride=2), *(_Residual(c) for _ in range(config.blocks[1])))
        self.enc16 = nn.Sequential(_conv(c, d, stride=2), *(_Residual(d) for _ in range(config.blocks[2])))
        self.attention = nn.Sequential(_Attention(d, config.heads), _Residual(d))
        self.whole = nn.Sequential(nn.Linear(2 * d, 2 * d), nn.ReLU(inplace=True))
        self.view = nn.Linear(2 * d, BINS)
        self.up = nn.Linear(2 * d, 3)
        self.seen = nn.Linear(2 * d, keypoints)
        self.spread = nn.Linear(2 * d, c)
        self.to8 = _conv(d, c, kernel=1)
        self.dec8 = nn.Sequential(_conv(c, c), _conv(c, c))
        self.to4 = _conv(c, b, kernel=1)
        self.dec4 = _Residual(b)
        self.heatmaps = nn.Conv2d(b, keypoints, 1)
        self.to2 = _conv(b, a, kernel=1)
        self.dec2 = _conv(a, a)
        self.dense = nn.Conv2d(a, parts + 1 + 4, 1)

    @property
    def parts_bias(self) -> Tensor:
        """(P+1,) what is added to the logits of parts everywhere; a view of the weights."""
        assert self.dense.bias is not None
        return self.dense.bias[: self.parts + 1]

    def forward(self, x: Tensor) -> Output:
        half = self.enc2(x)
        quarter = self.enc4(half)
        eighth = self.enc8(quarter)
        deep = self.attention(self.enc16(eighth))
        whole = self.whole(torch.cat([deep.mean((-2, -1)), deep.amax((-2, -1))], 1))
        up8 = self.dec8(_larger(self.to8(deep)) + eighth + self.spread(whole)[..., None, None])
        up4 = self.dec4(_larger(self.to4(up8)) + quarter)
        dense = self.dense(self.dec2(_larger(self.to2(up4)) + half))
        parts, surface = dense.split([self.parts + 1, 4], 1)
        return Output(parts, surface, self.heatmaps(up4), self.seen(whole), self.view(whole), self.up(whole))


def network(labels: Labels, config: NetworkConfig | None = None) -> Network:
    """The network of one kind of body, its weights laid out channels last, which convolutions on a CPU like."""
    made = Network(len(labels.keypoints), len(labels.parts), config)
    return made.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
