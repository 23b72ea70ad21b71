"""The fit, coarse to fine: size and trunk with headings, then gaits with the legs, then the rivals, then the winner,
and that once more beside one whose limbs are where they are seen better.

Every phase is one `optimise` of a batch of hypotheses; between phases they are ranked by loss on fixed draws and the
best go on. All of it is deterministic by the seed, and a checkpoint within any phase resumes to the same bits.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.reconstruct import hypotheses, limb_track, pose_track, starts
from slomo.reconstruct.hypotheses import GaitHypothesis, RootGuess
from slomo.reconstruct.problem import Problem, Schedule, Variables, optimise, pick, rank
from slomo.reconstruct.run import Run, checkpoint, join, restore
from slomo.reconstruct.stride import steps_of
from slomo.reconstruct.trajectory import Guess
from slomo.stage import Progress

Tensor = torch.Tensor

TIE = 0.03  # a rival whose loss is higher by this share may still win in the end
TURNED = 0.1  # the same of one that faces the other way: short fits say little of that
STEPS = 0.04  # share by which the loss without a gait must be lower over more than a body length
ELSEWHERE = 0.1  # body lengths between the feet of two hypotheses that move their legs otherwise, on average
CHUNK = 24  # gaits at a time
SHORTLIST = 48  # of them that are ranked once more
_MOTION = ("gait", "legs", "seen")
PHASES = ("heading", "gait", "rivals", "final", "limbs")
FINAL = PHASES.index("final")  # from there on little is between two hypotheses, and many draws tell them apart

Entry = tuple[float, int, GaitHypothesis, Guess]  # loss, number of the heading that it is laid over, gait, and both


@dataclass(frozen=True)
class Effort:
    """How much work each phase does (`FitConfig` says it in the user's terms)."""

    schedules: tuple[Schedule, ...]
    candidates: int
    phases_of_gait: int


def fit(
    problem: Problem, root: RootGuess, effort: Effort, *, metres: float | None, seed: int, progress: Progress
) -> Run:
    """Fit from the root path to the winner.

    Args:
        metres: body length m, for Froude numbers; None: not known.
        seed: of the draws and of the MLPs' first layers.
    """
    generator = torch.Generator().manual_seed(seed)
    run, start, adam_state = restore(progress.load(), generator)
    if run is None:
        run = starts.start(problem, root, generator)
    total = total_cost(effort)
    while True:
        schedule = effort.schedules[run.phase]
        done = sum(s.iterations * _cost(s) for s in effort.schedules[: run.phase])

        def each(i: int, optimiser: torch.optim.Adam, loss: Tensor, run=run, schedule=schedule, done=done) -> None:
            fraction = (done + i * _cost(schedule)) / total
            progress.update(fraction, f"{PHASES[run.phase]} {i}/{schedule.iterations}, loss {float(loss.min()):.3f}")
            if progress.checkpoint_due():
                progress.save(checkpoint(run, i, optimiser, generator))

        run.x = optimise(
            problem, run.x, run.guess, schedule, generator, start=start, adam_state=adam_state, each=each
        )  # fmt: skip
        start, adam_state = 0, None
        losses = rank(problem, run.x, run.guess, draws=4 if run.phase < FINAL else 24)
        run.log[PHASES[run.phase]] = [
            label | {"loss": round(float(v), 4)} for label, v in zip(run.labels, losses, strict=True)
        ]
        if run.phase == len(PHASES) - 1:
            return _winner(run, losses)
        step = (_to_gait, _to_rivals, _to_final, _to_limbs)[run.phase]
        run = step(problem, run, losses, root, effort, metres, progress)


def polish(problem: Problem, run: Run, schedule: Schedule, *, seed: int, progress: Progress) -> Run:
    """One hypothesis from where it stands, without a search."""
    generator = torch.Generator().manual_seed(seed)
    resumed, start, adam_state = restore(progress.load(), generator)
    run = resumed or run

    def each(i: int, optimiser: torch.optim.Adam, loss: Tensor) -> None:
        progress.update(i / schedule.iterations, f"together {i}/{schedule.iterations}, loss {float(loss.min()):.3f}")
        if progress.checkpoint_due():
            progress.save(checkpoint(run, i, optimiser, generator))

    run.x = optimise(
        problem, run.x, run.guess, schedule, generator, start=start, adam_state=adam_state, each=each
    )  # fmt: skip
    label = run.labels[0] | {"loss": round(float(rank(problem, run.x, run.guess)[0]), 4)}
    run.log["together"] = [label]
    return run


def _cost(schedule: Schedule) -> float:
    return schedule.frames * schedule.pixels + 2000


def total_cost(effort: Effort) -> float:
    return sum(s.iterations * _cost(s) for s in effort.schedules)


def _to_gait(
    problem: Problem,
    run: Run,
    losses: Tensor,
    root: RootGuess,
    effort: Effort,
    metres: float | None,
    progress: Progress,
) -> Run:
    """Lay postures and gaits over the best heading (two when close), rank them as they are, keep the best few."""
    order = losses.argsort()
    keep = [int(order[0])]
    keep += [int(k) for k in order[1:2] if losses[k] < 1.15 * losses[order[0]]]
    skeleton, kin, obs = problem.kin.skeleton, problem.kin, problem.obs
    speed = float(np.median(root.speed))
    # The speed of one who stays in place is noise.
    steps = steps_of(obs, root.speed if root.travelled > 1 else np.ones_like(root.speed))
    grid = hypotheses.gait_grid(steps, skeleton, leg=kin.leg, speed=speed, metres=metres, phases=effort.phases_of_gait)
    run.log["stride_candidates_hz"] = sorted({round(g.frequency, 3) for g in grid})
    run.log["stride_clock_power"] = steps.power
    t = obs.t.numpy()
    entries: list[Entry] = []
    gaits = {g.name: g for g in skeleton.gaits}
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
        for i in range(0, len(grid), CHUNK):
            chunk = grid[i : i + CHUNK]
            poses = [
                hypotheses.gait_pose(kin, gaits[g.name], g, t, clock=steps.clock, speed=root.speed, leg=kin.leg)
                for g in chunk
            ]
            guess = _lay(base, poses)
            value = rank(problem, pick(run.x, one.expand(len(chunk))), guess, draws=1, frames=16, pixels=128)
            entries += [
                (float(v), k, g, guess.pick(torch.tensor([n])))
                for n, (v, g) in enumerate(zip(value, chunk, strict=True))
            ]
            done = effort.schedules[0].iterations * _cost(effort.schedules[0])
            progress.update(done / total_cost(effort), f"trying {len(grid)} gaits: {i}")
    entries = _ranked(problem, run.x, entries)
    chosen = _diverse(entries, max(0, effort.candidates - len(keep)))
    which = torch.tensor(keep + [k for _, k, _, _ in chosen])
    guesses = posed + [g for *_, g in chosen]
    labels = [run.labels[k] | {"gait": "none"} for k in keep]
    labels += [
        run.labels[k] | {"gait": g.name, "stride_hz": round(g.frequency, 3), "phase": round(g.phase, 3)}
        for _, k, g, _ in chosen
    ]
    return Run(1, pick(run.x, which), join(guesses), labels, run.log)


def _ranked(problem: Problem, x: Variables, entries: list[Entry]) -> list[Entry]:
    """The entries in order of their losses, the best of them once more with more draws: what is between one phase of a
    gait and the next is less than the noise of the few pixels that all are compared by, and from the wrong one of them
    the fit does not come back."""
    entries = sorted(entries, key=lambda e: e[0])
    first = []
    for i in range(0, min(SHORTLIST, len(entries)), CHUNK):
        part = entries[i : min(i + CHUNK, SHORTLIST)]
        wide = pick(x, torch.tensor([k for _, k, _, _ in part]))
        value = rank(problem, wide, join([guess for *_, guess in part]), draws=2, frames=40)
        first += [(float(v), *entry[1:]) for v, entry in zip(value, part, strict=True)]
    return sorted(first, key=lambda e: e[0]) + entries[SHORTLIST:]


def _lay(base: Guess, poses: list[tuple[np.ndarray, np.ndarray]]) -> Guess:
    f = lambda x: torch.as_tensor(np.stack(x), dtype=torch.float32)  # noqa: E731
    n = len(poses)
    wide = base.pick(torch.zeros(n, dtype=torch.long))
    return replace(wide, q=base.q + f([q for q, _ in poses]), stance=f([c for _, c in poses]))


def _diverse(entries: list[Entry], count: int) -> list[Entry]:
    """The best entry of every gait, for what is laid over the body as it is may rank a wrong gait first in all its
    phases; then the best that differ in phase by a sixth, in frequency by a fifth, or in heading; and the best one's
    left-right opposite, so that a swap of the legs is always weighed against it."""

    def far(a: GaitHypothesis, b: GaitHypothesis) -> bool:
        turn = abs((a.phase - b.phase + 0.5) % 1.0 - 0.5)
        return a.name != b.name or turn > 1 / 6.5 or abs(math.log(a.frequency / b.frequency)) > 0.15

    firsts = {e[2].name: e for e in reversed(entries)}
    out = sorted(firsts.values(), key=lambda e: e[0])[:count]
    for e in entries:
        if len(out) == count:
            break
        if all(e[1] != o[1] or far(e[2], o[2]) for o in out):
            out.append(e)
    if out:
        best = out[0]
        opposite = [
            e for e in entries
            if e[1] == best[1] and e[2].name == best[2].name and e[2].frequency == best[2].frequency
            and abs(abs(e[2].phase - best[2].phase) - 0.5) < 1e-6
        ]  # fmt: skip
        if opposite and all(o is not opposite[0] for o in out):
            out[-1 if len(out) == count else len(out) :] = opposite
    return out


def _to_rivals(problem: Problem, run: Run, losses: Tensor, root: RootGuess, *_) -> Run:
    """The two best go on; the best of another gait than the best one's, because a motion without a gait falls faster
    at first and less far; the best one with its left and right legs exchanged (of a person who stays in place, turned
    around), because silhouettes hardly tell the two apart and none of the others need be its opposite; and the best
    one with limbs that are elsewhere for a while, where they would be seen better there."""
    order = losses.argsort().tolist()
    other = [k for k in order if run.labels[k]["gait"] != run.labels[order[0]]["gait"]]
    which = torch.tensor(list(dict.fromkeys(order[:2] + other[:1])))
    best = which[:1]
    x, guess = pick(run.x, which), run.guess.pick(which)
    kind, own = problem.kin.skeleton.kind, (problem, pick(run.x, best), run.guess.pick(best))
    if kind == "human" and root.travelled <= 1:
        more = {("seen", "turned around"): hypotheses.turned_around(*own)}
    else:
        more = {("legs", "exchanged"): hypotheses.exchanged(*own)}
    if kind == "quadruped" and (found := limb_track.by_limb(*own, leave=limb_track.PLAINLY)) is not None:
        more["legs", "on their own"] = found
    x = {k: torch.cat([v, *(other[k] for other, _ in more.values())]) for k, v in x.items()}
    labels = [run.labels[int(k)] for k in which]
    labels += [labels[0] | {key: value} for key, value in more]
    return Run(2, x, join([guess, *(g for _, g in more.values())]), labels, run.log)


def _to_final(problem: Problem, run: Run, losses: Tensor, root: RootGuess, *_) -> Run:
    """The best one goes on, and with it the best that moves its legs otherwise if it is as good but for `TIE`: by what
    it was made of, or by where its feet are (one gait half a stride later is its left-right opposite). A person who is
    turned around may be worse by more (`TURNED`)."""
    losses = _stepping(run, losses, root)
    order = losses.argsort().tolist()
    own = run.labels[order[0]]
    away = _feet_apart(problem, run, order[0]).tolist()
    other = [k for k in order[1:] if away[k] > ELSEWHERE or any(run.labels[k].get(w) != own.get(w) for w in _MOTION)]
    limit = {k: TIE if run.labels[k].get("seen") == own.get("seen") else TURNED for k in other}
    which = torch.tensor(order[:1] + [k for k in other if losses[k] < (1 + limit[k]) * losses[order[0]]][:1])
    return Run(3, pick(run.x, which), run.guess.pick(which), [run.labels[int(k)] for k in which], run.log)


def _stepping(run: Run, losses: Tensor, root: RootGuess) -> Tensor:
    """(H,) losses to compare by. Somebody who travels takes steps: legs without a gait must look better by `STEPS`."""
    if root.travelled <= 1:
        return losses
    return losses * torch.tensor([1 + STEPS * (label["gait"] == "none") for label in run.labels])


def _feet_apart(problem: Problem, run: Run, one: int) -> Tensor:
    """(H,) mean distance of the feet of each hypothesis from those of `one`, body lengths."""
    with torch.no_grad():
        s = problem.state(run.x, run.guess, problem.draw(1, 2, torch.Generator().manual_seed(0)), stance_weight=0.0)
        feet = s.body.nodes[:, :, problem.kin.contacts]
        return (feet - feet[one]).norm(dim=-1).mean((1, 2)) / s.body.length[one]


def _to_limbs(problem: Problem, run: Run, losses: Tensor, root: RootGuess, effort: Effort, *_) -> Run:
    """The best one goes on, beside it with limbs that are where they are seen better by now, where any are and there is
    time for it."""
    best = _winner(run, _stepping(run, losses, root))
    found = None
    if problem.kin.skeleton.kind == "quadruped" and effort.schedules[-1].iterations:
        found = limb_track.by_limb(problem, best.x, best.guess, leave=limb_track.LIKELY)
    if found is None:
        return replace(best, phase=run.phase + 1)
    x = {k: torch.cat([v, found[0][k]]) for k, v in best.x.items()}
    labels = [*best.labels, best.labels[0] | {"limbs": "on their own"}]
    return Run(run.phase + 1, x, join([best.guess, found[1]]), labels, run.log)


def _winner(run: Run, losses: Tensor) -> Run:
    """The hypothesis of least loss; the log of the phase has them in the order of their losses."""
    order = losses.argsort()
    phase = PHASES[run.phase]
    run.log[phase] = [run.log[phase][int(k)] for k in order]
    best = order[:1]
    return Run(run.phase, pick(run.x, best), run.guess.pick(best), [run.labels[int(best)]], run.log)
