"""Gaits laid over a body as it is, and which of them are worth a fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.reconstruct import hypotheses, pose_track
from slomo.reconstruct.hypotheses import GaitHypothesis, RootGuess
from slomo.reconstruct.problem import Problem, Variables, pick, rank
from slomo.reconstruct.run import Run, join
from slomo.reconstruct.stride import Steps, steps_of
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

SAME = math.radians(10.0)  # headings that differ by less are one
STAYS = 0.3  # body lengths: a person who never gets further from where they began takes no strides
AT_ONCE = 24  # gaits
SHORTLIST = 48  # of them that are ranked once more
NEXT = 1.5 / 12  # turns between a phase and those next to it, at most


@dataclass(frozen=True)
class Laid:
    """A gait over a body: the loss so far, the number of the heading that it is laid over, the gait, and both."""

    loss: float
    heading: int
    gait: GaitHypothesis
    guess: Guess


def tried(
    problem: Problem,
    run: Run,
    losses: torch.Tensor,
    root: RootGuess,
    *,
    candidates: int,
    phases: int,
    metres: float | None,
    trying: Callable[[str], None],
) -> Run:
    """Lay postures and gaits over the best heading (and another one when it is close), rank them as they are, keep the
    best few.

    Args:
        losses: (H,) of the headings.  candidates: hypotheses that are kept.  phases: tried of each gait.
        metres: body length m, for Froude numbers; None: not known.
        trying: told what is being done.
    """
    order = losses.argsort().tolist()
    away = turned(problem, run, order[0]).tolist()
    close = [k for k in order[1:] if losses[k] < 1.15 * losses[order[0]] and away[k] > SAME]
    keep = order[:1] + close[:1]
    skeleton, kin = problem.kin.skeleton, problem.kin
    speed = float(np.median(root.speed))
    found = steps(problem, root)
    grid = hypotheses.gait_grid(found, skeleton, leg=kin.leg, speed=speed, metres=metres, phases=phases)
    if skeleton.kind == "human" and root.travelled < STAYS:
        grid = []  # squats and jumping jacks are no strides
    run.log["stride_candidates_hz"] = sorted({round(g.frequency, 3) for g in grid})
    run.log["stride_clock_power"] = found.power
    known = {g.name: g for g in skeleton.gaits}

    def pose(g: GaitHypothesis) -> tuple[Array, Array]:
        t = problem.obs.t.numpy()
        return hypotheses.gait_pose(kin, known[g.name], g, t, clock=found.clock, speed=root.speed, leg=kin.leg)

    def tell(number: int) -> None:
        trying(f"trying {len(grid)} gaits: {number}")

    entries: list[Laid] = []
    postures, posture_names = hypotheses.posture_angles(kin)
    posed: list[Guess] = []
    for k in keep:
        one = torch.tensor([k])
        base = run.guess.pick(one)
        # In place of the posture it began with.
        if skeleton.kind == "human":
            track = pose_track.tracks(problem, pick(run.x, one), base, root, postures)[0]
            base = replace(base, q=torch.as_tensor(track.q, dtype=torch.float32)[None])
            best = int(track.postures.argmax())
        else:
            wide = base.pick(torch.zeros(len(postures), dtype=torch.long))
            guess = replace(wide, q=postures[:, None].expand(-1, wide.q.shape[1], -1, -1).contiguous())
            value = rank(problem, pick(run.x, one.expand(len(postures))), guess, draws=2, frames=12, pixels=200)
            base, best = guess.pick(value.argmin()[None]), int(value.argmin())
        run.labels[k] = run.labels[k] | {"posture": posture_names[best]}
        posed.append(base)
        entries += lay(problem, pick(run.x, one), k, base, grid, pose, tell)
    entries = ranked(problem, run.x, entries)
    chosen = diverse(entries, max(0, candidates - len(keep)))
    which = torch.tensor(keep + [e.heading for e in chosen])
    guesses = posed + [e.guess for e in chosen]
    labels = [run.labels[k] | {"gait": "none"} for k in keep]
    labels += [
        run.labels[e.heading]
        | {"gait": e.gait.name, "stride_hz": round(e.gait.frequency, 3), "phase": round(e.gait.phase, 3)}
        for e in chosen
    ]
    return Run(1, pick(run.x, which), join(guesses), labels, run.log)


def turned(problem: Problem, run: Run, one: int) -> torch.Tensor:
    """(H,) rad, by how much the heading of each hypothesis differs from that of `one`, the median over the clip."""
    with torch.no_grad():
        _, R, _ = problem.path(run.x, run.guess, run.x["shape.log_length"].exp(), problem.obs.at)
    ahead = torch.nn.functional.normalize(R[..., :2, 0], dim=-1)
    return torch.acos((ahead * ahead[one]).sum(-1).clamp(-1, 1)).median(1).values


def steps(problem: Problem, root: RootGuess) -> Steps:
    """The clip's rhythm."""
    # The speed of one who stays in place is noise.
    return steps_of(problem.obs, root.speed if root.travelled > 1 else np.ones_like(root.speed))


