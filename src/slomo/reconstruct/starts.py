"""Hypotheses to begin with: headings, sizes and postures that cover the masks best as they are."""

import math
from dataclasses import replace

import numpy as np
import torch

from slomo.reconstruct import hypotheses, pose_track
from slomo.reconstruct.hypotheses import RootGuess
from slomo.reconstruct.problem import Problem, pick, rank
from slomo.reconstruct.run import Run, join
from slomo.reconstruct.trajectory import Guess

Tensor = torch.Tensor


def start(problem: Problem, root: RootGuess, generator: torch.Generator) -> Run:
    """Every heading with the size and the posture that fit the masks best as they are: a raised tail or a lowered head
    changes the height from which the size was guessed, and a raised tail looks like a neck."""
    if problem.kin.skeleton.kind == "human":
        return _tracked(problem, root, generator)
    postures, posture_names = hypotheses.posture_angles(problem.kin)
    n = len(postures)
    tried: list[tuple[Tensor, list[Guess], list[dict]]] = []
    sizes = (1.0, 0.8)
    one = problem.variables(1, generator)
    said = hypotheses.said_headings(problem.obs, problem.said, root)
    for size in sizes:
        scaled = replace(root, length=root.length * size)
        guess, names = hypotheses.heading_guess(problem.kin, scaled, len(problem.obs.t), said)
        x = pick(one, torch.zeros(n, dtype=torch.long))
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
    x = pick(one, torch.zeros(len(best), dtype=torch.long))
    x["shape.log_length"] += torch.tensor([math.log(root.length * sizes[b]) for b in best])
    return Run(0, x, join([tried[b][1][k] for k, b in enumerate(best)]), [tried[b][2][k] for k, b in enumerate(best)])


def _tracked(problem: Problem, root: RootGuess, generator: torch.Generator) -> Run:
    """Paths through headings and postures that suit the silhouettes best, mostly seen from the front and from behind,
    one as the view is said to be, and one that faces the way of travel; each with two sizes."""
    postures, posture_names = hypotheses.posture_angles(problem.kin)
    one = problem.variables(1, generator)
    T, ring = len(problem.obs.t), tuple(2 * math.pi * n / pose_track.HEADINGS for n in range(pose_track.HEADINGS))
    guesses, labels, lengths = [], [], []
    for size in (1.0, 0.85):
        scaled = replace(root, length=root.length * size)
        x = pick(one, torch.zeros(1, dtype=torch.long))
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
    x = pick(one, torch.zeros(len(guesses), dtype=torch.long))
    x["shape.log_length"] += torch.tensor(lengths)
    return Run(0, x, join(guesses), labels)
