"""Gaits made of sines, as targets for the solvers: a quadruped's trot and a person's walk, of any length."""

from dataclasses import replace

import numpy as np

from slomo.motion import Reference
from slomo.optimize.cost import Task
from slomo.optimize.problem import Targets, velocities
from slomo.optimize.solve import Solution
from slomo.pointfoot import PointFootModel
from slomo.terrain import Terrain

HIPS = np.array([[0.19, 0.13, 0], [0.19, -0.13, 0], [-0.19, 0.13, 0], [-0.19, -0.13, 0]])


def quadruped() -> PointFootModel:
    """Numbers like those of a Go1."""
    return PointFootModel(
        mass=11.7, inertia=np.diag([0.10, 0.30, 0.36]), hips=HIPS, leg_min=np.full(4, 0.10), leg_max=np.full(4, 0.37),
        foot_mass=np.full(4, 0.35), u_max=np.full((4, 3), 120.0), clearance=np.full(4, 0.05),
        names=("front_left", "front_right", "hind_left", "hind_right"),
    )  # fmt: skip


def humanoid() -> PointFootModel:
    """Numbers like those of a G1: toe and heel of two feet, two hands."""
    hips = np.array([[0, 0.1, -0.15]] * 2 + [[0, -0.1, -0.15]] * 2 + [[0, 0.15, 0.25], [0, -0.15, 0.25]])
    return PointFootModel(
        mass=28.0, inertia=np.diag([1.6, 1.4, 0.3]), hips=hips,
        leg_min=np.array([0.3] * 4 + [0.05] * 2), leg_max=np.array([0.68] * 4 + [0.42] * 2),
        foot_mass=np.array([0.6] * 4 + [0.5] * 2), u_max=np.full((6, 3), 400.0),
        pairs=np.array([[0, 1], [2, 3]]), pair_length=np.full(2, 0.17), clearance=np.array([0.4] * 4 + [-np.inf] * 2),
        names=("left_toe", "left_heel", "right_toe", "right_heel", "left_hand", "right_hand"),
    )  # fmt: skip


def on(want: Targets, terrain: Terrain) -> Targets:
    """The same with its points lifted to the ground at least."""
    q = want.q.copy()
    q[:, 9::3] = np.maximum(q[:, 9::3], terrain.height(want.points))
    return replace(want, q=q, v=velocities(want.t, q))


def reference(model: PointFootModel, task: Task, solution: Solution) -> Reference:
    """What the verifier judges."""
    it, nf = solution.iterate, 3 * model.C
    h = it.us[:, nf] if it.us.shape[1] > nf else task.h[:-1]
    return Reference(
        t=np.append(0.0, np.cumsum(h)), h=h.copy(), q=it.qs, v=it.vs, u=it.us[:, :nf].copy(), lam=it.lam,
        point_names=model.names, robot_digest="",
    )  # fmt: skip


def gait(
    model: PointFootModel,
    duration: float,
    *,
    dt: float = 0.05,
    speed: float = 0.3,
    lift: float = 0.05,
    turn: float = 0.0,
) -> Targets:
    """The model's gait along x (m/s), turning at `turn` rad/s, with points lifted by `lift` m."""
    human = model.C == 6
    t = dt * np.arange(round(duration / dt) + 1)
    rate, height = (1.25, 0.72) if human else (2.5, 0.27)
    # Where the points stand below the body, and when they swing; hands do not touch the ground.
    stand, phase = model.hips * [1, 1, 0] - [0, 0, height], np.array([0.0, 0.5, 0.5, 0.0])
    if human:
        stand[:4, 0] = [0.12, -0.05, 0.12, -0.05]
        stand[4:, 2] = -0.05
        phase = np.array([0.0, 0.0, 0.5, 0.5, 0.0, 0.0])
    heading = turn * t
    base = np.stack([speed * t, np.zeros_like(t), np.full_like(t, height)], axis=1)
    quat = np.stack([0 * t, 0 * t, np.sin(heading / 2), np.cos(heading / 2)], axis=1)
    points = np.empty((len(t), model.C, 3))
    for c in range(model.C):
        cycle = rate * t + phase[c]
        step, part = np.floor(cycle), cycle % 1.0
        swing = np.clip((part - 0.5) / 0.5, 0, 1)
        forward = (step + swing * swing * (3 - 2 * swing) - phase[c] + 0.25) / rate * speed
        up = lift * np.sin(np.pi * swing)
        if stand[c, 2] > -height:
            forward, up = speed * t, 0 * t
        place = np.outer(np.cos(heading), stand[c] * [1, 1, 0]) + np.outer(
            np.sin(heading), [-stand[c, 1], stand[c, 0], 0]
        )
        points[:, c] = place + np.stack([forward, 0 * t, height + stand[c, 2] + up], axis=1)
    q = np.concatenate([base, quat, points.reshape(len(t), -1)], axis=1)
    ones = np.ones(len(t))
    return Targets(t=t, q=q, v=velocities(t, q), body_confidence=ones, foot_confidence=np.ones((len(t), model.C)))