def lay(
    problem: Problem,
    x: Variables,
    heading: int,
    base: Guess,
    grid: Sequence[GaitHypothesis],
    pose: Callable[[GaitHypothesis], tuple[Array, Array]],
    each: Callable[[int], None],
) -> list[Laid]:
    """All gaits of a grid over one hypothesis.

    Args:
        x, base: of the hypothesis.
        pose: joint angles (T, B, 3) rad and contacts (T, L) of a gait.
        each: called with the number that are done.
    """
    f = lambda a: torch.as_tensor(np.stack(a), dtype=torch.float32)  # noqa: E731
    out = []
    for i in range(0, len(grid), AT_ONCE):
        part = grid[i : i + AT_ONCE]
        q, contact = zip(*(pose(g) for g in part), strict=True)
        same = torch.zeros(len(part), dtype=torch.long)
        guess = replace(base.pick(same), q=base.q + f(q), stance=f(contact))
        value = rank(problem, pick(x, same), guess, draws=1, frames=16, pixels=128)
        out += [
            Laid(float(v), heading, g, guess.pick(torch.tensor([n])))
            for n, (v, g) in enumerate(zip(value, part, strict=True))
        ]
        each(i)
    return out


def ranked(problem: Problem, x: Variables, entries: list[Laid]) -> list[Laid]:
    """The entries in order of their losses, the best of them once more with more draws: what is between one phase of a
    gait and the next is less than the noise of the few pixels that all are compared by, and from the wrong one of them
    the fit does not come back.

    Args:
        x: of all headings.
    """
    entries = sorted(entries, key=lambda e: e.loss)
    first = []
    for i in range(0, min(SHORTLIST, len(entries)), AT_ONCE):
        part = entries[i : min(i + AT_ONCE, SHORTLIST)]
        wide = pick(x, torch.tensor([e.heading for e in part]))
        value = rank(problem, wide, join([e.guess for e in part]), draws=2, frames=40)
        first += [replace(e, loss=float(v)) for v, e in zip(value, part, strict=True)]
    return sorted(first, key=lambda e: e.loss) + entries[SHORTLIST:]


def diverse(entries: list[Laid], count: int) -> list[Laid]:
    """The best entry of every gait, for what is laid over the body as it is may rank a wrong gait first in all its
    phases; then the best that differ in phase by a sixth, in frequency by a fifth, or in heading; and the best one's
    left-right opposite, so that a swap of the legs is always weighed against it, and the one whose phase is next to
    the best one's: laid over the clip the two are alike, and what is fitted from them is not."""

    def far(a: GaitHypothesis, b: GaitHypothesis) -> bool:
        return a.name != b.name or turn(a.phase, b.phase) > 1 / 6.5 or abs(math.log(a.frequency / b.frequency)) > 0.15

    firsts = {e.gait.name: e for e in reversed(entries)}
    out = sorted(firsts.values(), key=lambda e: e.loss)[:count]
    for e in entries:
        if len(out) == count:
            break
        if all(e.heading != o.heading or far(e.gait, o.gait) for o in out):
            out.append(e)
    if not out:
        return out
    best = out[0]
    others = [
        (turn(e.gait.phase, best.gait.phase), e) for e in entries
        if e.heading == best.heading and e.gait.name == best.gait.name and e.gait.frequency == best.gait.frequency
    ]  # fmt: skip
    near = [e for away, e in others if 1e-6 < away < NEXT]
    opposite = [e for away, e in others if abs(away - 0.5) < 1e-6]
    more = [found[0] for found in (near, opposite) if found]
    more = more[max(0, len(more) - count + 1) :]
    rest = [e for e in out if all(e is not m for m in more)]
    return rest[: count - len(more)] + more


def beside(labels: list[dict], strides: list[int]) -> list[int]:
    """Of the hypotheses `strides`, best first, which have a gait: the one that is the first but for a phase next to
    its own, if there is one."""

    def next_to(k: int) -> bool:
        own, best = labels[k], labels[strides[0]]
        same = all(own[key] == best[key] for key in ("heading", "gait", "stride_hz"))
        return same and turn(own["phase"], best["phase"]) < NEXT

    return [k for k in strides[1:] if next_to(k)][:1]


def turn(a: float, b: float) -> float:
    """By how much two phases of a stride differ, in turns: 0 to 0.5."""
    return abs((a - b + 0.5) % 1.0 - 0.5)
