"""What is preferred among hypotheses where the picture leaves it open: losses (H,) to compare them by."""

import torch

from slomo.reconstruct.hypotheses import RootGuess

Tensor = torch.Tensor

STEPS = 0.04  # share by which the loss without a gait must be lower over more than a body length
ALIKE = 0.01  # share by which the loss with strides that are alike may be higher
TURNS = 0.012  # share by which the loss with legs that overtake each other may be higher than with legs that do not
_SWINGS = {"limbs", "strides", "alike"}  # keys of who does as the first one does but for some swings
_BORROWED = {"alike", "again"}  # what they say of who does strides as others of them; not as the other side does


def steps(labels: list[dict], losses: Tensor, root: RootGuess) -> Tensor:
    """Somebody who travels takes steps: legs without a gait must look better by `STEPS`."""
    if root.travelled <= 1:
        return losses
    return losses * torch.tensor([1 + STEPS * (label["gait"] == "none") for label in labels])


def alike(labels: list[dict], losses: Tensor, key: str) -> Tensor:
    """Strides are alike, which labels say under `key`, rather than as the first one's. That tells nothing of rivals
    which differ from it by more than swings, by exchanged legs, say: to them the others are as good as the best."""
    favoured = losses * torch.tensor([1 - ALIKE * (label.get(key) in _BORROWED) for label in labels])
    differ = [{k for k in label.keys() | labels[0].keys() if label.get(k) != labels[0].get(k)} for label in labels]
    beside = torch.tensor([keys <= _SWINGS for keys in differ])
    least = lambda x: x[beside].nan_to_num(nan=torch.inf).min()  # noqa: E731
    return torch.where(beside, favoured - least(favoured) + least(losses), losses)


def turns(labels: list[dict], losses: Tensor, key: str) -> Tensor:
    """Feet of a pair take turns to be ahead, which labels say under `key`."""
    return losses * torch.tensor([1 - TURNS * (key in label) for label in labels])
