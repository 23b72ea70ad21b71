"""The fit, coarse to fine: size and trunk with headings, then gaits with the legs, then the rivals, then the winner,
and that once more beside those with limbs where they are seen better, alike strides, a leg that does as the other
one, or left and right exchanged. Then, only where there is something to compare it with, once more with alike strides
and with legs that overtake each other, of one pair and then of the other.

Every phase is one `optimise` of a batch of hypotheses; between phases they are ranked by loss on fixed draws and the
best go on. All of it is deterministic by the seed, and a checkpoint within any phase resumes to the same bits.
"""

from dataclasses import replace

import torch

from slomo.reconstruct import alike, gaits, hypotheses, limb_track, preferences, sides, starts
from slomo.reconstruct.effort import FINAL, LIMBS, PHASES, Effort
from slomo.reconstruct.hypotheses import RootGuess
from slomo.reconstruct.overtaking import overtaking
from slomo.reconstruct.problem import Problem, Schedule, Variables, optimise, pick, rank
from slomo.reconstruct.run import Run, checkpoint, join, restore
from slomo.reconstruct.trajectory import Guess
from slomo.stage import Progress

Tensor = torch.Tensor

TIE = 0.03  # a rival whose loss is higher by this share may still win in the end
TURNED = 0.1  # the same of one that faces the other way: short fits say little of that
ELSEWHERE = 0.1  # body lengths between the feet of two hypotheses that move their legs otherwise, on average
_MOTION = ("gait", "legs", "seen")
_ALIKE = {LIMBS: "strides", PHASES.index("alike"): "alike"}  # what labels say of those whose strides are alike
BEFORE = "before."  # prefix of the variables of the best one before a phase that comes after the limbs


def fit(
    problem: Problem, root: RootGuess, effort: Effort, *, metres: float | None, seed: int, progress: Progress
) -> Run:
    """Fit from the root path to the winner.

    Args:
        metres: body length m, for Froude numbers; None: not known.
        seed: of the draws and of the MLPs' first layers.
    """
    effort = _long_enough(effort, problem, root)
    generator = torch.Generator().manual_seed(seed)
    run, start, adam_state = restore(progress.load(), generator)
    if run is None:
        run = starts.start(problem, root, generator)
    while run.phase < len(PHASES):
        schedule = effort.schedules[run.phase]

        def each(i: int, optimiser: torch.optim.Adam, loss: Tensor, run=run, schedule=schedule) -> None:
            phase = PHASES[run.phase]
            fraction = effort.reached(run.log, phase, i / schedule.iterations)
            progress.update(fraction, f"{phase} {i}/{schedule.iterations}, loss {float(loss.min()):.3f}")
            if progress.checkpoint_due():
                progress.save(checkpoint(run, i, optimiser, generator))

        at = problem if run.phase >= LIMBS else sides.unsettled(problem)
        run.x = optimise(at, run.x, run.guess, schedule, generator, start=start, adam_state=adam_state, each=each)
        start, adam_state = 0, None
        judge = at if run.phase < FINAL or _front_or_back(run) else sides.doubting(at)
        losses = rank(judge, run.x, run.guess, draws=4 if run.phase < FINAL else 24)
        run.log[PHASES[run.phase]] = [
            label | {"loss": round(float(v), 4)} for label, v in zip(run.labels, losses, strict=True)
        ]
        step = _STEPS[run.phase]
        run = step(problem, run, losses, root, effort, metres, progress)
    return run


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


def _to_gait(
    problem: Problem,
    run: Run,
    losses: Tensor,
    root: RootGuess,
    effort: Effort,
    metres: float | None,
    progress: Progress,
) -> Run:
    """The best few of the gaits over the best headings."""
    done = effort.reached(run.log, "gait")
    return gaits.tried(
        problem, run, losses, root, candidates=effort.candidates, phases=effort.phases_of_gait, metres=metres,
        trying=lambda what: progress.update(done, what),
    )  # fmt: skip


