"""Whether the subject is an animal on four legs or a person: whose network sees it more clearly."""

from pathlib import Path

import numpy as np

from slomo.prior.evidence import Shots, peaks
from slomo.prior.inference import Prior
from slomo.skeleton import USUAL

LOOKS = 12  # frames that are asked about, spread over the clip


def kind_of(folder: Path, shots: Shots) -> tuple[str, dict[str, float]]:
    """The kind of skeleton, and how clearly the network of each kind in the folder sees the subject: the mean
    probability, over frames and key points, that a key point is where it is likeliest. `USUAL` without any frame."""
    clear = {path.stem: _clearness(Prior(path), shots) for path in sorted(folder.glob("*.onnx"))}
    return max(clear, key=lambda kind: (clear[kind], kind == USUAL), default=USUAL), clear


def _clearness(prior: Prior, shots: Shots) -> float:
    if not len(shots.index):
        return 0.0
    looks = np.unique(np.linspace(0, len(shots.index) - 1, LOOKS).round().astype(int))
    seen = prior(np.stack([shots.crop(int(f), prior.size) for f in looks]))
    return float(peaks(seen.heat, seen.size)[1].mean())
