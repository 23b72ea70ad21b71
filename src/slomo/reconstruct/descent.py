"""The refinement of the coarse fit: coordinate descent of pose, fields and physics (PPR, Yang et al. 2023).

First the fields learn how the body and what is behind it look, with the pose as it is; then pose and fields together;
then, in rounds, the physics follows the pose, and the pose, with the fields frozen, is drawn towards what the physics
found. A step that makes the picture worse than it found it is undone: physics and fields refine, they do not outvote.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from slomo.reconstruct.fields import networks
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.device import CPU
from slomo.reconstruct.fields.terms import Fields
from slomo.reconstruct.physics import coupling
from slomo.reconstruct.physics.coupling import Physics
from slomo.reconstruct.physics.learn import PhysicsConfig
from slomo.reconstruct.problem import Problem, Schedule, Variables, optimise, rank
from slomo.reconstruct.run import Run, checkpoint, restore
from slomo.stage import Progress

Tensor = torch.Tensor

# Shape and tilt stay: a density is never quite sharp, and a body that is free to shrink makes up for it with its size.
POSE = ("Q", "G")
FIELDS = networks.PREFIX
PHYSICS, NOW = "physics.", "now."  # prefixes in a checkpoint: the physics' state; variables within a step
SURFACE = 6.0  # weight of the opacity while the pose is held, over that beside it: masks say more of skin than of bones
WORSE = 0.02  # a step is undone when the loss of the coarse fit's own terms rises by more than this share


@dataclass(frozen=True)
class Plan:
    """What is done, and for how long.

    Attributes:
        fields: sizes of the neural model; None: no fields. physics: None: no physics.
        appearance: iterations of the fields alone; joint: of fields and pose.
        rounds: of the physics, each followed by `render` iterations of the pose.
        rate: of the pose, as a share of the coarse fit's.
    """

    fields: FieldsConfig | None
    physics: PhysicsConfig | None
    appearance: int = 0
    joint: int = 0
    rounds: int = 0
    render: int = 0
    rate: float = 0.4

    def steps(self) -> list[str]:
        """Names of the steps, in order."""
        out = ["appearance", "fields"] if self.fields and self.joint else []
        return out + [f"round {n + 1}" for n in range(self.rounds if self.physics else 0)]


def descend(
    problem: Problem, run: Run, images: Tensor | None, plan: Plan, *, metres: float, seed: int, progress: Progress,
    device: torch.device = CPU,
) -> Run:  # fmt: skip
    """Refine the winner of the coarse fit.

    Args:
        images: (F, n, 3) colours of the fit frames for the fields (`fields.background.colours`).
        metres: wanted body length, for the physics. device: of the fields.

    Returns:
        The run with refined variables, those of the fields among them (prefix `F.`), and `log["refinement"]`.
    """
    generator = torch.Generator().manual_seed(seed)
    saved = progress.load()
    resumed, start, adam_state = restore(saved, generator)
    fields = None
    if plan.fields and images is not None:
        fields = Fields(plan.fields, problem.obs, problem.kin, images, device)
    physics = Physics(problem, metres, plan.physics) if plan.physics else None
    now: Variables = {}
    if resumed is not None and saved is not None:
        run = resumed
        now = {k.removeprefix(NOW): torch.from_numpy(np.array(v)) for k, v in saved.items() if k.startswith(NOW)}
        if physics:
            physics.restore({k.removeprefix(PHYSICS): v for k, v in saved.items() if k.startswith(PHYSICS)})
    else:
        x = run.x | (fields.variables(generator) if fields else {})
        run = Run(0, x, run.guess, run.labels, run.log | {"refinement": []})
    if fields:
        run, now = replace(run, x=fields.placed(run.x)), fields.placed(now)
    steps = plan.steps()
    while run.phase < len(steps):
        name = steps[run.phase]
        before = float(rank(problem, run.x, run.guess)[0])
        entry: dict[str, Any] = {"step": name, "loss_before": round(before, 4)}
        held = physics.arrays() if physics else {}  # a step that is resumed simulates anew from where it began
        progress.update(run.phase / len(steps), name)
        posed, schedule, about = _step(name, problem, run, fields, physics, plan)
        entry |= about

        x = now or {k: v.clone() for k, v in run.x.items()}

        def each(i: int, optimiser: torch.optim.Adam, loss: Tensor, run=run, schedule=schedule, held=held, x=x) -> None:
            done = (run.phase + i / schedule.iterations) / len(steps)
            progress.update(done, f"{steps[run.phase]} {i}/{schedule.iterations}, loss {float(loss.min()):.3f}")
            if progress.checkpoint_due():
                state = checkpoint(run, i, optimiser, generator)
                state |= {f"{NOW}{k}": v.detach().cpu().numpy().copy() for k, v in x.items()}
                progress.save(state | {f"{PHYSICS}{k}": v for k, v in held.items()})

        x = optimise(posed, x, run.guess, schedule, generator, start=start, adam_state=adam_state, each=each)
        start, adam_state, now = 0, None, {}
        after = float(rank(problem, x, run.guess)[0])
        kept = bool(np.isfinite(after) and after <= (1 + WORSE) * before)
        entry |= {"loss_after": round(after, 4), "kept": kept}
        run = Run(run.phase + 1, x if kept else run.x, run.guess, run.labels, run.log)
        run.log["refinement"] = [*run.log["refinement"], entry]
    return replace(run, x={k: v.cpu() for k, v in run.x.items()})


def _step(
    name: str, problem: Problem, run: Run, fields: Fields | None, physics: Physics | None, plan: Plan
) -> tuple[Problem, Schedule, dict[str, Any]]:
    """The problem and the schedule of one step, and what there is to say about it."""
    terms = dict(problem.terms)
    own = fields.terms() if fields else {}
    if name == "appearance":
        weights = {**problem.weights, "opacity": SURFACE * problem.weights.get("opacity", 0.0)}
        return replace(problem, terms=own, weights=weights), Schedule(plan.appearance, 48, 300, (FIELDS,)), {}
    if name == "fields":
        learn = (*POSE, FIELDS)
        return replace(problem, terms=terms | own), Schedule(plan.joint, 48, 300, learn, rate=plan.rate), {}
    assert physics is not None
    simulated, unit = physics.round(run.x, run.guess)
    terms |= own | {"physics": coupling.term(simulated, unit, problem)}
    return (
        replace(problem, terms=terms),
        Schedule(plan.render, 48, 300, POSE, rate=plan.rate),
        {"physics": simulated.report},
    )