def _to_rivals(problem: Problem, run: Run, losses: Tensor, root: RootGuess, *_) -> Run:
    """The two best go on; the best of another gait than the best one's, because a motion without a gait falls faster
    at first and less far; the one whose phase is next to the best gait's; the best one with its left and right legs
    exchanged (of a person who stays in place, turned around), because silhouettes hardly tell the two apart and none of
    the others need be its opposite; and the best one with limbs that are elsewhere for a while, where they would be
    seen better there."""
    order = losses.argsort().tolist()
    other = [k for k in order if run.labels[k]["gait"] != run.labels[order[0]]["gait"]]
    strides = [k for k in order if "phase" in run.labels[k]]
    which = torch.tensor(list(dict.fromkeys(order[:2] + other[:1] + gaits.beside(run.labels, strides))))
    best = which[:1]
    x, guess = pick(run.x, which), run.guess.pick(which)
    kind, own = problem.kin.skeleton.kind, (problem, pick(run.x, best), run.guess.pick(best))
    if _either_way(problem, root):
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
    losses = preferences.steps(run.labels, losses, root)
    order = losses.argsort().tolist()
    own = run.labels[order[0]]
    feet = sides.feet(problem, run.x, run.guess)
    away = (feet - feet[order[0]]).norm(dim=-1).mean((1, 2)).tolist()
    other = [k for k in order[1:] if away[k] > ELSEWHERE or any(run.labels[k].get(w) != own.get(w) for w in _MOTION)]
    limit = {k: TIE if run.labels[k].get("seen") == own.get("seen") else TURNED for k in other}
    which = torch.tensor(order[:1] + [k for k in other if losses[k] < (1 + limit[k]) * losses[order[0]]][:1])
    return Run(3, pick(run.x, which), run.guess.pick(which), [run.labels[int(k)] for k in which], run.log)


def _by_picture(problem: Problem, run: Run) -> Tensor:
    """(H,) losses to compare by, which the log gets as well: networks are not asked whose leg it is that overtakes."""
    losses = rank(sides.doubting(problem, 0.0), run.x, run.guess, draws=24)
    for entry, value in zip(run.log[PHASES[run.phase]], losses, strict=True):
        entry["picture"] = round(float(value), 4)
    return losses


def _either_way(problem: Problem, root: RootGuess) -> bool:
    """Whether it is a person who stays in place: no path says whether they face the camera or turn their back to it."""
    return problem.kin.skeleton.kind == "human" and root.travelled <= 1


def _long_enough(effort: Effort, problem: Problem, root: RootGuess) -> Effort:
    """The phase limbs is as long as the one before for who may be turned around: a third of it says little of that."""
    schedules = list(effort.schedules)
    if not (_either_way(problem, root) and schedules[LIMBS].iterations):
        return effort
    schedules[LIMBS] = schedules[FINAL]
    return replace(effort, schedules=tuple(schedules))


def _front_or_back(run: Run) -> bool:
    """Whether a person is compared with one who is turned around: there the picture tells little."""
    return len({label.get("seen") for label in run.labels}) > 1


def _to_limbs(problem: Problem, run: Run, losses: Tensor, root: RootGuess, effort: Effort, *_) -> Run:
    """The best one goes on, beside it with limbs that are where they are seen better by now, where any are and there is
    time for it, with a leg that does as the other one of its pair, and with a pair of legs exchanged where that is
    hardly worse; of a person who stays in place turned around once more, and with limbs kept apart that change places.
    """
    best = _winner(run, preferences.steps(run.labels, losses, root))
    rivals = [(best.x, best.guess)]
    labels = list(best.labels)
    if effort.schedules[LIMBS].iterations:
        if problem.kin.skeleton.kind == "quadruped":
            found = limb_track.by_limb(problem, best.x, best.guess, leave=limb_track.LIKELY)
            if found is not None:
                rivals.append(found)
                labels.append(labels[0] | {"limbs": "on their own"})
        if (found := _borrowed(problem, run, labels[0], rivals[-1], root)) is not None:
            rivals.append(found)
            labels.append(labels[-1] | {"strides": "alike"})
        if (found := _borrowed(problem, run, labels[0], rivals[0], root, alike.as_the_other)) is not None:
            rivals.append(found)
            labels.append(labels[0] | {"limbs": "as the other side's"})
        more = [("exchanged", *rival) for rival in sides.exchanged_pairs(problem, best.x, best.guess)]
        if _either_way(problem, root):
            more.append(("seen", "the other way", *hypotheses.turned_around(problem, best.x, best.guess)))
            more += [("apart", *rival) for rival in sides.kept_apart(problem, best.x, best.guess)]
        for key, name, x, guess in more:
            rivals.append((x, guess))
            labels.append(labels[0] | {key: name})
    x = {k: torch.cat([x[k] for x, _ in rivals]) for k in best.x}
    return Run(run.phase + 1, x, join([guess for _, guess in rivals]), labels, run.log)


