"""Guesses to start from: the root path from the masks and the ground, headings, and gaits with frequency and phase."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from slomo.gravity import GRAVITY
from slomo.ground_path import ground_path
from slomo.reconstruct.evidence import Evidence
from slomo.reconstruct.kinematics import Kinematics, limb_links, yaw_pitch_roll
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.problem import Problem, Variables
from slomo.reconstruct.stride import Steps
from slomo.reconstruct.trajectory import Guess
from slomo.skeleton import Gait, Skeleton

Array = np.ndarray
Tensor = torch.Tensor
_STANDS = 0.15  # of the clip's mean pace: strides that are slower than that have come to a stop
_STRETCHES = (0.9, 0.95, 1.0, 1.05, 1.1), (0.95, 1.0, 1.05)  # of the likeliest stride frequency and the next


@dataclass(frozen=True)
class GaitHypothesis:
    """A gait with stride frequency, Hz of the clock that strides keep, and phase in [0, 1) of the stride at t = 0."""

    name: str
    frequency: float
    phase: float


@dataclass(frozen=True)
class RootGuess:
    """Coarse path of the subject, world units: middle of the body on the ground (T, 2), body length, heading of travel
    (T,) rad, farthest distance from where it began and speed (T,) in body lengths (and s)."""

    middle: Array
    length: float
    heading: Array
    travelled: float
    speed: Array


def root_guess(obs: Observations, skeleton: Skeleton) -> RootGuess:
    """The path of the masks on the ground, and the body length of a rest pose as tall as they are."""
    t = obs.t.numpy()
    path = ground_path(t, obs.at.numpy(), obs.K, obs.T_world_cam, obs.box, quality=obs.quality.numpy(), empty=obs.empty)
    rest = skeleton.rest()[:, 2]
    length = path.height / (
        skeleton.root_height + np.quantile(rest, 0.95) + (0.03 if skeleton.kind == "human" else 0.08)
    )
    travelled = float(np.linalg.norm(path.middle - path.middle[0], axis=1).max()) / length
    speed = np.linalg.norm(path.velocity, axis=1) / length
    return RootGuess(path.middle, length, path.heading(t, 0.25 * length), travelled, speed)


def said_headings(obs: Observations, said: Evidence | None, root: RootGuess) -> list[tuple[str, Array]]:
    """Headings (T,) rad in which the view decided for the clip is seen, and its likely mirror images; none unsaid."""
    t, at = obs.t.numpy(), obs.at.numpy()
    to_camera = obs.T_world_cam[at, :2, 3] - root.middle[at]
    to_camera = np.unwrap(np.arctan2(to_camera[:, 1], to_camera[:, 0]))
    paths = said.paths() if said else []
    return [(name, np.interp(t, t[at], np.unwrap(to_camera - azimuth))) for name, azimuth in paths]


def heading_guess(
    kin: Kinematics, root: RootGuess, T: int, said: Sequence[tuple[str, Array]] = ()
) -> tuple[Guess, list[str]]:
    """Rest poses along the path: facing as they are `said` to, the way of travel, and eight fixed ways."""
    yaws, names = [yaw for _, yaw in said], [f"view, {name}" for name, _ in said]
    if root.travelled > 0.7:
        for turn in (0.0, -30.0, 30.0, 180.0):
            yaws.append(root.heading + math.radians(turn))
            names.append(f"travel{turn:+.0f}")
    if root.travelled < 2.0:
        for n in range(8):
            yaws.append(np.full(T, n * math.pi / 4))
            names.append(f"{n * 45}")
    return placed(kin, root, np.stack(yaws)), names


def placed(kin: Kinematics, root: RootGuess, yaw: Array) -> Guess:
    """Rest poses along the path with headings yaw (H, T) rad."""
    s = kin.skeleton
    middle = float(s.rest()[: s.link_count, 0].mean()) if s.kind == "quadruped" else 0.0
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    xy = root.middle - middle * root.length * ahead
    z = np.full((*yaw.shape, 1), s.root_height * root.length)
    f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
    H, T = yaw.shape
    q = torch.zeros(H, T, kin.B, 3)
    stance = torch.full((H, T, len(s.limbs)), -1.0)
    return Guess(position=f(np.concatenate([xy, z], -1)), yaw=f(yaw), lean=torch.zeros(H, T, 2), q=q, stance=stance)


def posture_angles(kin: Kinematics) -> tuple[Tensor, list[str]]:
    """(N, B, 3) rad: every combination of the skeleton's postures, the rest pose first, and what they are called."""
    angles, names = [], []
    for combination in itertools.product(*[(None, *alternatives) for alternatives in kin.skeleton.postures]):
        q = torch.zeros(kin.B, 3)
        for posture in combination:
            for joint, xyz in posture.joints if posture else ():
                q[joint] += torch.tensor(xyz)
        angles.append(q)
        names.append(", ".join(p.name for p in combination if p) or "rest")
    return torch.stack(angles), names


def as_guess(problem: Problem, x: Variables, guess: Guess) -> tuple[Variables, Guess]:
    """The same motion as a guess with no corrections of the joint angles to it, and without hypothetical contacts."""
    with torch.no_grad():
        _, _, q = problem.path(x, guess, x["shape.log_length"].exp(), torch.arange(len(problem.obs.t)))
    return _silent(x, "Q"), replace(guess, q=q, stance=torch.full_like(guess.stance, -1.0))


