"""Where a fit stands between two iterations, and its checkpoint."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch

from slomo.reconstruct.problem import Variables
from slomo.reconstruct.trajectory import Guess
from slomo.stage import Arrays

Tensor = torch.Tensor


@dataclass
class Run:
    """Where a fit stands; all of it is in a checkpoint.

    Attributes:
        phase: index into `fit.PHASES`. x, guess: of its H hypotheses. labels: what each hypothesis is.
        log: what was decided so far, for the report.
    """

    phase: int
    x: Variables
    guess: Guess
    labels: list[dict]
    log: dict = field(default_factory=dict)

    @property
    def loss(self) -> float:
        """Of the winner, once there is one."""
        best = {phase: self.log[phase][0] for phase in ("the other pair", "overtaking", "alike") if phase in self.log}
        return next((b["loss"] for phase, b in best.items() if phase in b), self.log["limbs"][0]["loss"])


def as_arrays(run: Run) -> dict[str, np.ndarray]:
    """Everything of a run, as an artifact or a checkpoint holds it."""
    out = {f"x.{k}": v.detach().cpu().numpy().copy() for k, v in run.x.items()}
    out |= {f"guess.{f.name}": getattr(run.guess, f.name).numpy() for f in fields(Guess)}
    meta = dict(phase=run.phase, labels=run.labels, log=run.log)
    return out | {"meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)}


def from_arrays(arrays: Arrays) -> Run:
    """The inverse of `as_arrays`."""
    tensor = lambda a: torch.from_numpy(np.array(a))  # noqa: E731
    meta = json.loads(bytes(np.asarray(arrays["meta"])))
    x = {k[2:]: tensor(v) for k, v in arrays.items() if k.startswith("x.")}
    guess = Guess(**{f.name: tensor(arrays[f"guess.{f.name}"]) for f in fields(Guess)})
    return Run(meta["phase"], x, guess, meta["labels"], meta["log"])


def join(guesses: Sequence[Guess]) -> Guess:
    """The hypotheses of several guesses as one."""
    return Guess(**{f.name: torch.cat([getattr(g, f.name) for g in guesses]) for f in fields(Guess)})


def checkpoint(
    run: Run, iteration: int, optimiser: torch.optim.Adam, generator: torch.Generator
) -> dict[str, np.ndarray]:
    """Everything that `restore` needs to go on to the same bits."""
    out = as_arrays(run)
    for n, s in optimiser.state_dict()["state"].items():
        out |= {f"adam.{n}.{k}": v.cpu().numpy().copy() for k, v in s.items()}
    out["iteration"] = np.array(iteration)
    out["rng"] = generator.get_state().numpy()
    return out


def restore(saved: Arrays | None, generator: torch.Generator) -> tuple[Run | None, int, dict | None]:
    """Run, iteration and Adam's moments from a checkpoint; the generator is set to where it was."""
    if saved is None:
        return None, 0, None
    generator.set_state(torch.from_numpy(np.array(saved["rng"])))
    state: dict[int, dict] = {}
    for k, v in saved.items():
        if k.startswith("adam."):
            _, n, name = k.split(".")
            state.setdefault(int(n), {})[name] = torch.from_numpy(np.array(v))
    return from_arrays(saved), int(saved["iteration"]), state