def _borrowed(
    problem: Problem, run: Run, label: dict, motion: tuple[Variables, Guess], root: RootGuess, how=alike.borrowed
) -> tuple[Variables, Guess] | None:
    """A motion with its strides done as others of them (or what else of `alike`), of who strides."""
    if label["gait"] == "none" and root.travelled <= 1:
        return None
    hz = [label["stride_hz"]] if "stride_hz" in label else run.log["stride_candidates_hz"]
    return how(problem, *motion, clock=gaits.steps(problem, root).clock, frequencies=hz)


def _to_alike(problem: Problem, run: Run, losses: Tensor, root: RootGuess, effort: Effort, *_) -> Run:
    """The best one goes on beside itself with alike strides, which show more of it once the limbs have been fitted, and
    with a leg that does as the other one of its pair."""
    best = _winner(run, preferences.alike(run.labels, losses, _ALIKE[run.phase]))
    rivals = []
    if effort.schedules[PHASES.index("alike")].iterations:
        for name, how in (("again", alike.borrowed), ("as the other side's", alike.as_the_other)):
            if (found := _borrowed(problem, best, best.labels[0], (best.x, best.guess), root, how)) is not None:
                rivals.append((name, *found))
    return _beside(best, "alike", rivals) if rivals else _overtaking(problem, best, root, effort)


def _to_overtaking(problem: Problem, run: Run, losses: Tensor, root: RootGuess, effort: Effort, *_) -> Run:
    return _overtaking(
        problem, _as_it_was(_winner(run, preferences.alike(run.labels, losses, _ALIKE[run.phase]))), root, effort
    )


def _overtaking(problem: Problem, best: Run, root: RootGuess, effort: Effort) -> Run:
    """Of who travels the best one goes on beside itself with the legs of a pair that overtake each other."""
    rivals = []
    if root.travelled > 1 and effort.schedules[-1].iterations:
        rivals = overtaking(problem, best.x, best.guess)
    return _beside(best, "overtaking", rivals) if rivals else replace(best, phase=len(PHASES))


def _to_the_other_pair(problem: Problem, run: Run, *_) -> Run:
    """Where one pair had changed names, the other one may have: the best one goes on beside itself with that one's
    legs, too, overtaking each other."""
    best = _in_turns(problem, run)
    rivals = overtaking(problem, best.x, best.guess) if "overtaking" in best.labels[0] else []
    return _beside(best, "the other pair", rivals) if rivals else replace(best, phase=len(PHASES))


def _to_the_end(problem: Problem, run: Run, *_) -> Run:
    return replace(_in_turns(problem, run), phase=len(PHASES))


def _in_turns(problem: Problem, run: Run) -> Run:
    return _as_it_was(_winner(run, preferences.turns(run.labels, _by_picture(problem, run), PHASES[run.phase])))


_STEPS = (
    _to_gait, _to_rivals, _to_final, _to_limbs, _to_alike, _to_overtaking, _to_the_other_pair, _to_the_end,
)  # fmt: skip


def _beside(best: Run, phase: str, rivals: list[tuple[str, Variables, Guess]]) -> Run:
    """The best one and its rivals, each with what its label says of it under the name of the phase."""
    x = {k: torch.cat([v, *(other[k] for _, other, _ in rivals)]) for k, v in best.x.items()}
    x |= {BEFORE + k: torch.cat([v] * (1 + len(rivals))) for k, v in best.x.items()}
    labels = best.labels + [best.labels[0] | {phase: name} for name, *_ in rivals]
    return Run(PHASES.index(phase), x, join([best.guess, *(g for *_, g in rivals)]), labels, best.log)


def _as_it_was(run: Run) -> Run:
    """The winner; where that is the one that was the best before, as it was then: it went on for comparison only, and
    shapes go on changing long after motions have settled."""
    before = {k.removeprefix(BEFORE): v for k, v in run.x.items() if k.startswith(BEFORE)}
    now = {k: v for k, v in run.x.items() if not k.startswith(BEFORE)}
    return replace(run, x=now if PHASES[run.phase] in run.labels[0] else before)


def _winner(run: Run, losses: Tensor) -> Run:
    """The hypothesis of least loss; the log of the phase has them in the order of their losses."""
    order = losses.argsort()
    phase = PHASES[run.phase]
    run.log[phase] = [run.log[phase][int(k)] for k in order]
    best = order[:1]
    return Run(run.phase, pick(run.x, best), run.guess.pick(best), [run.labels[int(best)]], run.log)