def _silent(x: Variables, name: str) -> Variables:
    """The variables with the last layer of the MLP `name` zero: it corrects nothing."""
    last = max(k for k in x if k.startswith(f"{name}.w")).removeprefix(f"{name}.w")
    return x | {k: torch.zeros_like(x[k]) for k in (f"{name}.w{last}", f"{name}.b{last}")}


def exchanged(
    problem: Problem, x: Variables, guess: Guess, links: Tensor | None = None, *, in_place: bool = False
) -> tuple[Variables, Guess]:
    """The same motion with the joint angles of left and right legs (or of the `links` of both sides) exchanged, as a
    guess with no corrections to it: each the mirror image of the other, or, `in_place`, where the other one is, but
    for the width of the hips."""
    x, guess = as_guess(problem, x, guess)
    kin, q = problem.kin, guess.q.clone()
    legs = torch.tensor(leg_links(kin.skeleton)) if links is None else links
    other = guess.q[:, :, kin.mirror[: kin.B]] if in_place else kin.mirrored(guess.q)
    q[:, :, legs] = other[:, :, legs]
    return x, replace(guess, q=q)


def turned_around(problem: Problem, x: Variables, guess: Guess) -> tuple[Variables, Guess]:
    """The same motion reflected in depth, as a guess with no corrections to it: a body that faces the camera as one
    that turns its back to it, with left and right exchanged. From afar the two have the same silhouettes and flow."""
    x, guess = as_guess(problem, x, guess)
    every = torch.arange(len(problem.obs.t))
    with torch.no_grad():
        position, R, q = problem.path(x, guess, x["shape.log_length"].exp(), every)
        _, centre = problem.cameras(x["tilt"], every)
    away = position - centre
    yaw, pitch, roll = yaw_pitch_roll(R)
    yaw = 2 * torch.atan2(away[..., 1], away[..., 0]) + math.pi - yaw
    lean = torch.stack([pitch, -roll], -1)
    return _silent(x, "G"), replace(guess, position=position, yaw=yaw, lean=lean, q=problem.kin.mirrored(q))


def leg_pairs(kin: Kinematics) -> list[tuple[str, Tensor, tuple[int, int]]]:
    """Name, links of both sides, and numbers of the two limbs, the left one first, of every pair of legs."""
    out, skeleton = [], kin.skeleton
    for left, right in kin.pairs.tolist():
        links = torch.tensor([link for n in (left, right) for link in limb_links(skeleton, skeleton.limbs[n])])
        name = skeleton.limbs[left].name.replace("left", "").strip("_") or "legs"
        out.append((name, links, (left, right)))
    return out


def leg_links(skeleton: Skeleton) -> list[int]:
    """The links of all legs."""
    return sorted({link for limb in skeleton.limbs for link in limb_links(skeleton, limb)})


def gait_grid(
    steps: Steps, skeleton: Skeleton, *, leg: float, speed: float, metres: float | None, phases: int
) -> list[GaitHypothesis]:
    """All gaits that fit the speed, with the clip's stride frequencies and `phases` phases each.

    Args:
        leg: leg length, body lengths. speed: median speed, body lengths / s.
        metres: body length m, if it is known; else any that the skeleton stands for may be.
    """
    natural = math.sqrt(GRAVITY / (leg * (metres or skeleton.typical_length))) / (2 * math.pi)
    slowest, fastest = (m * speed**2 / (GRAVITY * leg) for m in ((metres, metres) if metres else skeleton.lengths))
    frequencies = steps.frequencies(0.5 * natural, 5.5 * natural)
    out = []
    for gait in skeleton.gaits:
        # Speed is uncertain (length, path): a factor of two each way in the Froude number.
        if not (gait.froude[0] / 2 <= fastest and slowest <= gait.froude[1] * 2):
            continue
        for f, stretches in zip(frequencies, _STRETCHES, strict=False):
            for stretch in stretches:
                out += [GaitHypothesis(gait.name, f * stretch, n / phases) for n in range(phases)]
    return out


def gait_pose(
    kin: Kinematics, gait: Gait, hypothesis: GaitHypothesis, t: Array, *, clock: Array, speed: Array, leg: float
) -> tuple[Array, Array]:
    """Joint angles (T, B, 3) and contacts (T, L) of a gait at t (T,) s, whose strides keep a `clock` (T,) s. speed (T,)
    and leg in body lengths (and s)."""
    q = np.zeros((len(t), kin.B, 3))
    contact = np.zeros((len(t), len(kin.skeleton.limbs)))
    pace = np.gradient(clock, t) if len(t) > 1 else np.ones(1)
    moving = (pace / _STANDS).clip(0, 1)
    stroke = speed * gait.duty / (hypothesis.frequency * np.maximum(pace, _STANDS))
    amplitude = np.arctan2(stroke / 2, leg).clip(math.radians(4), math.radians(38))
    for n, (limb, land) in enumerate(zip(kin.skeleton.limbs, gait.land, strict=True)):
        c = (hypothesis.frequency * (clock - clock[0]) + hypothesis.phase - land) % 1.0
        swing = ((c - gait.duty) / (1 - gait.duty)).clip(0, 1)
        # Stance: from forward (negative y) to back at constant speed; swing: back to front along a cosine.
        along = np.where(c < gait.duty, 2 * c / gait.duty - 1, np.cos(math.pi * swing))
        q[:, limb.swing, 1] = amplitude * along
        lift = np.sin(math.pi * swing) * (c >= gait.duty) * moving
        for joint, angle in limb.lift:
            q[:, joint, 1] = angle * lift * np.minimum(1, amplitude / math.radians(15))
        contact[:, n] = (c < gait.duty) | (moving < 1)
    return q, contact
