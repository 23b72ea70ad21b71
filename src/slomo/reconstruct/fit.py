"""The fit, coarse to fine: size and trunk with headings, then gaits with the legs, then the rivals, then the winner.

Every phase is one `optimise` of a batch of hypotheses; between phases they are ranked by loss on fixed draws and the
best go on. All of it is deterministic by the seed, and a checkpoint within any phase resumes to the same bits.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.reconstruct import hypotheses, limb_track, pose_track
from slomo.reconstruct.hypotheses import GaitHypothesis, RootGuess
from slomo.reconstruct.problem import Problem, Schedule, Variables, optimise
from slomo.reconstruct.run import Run, checkpoint, join, restore
from slomo.reconstruct.trajectory import Guess
from slomo.stage import Progress

Tensor = torch.Tensor

TIE = 0.03  # a rival whose loss is higher by this share may still win in the end
PHASES = ("heading", "gait", "rivals", "final")


@dataclass(frozen=True)
class Effort:
    """How much work each phase does (`FitConfig` says it in the user's terms)."""

    schedules: tuple[Schedule, ...]
    candidates: int
    phases_of_gait: int


def fit(problem: Problem, root: RootGuess, effort: Effort, *, metres: float, seed: int, progress: Progress) -> Run:
    """Fit from the root path to the winner.

    Args:
        metres: wanted body length m, for Froude numbers.
        seed: of the draws and of the MLPs' first layers.
    """
    generator = torch.Generator().manual_seed(seed)
    run, start, adam_state = restore(progress.load(), generator)
    if run is None:
        run = _start(problem, root, generator)
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
        losses = rank(problem, run.x, run.guess)
        run.log[PHASES[run.phase]] = [
            label | {"loss": round(float(v), 4)} for label, v in zip(run.labels, losses, strict=True)
        ]
        if run.phase == len(PHASES) - 1:
            order = losses.argsort()
            run.log["final"] = [run.log["final"][int(k)] for k in order]
            best = order[:1]
            return Run(run.phase, _pick(run.x, best), run.guess.pick(best), [run.labels[int(best)]], run.log)
        run = (_to_gait, _to_rivals, _to_final)[run.phase](problem, run, losses, root, effort, metres, progress)


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


def _start(problem: Problem, root: RootGuess, generator: torch.Generator) -> Run:
    """Every heading with the size and the posture that fit the masks best as they are: a raised tail or a lowered head
    changes the height from which the size was guessed, and a raised tail looks like a neck."""
    if problem.kin.skeleton.kind == "human":
        return _start_tracked(problem, root, generator)
    postures, posture_names = hypotheses.posture_angles(problem.kin)
    n = len(postures)
    tried: list[tuple[Tensor, list[Guess], list[dict]]] = []
    sizes = (1.0, 0.8)
    one = problem.variables(1, generator)
    said = hypotheses.said_headings(problem.obs, problem.said, root)
    for size in sizes:
        scaled = replace(root, length=root.length * size)
        guess, names = hypotheses.heading_guess(problem.kin, scaled, len(problem.obs.t), said)
        x = _pick(one, torch.zeros(n, dtype=torch.long))
        x["shape.log_length"] += math.log(scaled.length)
        values, guesses, labels = [], [], []
        for k, name in enumerate(names):
            wide = guess.pick(torch.full((n,), k))
            posed = replace(wide, q=wide.q + postures[:, None])
            value = rank(problem, x, posed, draws=1, frames=12, pixels=128)
            values.append(value.min())
            guesses.append(posed.pick(value.argmin()[None]))
            labels.append({"heading": name, "size": size, "posture": posture_names[int(value.argmin())]})
        tried.append((torch.stack(values), guesses, labels))
    best = torch.stack([v for v, _, _ in tried]).argmin(0).tolist()
    x = _pick(one, torch.zeros(len(best), dtype=torch.long))
    x["shape.log_length"] += torch.tensor([math.log(root.length * sizes[b]) for b in best])
    return Run(0, x, join([tried[b][1][k] for k, b in enumerate(best)]), [tried[b][2][k] for k, b in enumerate(best)])


def _start_tracked(problem: Problem, root: RootGuess, generator: torch.Generator) -> Run:
    """Paths through headings and postures that suit the silhouettes best, mostly seen from the front and from behind,
    one as the view is said to be, and one that faces the way of travel; each with two sizes."""
    postures, posture_names = hypotheses.posture_angles(problem.kin)
    one = problem.variables(1, generator)
    T, ring = len(problem.obs.t), tuple(2 * math.pi * n / pose_track.HEADINGS for n in range(pose_track.HEADINGS))
    guesses, labels, lengths = [], [], []
    for size in (1.0, 0.85):
        scaled = replace(root, length=root.length * size)
        x = _pick(one, torch.zeros(1, dtype=torch.long))
        x["shape.log_length"] += math.log(scaled.length)
        any_way = hypotheses.placed(problem.kin, scaled, np.zeros((1, T)))
        views: dict[str, pose_track.View] = {"front": pose_track.AWAY, "back": -pose_track.AWAY}
        if problem.said and "view" in problem.said.groups:
            views["view"] = problem.said
        found = pose_track.tracks(problem, x, any_way, scaled, postures, turns=ring, views=tuple(views.values()))
        kinds = list(views)
        if root.travelled > 0.7:
            travel = hypotheses.placed(problem.kin, scaled, root.heading[None])
            found += pose_track.tracks(problem, x, travel, scaled, postures)
            kinds += ["travel"]
        for kind, track in zip(kinds, found, strict=True):
            guess = hypotheses.placed(problem.kin, scaled, track.yaw[None])
            guesses.append(replace(guess, q=torch.as_tensor(track.q, dtype=torch.float32)[None]))
            posture = posture_names[int(track.postures.argmax())]
            labels.append({"heading": f"tracked, {kind}", "size": size, "posture": posture})
            lengths.append(math.log(scaled.length))
    x = _pick(one, torch.zeros(len(guesses), dtype=torch.long))
    x["shape.log_length"] += torch.tensor(lengths)
    return Run(0, x, join(guesses), labels)


def total_cost(effort: Effort) -> float:
    return sum(s.iterations * _cost(s) for s in effort.schedules)


def rank(
    problem: Problem, x: Variables, guess: Guess, *, draws: int = 4, frames: int = 32, pixels: int = 256
) -> Tensor:
    """(H,) loss on draws that are the same for every call."""
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        parts = [problem.loss(x, guess, problem.draw(frames, pixels, generator))[0] for _ in range(draws)]
    return torch.stack(parts).mean(0)


def _pick(x: Variables, which: Tensor) -> Variables:
    return {k: v[which].clone() for k, v in x.items()}


def _to_gait(
    problem: Problem, run: Run, losses: Tensor, root: RootGuess, effort: Effort, metres: float, progress: Progress
) -> Run:
    """Lay postures and gaits over the best heading (two when close), rank them as they are, keep the best few."""
    order = losses.argsort()
    keep = [int(order[0])]
    keep += [int(k) for k in order[1:2] if losses[k] < 1.15 * losses[order[0]]]
    skeleton, kin, obs = problem.kin.skeleton, problem.kin, problem.obs
    rest = skeleton.rest()
    leg = float(np.mean([rest[limb.swing, 2] - rest[limb.contact, 2] for limb in skeleton.limbs]))
    speed = float(np.median(root.speed))
    grid = hypotheses.gait_grid(obs, skeleton, leg=leg * metres, speed=speed * metres, phases=effort.phases_of_gait)
    run.log["stride_candidates_hz"] = sorted({round(g.frequency, 3) for g in grid})
    t = obs.t.numpy()
    entries: list[tuple[float, int, GaitHypothesis, Guess]] = []
    gaits = {g.name: g for g in skeleton.gaits}
    postures, posture_names = hypotheses.posture_angles(kin)
    posed: list[Guess] = []
    for k in keep:
        one = torch.tensor([k])
        base = run.guess.pick(one)
        # In place of the posture it began with.
        if skeleton.kind == "human":
            track = pose_track.tracks(problem, _pick(run.x, one), base, root, postures)[0]
            base = replace(base, q=torch.as_tensor(track.q, dtype=torch.float32)[None])
            best = int(track.postures.argmax())
        else:
            wide = base.pick(torch.zeros(len(postures), dtype=torch.long))
            guess = replace(wide, q=postures[:, None].expand(-1, wide.q.shape[1], -1, -1).contiguous())
            value = rank(problem, _pick(run.x, one.expand(len(postures))), guess, draws=2, frames=12, pixels=200)
            base, best = guess.pick(value.argmin()[None]), int(value.argmin())
        run.labels[k] = run.labels[k] | {"posture": posture_names[best]}
        posed.append(base)
        for i in range(0, len(grid), 24):
            chunk = grid[i : i + 24]
            poses = [hypotheses.gait_pose(kin, gaits[g.name], g, t, speed=root.speed, leg=leg) for g in chunk]
            guess = _lay(base, poses)
            value = rank(problem, _pick(run.x, one.expand(len(chunk))), guess, draws=1, frames=16, pixels=128)
            entries += [
                (float(v), k, g, guess.pick(torch.tensor([n])))
                for n, (v, g) in enumerate(zip(value, chunk, strict=True))
            ]
            done = effort.schedules[0].iterations * _cost(effort.schedules[0])
            progress.update(done / total_cost(effort), f"trying {len(grid)} gaits: {i}")
    entries.sort(key=lambda e: e[0])
    chosen = _diverse(entries, effort.candidates - len(keep))
    which = torch.tensor(keep + [k for _, k, _, _ in chosen])
    guesses = posed + [g for *_, g in chosen]
    labels = [run.labels[k] | {"gait": "none"} for k in keep]
    labels += [
        run.labels[k] | {"gait": g.name, "stride_hz": round(g.frequency, 3), "phase": round(g.phase, 3)}
        for _, k, g, _ in chosen
    ]
    return Run(1, _pick(run.x, which), join(guesses), labels, run.log)


def _lay(base: Guess, poses: list[tuple[np.ndarray, np.ndarray]]) -> Guess:
    f = lambda x: torch.as_tensor(np.stack(x), dtype=torch.float32)  # noqa: E731
    n = len(poses)
    wide = base.pick(torch.zeros(n, dtype=torch.long))
    return replace(wide, q=base.q + f([q for q, _ in poses]), stance=f([c for _, c in poses]))


def _diverse(entries: list, count: int) -> list:
    """The best entries that differ: in gait, in phase by a sixth, in frequency by a fifth, or in heading; and the best
    one's left-right opposite, so that a swap of the legs is always weighed against it."""

    def far(a: GaitHypothesis, b: GaitHypothesis) -> bool:
        turn = abs((a.phase - b.phase + 0.5) % 1.0 - 0.5)
        return a.name != b.name or turn > 1 / 6.5 or abs(math.log(a.frequency / b.frequency)) > 0.15

    out: list = []
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


def _to_rivals(problem: Problem, run: Run, losses: Tensor, *_) -> Run:
    """The two best go on; the best of another gait than the best one's, because a motion without a gait falls faster
    at first and less far; the best one with its left and right legs exchanged, because silhouettes hardly tell the
    two apart and none of the others need be its opposite; and the best one with limbs that are elsewhere for a while,
    where they would be seen better there."""
    order = losses.argsort().tolist()
    other = [k for k in order if run.labels[k]["gait"] != run.labels[order[0]]["gait"]]
    which = torch.tensor(list(dict.fromkeys(order[:2] + other[:1])))
    best = which[:1]
    x, guess = _pick(run.x, which), run.guess.pick(which)
    more = {"exchanged": hypotheses.exchanged(problem, _pick(run.x, best), run.guess.pick(best))}
    if problem.kin.skeleton.kind == "quadruped":
        found = limb_track.by_limb(problem, _pick(run.x, best), run.guess.pick(best))
        if found is not None:
            more["on their own"] = found
    x = {k: torch.cat([v, *(other[k] for other, _ in more.values())]) for k, v in x.items()}
    labels = [run.labels[int(k)] for k in which]
    labels += [labels[0] | {"legs": name} for name in more]
    return Run(2, x, join([guess, *(g for _, g in more.values())]), labels, run.log)


def _to_final(problem: Problem, run: Run, losses: Tensor, *_) -> Run:
    """The best one goes on, and with it the best that moves its legs otherwise if it is as good but for `TIE`."""
    order = losses.argsort().tolist()
    own = run.labels[order[0]]
    other = [k for k in order if any(run.labels[k].get(w) != own.get(w) for w in ("gait", "legs"))]
    which = torch.tensor(order[:1] + [k for k in other[:1] if losses[k] < (1 + TIE) * losses[order[0]]])
    return Run(3, _pick(run.x, which), run.guess.pick(which), [run.labels[int(k)] for k in which], run.log)
