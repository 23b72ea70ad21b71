"""Which foot stands when, decided over time, and feet that stay where they stand.

The fit says of every frame how high a foot is and how fast it moves; both are noisy where they matter, at touch-down
and lift-off. A hidden Markov model with two states (down, up) smooths that over time (forward-backward algorithm,
Rabiner 1989), and the feet of a stance are brought to their one place on the ground by inverse kinematics of the legs.
"""

import numpy as np
import torch

from slomo.reconstruct.kinematics import Kinematics, limb_links
from slomo.runs import runs

Array = np.ndarray
Tensor = torch.Tensor

HEIGHT = 0.082  # leg lengths above its stance height at which a foot is as likely up as down
SPEED = 0.476  # leg lengths / s, likewise, of a body at rest
TRAVEL = 0.2  # what is added to it of the body's own speed: a path that is wrong slides all feet with it
SURE = 0.99  # of one frame at most
CHANGES = 3.0  # how often a second a foot is expected to change between up and down
# Inverse kinematics: s.d. of the corrections of a joint, rad about x (abduction), y (flexion: what legs do) and
# z (twist), and what may be left of the way, body lengths.
JOINT_SPREAD = (0.05, 0.2, 0.02)
PRECISE = 0.002
STEPS = 4


def contact_probability(feet: Array, root: Array, t: Array, *, length: float, leg: float, sole: float) -> Array:
    """(T, F) probability in [0, 1] that a foot stands.

    Args:
        feet: (T, F, 3), root: (T, 3) world, z up. t: (T,) s. length: body length, in the same unit.
        leg: length of a leg, sole: height of a foot that stands; body lengths.
    """
    if len(t) < 2:
        return np.full(feet.shape[:2], 0.5)
    height = feet[..., 2] / length - sole
    travel = np.linalg.norm(np.gradient(root[:, :2], t, axis=0), axis=-1) / length
    speed = np.linalg.norm(np.gradient(feet[..., :2], t, axis=0), axis=-1) / length
    limit, low = (SPEED * leg + TRAVEL * travel)[:, None], HEIGHT * leg
    down = _logistic((low - height) / (low / 4)) * _logistic((limit - speed) / (limit / 4))
    down = down.clip(1 - SURE, SURE)
    return smoothed(np.log(np.stack([1 - down, down], -1)), (CHANGES * np.diff(t)).clip(1e-3, 0.4))


def smoothed(log_likelihood: Array, change: Array) -> Array:
    """(T, F) posterior of the second of two states.

    Args:
        log_likelihood: (T, F, 2) of what was seen, in each state. change: (T - 1,) probability of a change of state.
    """
    step = np.log(np.stack([np.stack([1 - change, change], -1), np.stack([change, 1 - change], -1)], -2))

    def passes(x: Array, steps: Array) -> Array:
        out = [x[0]]
        for seen, s in zip(x[1:], steps, strict=True):
            out.append(seen + np.logaddexp.reduce(out[-1][:, :, None] + s, axis=1))
        return np.stack(out)

    both = passes(log_likelihood, step) + passes(log_likelihood[::-1], step[::-1])[::-1] - log_likelihood
    return _logistic(both[..., 1] - both[..., 0])


def places(feet: Array, contact: Array, t: Array, ground: float) -> Array:
    """(T, F, 3) where the feet go: through each stance at its mean place, `ground` high; in between the correction
    changes evenly from one stance's to the next one's, but the foot is never below the ground. A foot that never stands
    stays as it is."""
    out = feet.copy()
    for f in range(feet.shape[1]):
        moves = np.full((len(t), 3), np.nan)
        for a, b in runs(contact[:, f] > 0.5):
            place = np.average(feet[a:b, f], axis=0, weights=contact[a:b, f])
            place[2] = ground
            moves[a:b] = place - feet[a:b, f]
        known = np.flatnonzero(np.isfinite(moves[:, 0]))
        if len(known):
            out[:, f] += np.stack([np.interp(t, t[known], moves[known, c]) for c in range(3)], 1)
            out[:, f, 2] = np.maximum(out[:, f, 2], ground)
    return out


def stand(kin: Kinematics, shape: dict[str, Tensor], position: Tensor, R: Tensor, q: Tensor, target: Array) -> Tensor:
    """Joint angles (1, T, B, 3) with which the feet of one body are at `target` (T, F, 3): damped least squares on the
    joints of the legs (Wampler 1986), each step the smallest change in units of `JOINT_SPREAD`. What is out of reach is
    approached.

    Args:
        shape, position (1, T, 3), R (1, T, 3, 3), q (1, T, B, 3): as `Kinematics.pose` takes them.
    """
    chains = [limb_links(kin.skeleton, limb) for limb in kin.skeleton.limbs]
    longest = max(map(len, chains))
    goal = torch.as_tensor(target, dtype=torch.float32)
    length = float(shape["log_length"].exp()[0])
    spread = torch.tensor(JOINT_SPREAD).repeat(longest)
    feet = lambda angles: kin.pose(shape, position, R, angles).nodes[0][:, kin.contacts]  # noqa: E731
    nudge = 1e-3
    for _ in range(STEPS):
        at = feet(q)
        columns = []
        for n in range(longest):
            for axis in range(3):
                moved = q.clone()
                # Legs share no joint, so all of them are nudged at once.
                for chain in chains:
                    if n < len(chain):
                        moved[:, :, chain[n], axis] += nudge
                columns.append((feet(moved) - at) / nudge)
        J = torch.stack(columns, -1) / length * spread
        square = J @ J.transpose(-1, -2) + PRECISE**2 * torch.eye(3)
        change = (J.transpose(-1, -2) @ torch.linalg.solve(square, ((goal - at) / length)[..., None]))[..., 0] * spread
        q = q.clone()
        for f, chain in enumerate(chains):
            for n, j in enumerate(chain):
                q[0, :, j] += change[:, f, 3 * n : 3 * n + 3]
    return q


def _logistic(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))
