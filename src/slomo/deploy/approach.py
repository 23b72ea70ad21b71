"""From the robot's own stand into a motion and back: a crawl before and after it, for the controller to follow.

A motion begins and ends with its feet somewhere; a robot stands up and lies down with its feet below its hips. Between
the two it sets one foot after the other, the centre of mass over the other three.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.deploy.postures import smooth
from slomo.motion import Reference
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain
from slomo.track.cyclic import repeated
from slomo.track.lead_in import balance, with_lead_in
from slomo.track.stage import Config as TrackConfig

Array = np.ndarray

SHIFT, SWING, LIFT = 0.4, 0.4, 0.05  # s, s, m: of a step
STAY = 2e-3  # m, by which a foot may be elsewhere without a step
ORDER = (2, 0, 3, 1)  # limbs: hind left, front left, hind right, front right


def motion_of(reference: Reference, track: TrackConfig) -> Reference:
    """What is performed of a reference: all of it, or its cycle repeated for as long as `track` says."""
    return repeated(reference, track.seconds) if track.seconds else reference


@dataclass(frozen=True)
class _Pose:
    """position: (3,) m.  rotation: of the body.  feet: (C, 3) m."""

    position: Array
    rotation: Rotation
    feet: Array


def with_approach(
    reference: Reference, robot: Robot, *, terrain: Terrain, track: TrackConfig, rest: float
) -> Reference:
    """The reference between two stands, the robot's feet below its hips and its body level.

    Before the motion's start, at negative times: the crawl, then the lead-in. After its end: `rest` (s) at rest in the
    last pose, with the feet that are in the air set down, then the crawl back.
    """
    model = PointFootModel.from_robot(robot, mu=track.mu)
    led = with_lead_in(
        motion_of(reference, track), model, standing=robot.nominal_feet, terrain=terrain, settle=track.settle,
        blend=track.blend,
    )  # fmt: skip
    first, last = _pose(led, 0), _pose(led, -1)
    down = last.feet.copy()
    down[:, 2] = terrain.height(down)
    landed = replace(last, feet=down)
    home, end = (_stand(robot, pose, terrain) for pose in (first, landed))
    before = _filled(list(_crawl(home, first, model)), led, model, terrain)
    stay = [(SWING, last, landed, None), (rest, landed, landed, None)]
    after = _filled([*stay, *_crawl(landed, end, model)], led, model, terrain)
    # Each part ends where the next one begins.
    parts = ((before, led.t[0] - before.t[-1], slice(-1)), (led, 0.0, slice(None)), (after, led.t[-1], slice(1, None)))
    q = np.concatenate([part.q[rows] for part, _, rows in parts])
    q[1:, 3:7] *= np.cumprod(np.where(np.sum(q[1:, 3:7] * q[:-1, 3:7], axis=1) < 0, -1.0, 1.0))[:, None]
    return replace(
        reference,
        t=np.concatenate([part.t[rows] + start for part, start, rows in parts]),
        q=q,
        v=np.concatenate([part.v[rows] for part, _, rows in parts]),
        **{name: np.concatenate([getattr(part, name) for part, _, _ in parts]) for name in ("h", "u", "lam")},
        cycle=np.zeros(0),
    )


def _pose(reference: Reference, k: int) -> _Pose:
    q = reference.q[k]
    return _Pose(q[:3], Rotation.from_quat(q[3:7]), q[7:].reshape(-1, 3))


def _stand(robot: Robot, near: _Pose, terrain: Terrain) -> _Pose:
    """The robot's own stand, its feet about where those of `near` are and headed the same way."""
    yaw = Rotation.from_euler("z", near.rotation.as_euler("ZYX")[0])
    feet = yaw.apply(robot.nominal_feet * [1, 1, 0])
    shift = (near.feet - feet).mean(axis=0) * [1, 1, 0]
    feet = feet + shift
    feet[:, 2] = terrain.height(feet)
    return _Pose(shift + [0, 0, robot.standing_height + feet[:, 2].mean()], yaw, feet)


# A step of the crawl: seconds, from, to, and the foot that swings.
_Step = tuple[float, _Pose, _Pose, int | None]


def _crawl(start: _Pose, goal: _Pose, model: PointFootModel) -> Iterable[_Step]:
    """Set the feet one by one from where they are in `start` to where they are in `goal`."""
    at = start
    moving = [c for c in ORDER if np.linalg.norm(goal.feet[c] - at.feet[c]) > STAY]
    height = (start.position[2] - start.feet[:, 2].mean() + goal.position[2] - goal.feet[:, 2].mean()) / 2
    for c in moving:
        over = np.delete(at.feet, c, axis=0).mean(axis=0)
        total = model.mass + model.foot_mass.sum()
        over = (total * over - model.foot_mass @ at.feet) / model.mass
        over[2] = height + at.feet[:, 2].mean()
        shifted = replace(at, position=over)
        yield SHIFT, at, shifted, None
        feet = at.feet.copy()
        feet[c] = goal.feet[c]
        at = replace(shifted, feet=feet)
        yield SWING, shifted, at, c
    yield SHIFT, at, goal, None


def _filled(steps: list[_Step], like: Reference, model: PointFootModel, terrain: Terrain) -> Reference:
    """The steps as a reference from t = 0, in time steps like `like`'s, with forces of near-static balance."""
    h = float(np.median(like.h))
    q, v, stance = [], [], []
    for T, a, b, swings in steps:
        n = max(2, round(T / h))
        turn = (a.rotation.inv() * b.rotation).as_rotvec()
        for k in range(n):
            s, rate = smooth(k / n)
            rate /= n * h
            feet, speeds = a.feet + s * (b.feet - a.feet), rate * (b.feet - a.feet)
            if swings is not None:
                feet[swings, 2] += LIFT * np.sin(np.pi * k / n) ** 2
                speeds[swings, 2] += LIFT * np.pi / (n * h) * np.sin(2 * np.pi * k / n)
            position, rotation = a.position + s * (b.position - a.position), a.rotation * Rotation.from_rotvec(s * turn)
            q.append(np.concatenate([position, rotation.as_quat(), feet.ravel()]))
            v.append(np.concatenate([rate * (b.position - a.position), rate * turn, speeds.ravel()]))
            stance.append(feet[:, 2] - terrain.height(feet) < 0.005)
    _, _, end, _ = steps[-1]
    q.append(np.concatenate([end.position, end.rotation.as_quat(), end.feet.ravel()]))
    v.append(np.zeros_like(v[-1]))
    x = np.array(q)
    acceleration = np.gradient(np.array(v)[:, :3], h, axis=0)
    on = np.array(stance)
    u = np.array(
        [balance(model, r[:3], r[7:].reshape(-1, 3), s, a) for r, s, a in zip(x, on, acceleration, strict=False)]
    )
    lam = np.where(on[..., None], u + model.foot_mass[:, None] * [0, 0, model.g], 0.0)
    return replace(
        like, t=np.arange(len(x)) * h, h=np.full(len(x) - 1, h), q=x, v=np.array(v), u=u.reshape(len(u), -1), lam=lam
    )
