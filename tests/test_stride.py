"""Stride frequencies from the self-similarity of silhouettes."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from slomo.pinhole import Intrinsics
from slomo.reconstruct.hypotheses import stride_frequencies

FPS, WIDTH, HEIGHT = 30.0, 96, 64


def seen(frequency: float, T: int = 90, *, seed: int = 0):
    """A body with a near pair of legs and a thinner far pair in the other phase: masks (T, 64 * 96), as observed."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    masks = np.zeros((T, HEIGHT, WIDTH), bool)
    for t in range(T):
        masks[t] = (np.abs(y - 20) < 10) & (np.abs(x - 48) < 34)
        for hip, phase, half in ((22, 0.0, 4), (22, 0.5, 2), (72, 0.5, 4), (72, 0.0, 2)):
            swing = 0.35 * np.sin(2 * np.pi * (frequency * t / FPS + phase)) + 0.02 * rng.normal()
            masks[t] |= (np.abs(x - hip - swing * (y - 28)) < half) & (y >= 28) & (y < 58)
    box = np.array([[np.flatnonzero(m.any(0)).min(), 10, np.flatnonzero(m.any(0)).max(), 57] for m in masks])
    return SimpleNamespace(
        dt=torch.full((T - 1,), 1 / FPS),
        K=Intrinsics(100.0, 100.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT),
        mask=torch.as_tensor(masks.reshape(T, -1)),
        box=box,
        empty=np.zeros(T, bool),
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("frequency", [1.2, 2.0, 2.5])
def test_a_fast_stride_is_not_taken_for_several(frequency, seed):
    """What two or three strides later looks most alike by chance is not the period."""
    found = stride_frequencies(seen(frequency, seed=seed), 0.45, 5.0)[:2]  # type: ignore[arg-type]
    assert min(abs(f / frequency - 1) for f in found) < 0.05


def test_frequencies_stay_within_the_range():
    found = stride_frequencies(seen(1.2), 0.9, 1.5)  # type: ignore[arg-type]
    assert found
    assert all(0.9 <= f <= 1.5 for f in found)
