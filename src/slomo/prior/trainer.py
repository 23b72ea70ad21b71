"""A network under training: its config, one step, and all of its state as arrays."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from slomo.errors import UsageError
from slomo.prior.augment import AugmentConfig
from slomo.prior.dataset import Batch
from slomo.prior.labels import Labels
from slomo.prior.network import STRIDE, Network, NetworkConfig, network
from slomo.prior.objective import ObjectiveConfig, losses, total
from slomo.skeleton import list_skeletons


@dataclass(frozen=True)
class TrainConfig:
    """All that decides about the weights, beside the data.

    Attributes:
        kind: skeleton.
        steps, batch: how long; samples a step.
        size: px, side of the input.
        rate: highest learning rate.  warm: share of the steps until it is reached.  decay: of the weights.
        average: share of the averaged weights that a step leaves as it is.
        held_out: share of the shards to validate on.
    """

    kind: str = "quadruped"
    steps: int = 4000
    batch: int = 32
    size: int = 128
    seed: int = 0
    rate: float = 2.5e-3
    warm: float = 0.08
    decay: float = 0.02
    clip: float = 2.0
    average: float = 0.998
    held_out: float = 0.04
    network: NetworkConfig = field(default_factory=NetworkConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self):
        if self.kind not in list_skeletons():
            raise UsageError(f"no kind {self.kind!r}", where="train", valid=list_skeletons())
        if self.size % STRIDE or self.size < STRIDE:
            raise UsageError(f"size is {self.size}", where="train", valid=[f"multiples of {STRIDE}"])
        if min(self.steps, self.batch) < 1:
            raise UsageError("steps and batch must be 1 or more", where="train")


def learning_rate(step: int, config: TrainConfig) -> float:
    """Up along a line, down along a cosine to a hundredth."""
    at = (step + 1) / config.steps
    if at < config.warm:
        return config.rate * at / config.warm
    return config.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (at - config.warm) / (1 - config.warm))))


class Trainer:
    """A network with its optimiser and averaged weights, as a checkpoint holds them."""

    def __init__(self, known: Labels, config: TrainConfig):
        torch.manual_seed(config.seed)
        self.config = config
        self.network = network(known, config.network)
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        plain = [p for p in self.network.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": config.decay}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=config.rate, betas=(0.9, 0.99))
        self.average = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.step = 0
        self.rows: list[list[float]] = []  # of the log: step, rate, a loss a term; NaN or the same of held-out samples

    def train(self, batch: Batch, weights: torch.Tensor) -> dict[str, float]:
        """One step. Returns the losses."""
        rate = learning_rate(self.step, self.config)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.network.train()
        with torch.autocast("cpu", torch.bfloat16):
            out = self.network(batch.input)
        terms = losses(out, batch, weights, self.config.objective)
        self.optimiser.zero_grad(set_to_none=True)
        total(terms, self.config.objective).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        self.step += 1
        keep = min(self.config.average, self.step / (self.step + 10))
        for name, value in self.network.state_dict().items():
            mine = self.average[name]
            if mine.is_floating_point():
                mine.lerp_(value, 1 - keep)
            else:
                mine.copy_(value)
        return {k: float(v.detach()) for k, v in terms.items()}

    def averaged(self, known: Labels) -> Network:
        """The network with the averaged weights, for evaluation."""
        net = network(known, self.config.network)
        net.load_state_dict(self.average)
        return net.eval()

    def state(self) -> dict[str, np.ndarray]:
        """All of it as arrays."""
        out = {f"network/{k}": v.numpy() for k, v in self.network.state_dict().items()}
        out |= {f"average/{k}": v.numpy() for k, v in self.average.items()}
        for i, entry in self.optimiser.state_dict()["state"].items():
            out |= {f"optimiser/{i}/{k}": v.numpy() for k, v in entry.items()}
        return out | {"step": np.array(self.step), "rows": np.array(self.rows, float).reshape(len(self.rows), -1)}

    def load(self, state: Any) -> None:
        """Go back to where `state` was taken."""

        def part(name: str) -> dict[str, torch.Tensor]:
            return {k[len(name) :]: torch.tensor(v) for k, v in state.items() if k.startswith(name)}

        self.network.load_state_dict(part("network/"))
        self.average = part("average/")
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in part("optimiser/").items():
            number, name = key.split("/")
            entries.setdefault(int(number), {})[name] = value
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": entries})
        self.step, self.rows = int(state["step"]), state["rows"].tolist()
