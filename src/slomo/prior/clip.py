"""From which side the subject is seen, decided for the clip: a single picture of a body cannot tell its depth from the
mirror image of it, and a network that is asked picture by picture jumps between the two. Bodies turn slowly.
"""

import numpy as np

from slomo.prior.labels import BINS

Array = np.ndarray

TURN = np.radians(70.0)  # rad/s, a subject that turns faster is unlikely, the more so the faster
SPINS = np.radians([120.0, 200.0, 280.0, 360.0])  # rad/s, of one that goes on turning one way, which few do
SPREAD = np.radians(120.0)  # rad/s, by about which it does not
_STEP = np.radians(40.0)  # of a spin from one frame to the next, at most
_FEW = 5.0  # nats by which what is seen must be likelier if it spins
CORRELATION = 0.2  # s: pictures as close as that look alike, and so do the errors; they count as one
_LEAK = 1e-7  # probability of any jump at all: a cut, or a subject that was lost for a moment
_NEAR = 2  # bins on either side of the path over which its place is refined

CENTRES = 2 * np.pi * np.arange(BINS) / BINS


def view_over_clip(*said: Array, t: Array) -> tuple[Array, Array]:
    """A hidden Markov model over the azimuth's bins (forward-backward and Viterbi; Rabiner, Proc. IEEE 1989), of a body
    that turns slowly or of one that spins, whichever makes what is seen likelier.

    Args:
        said: (F, 36) probability of the bins in each frame by itself, of each source. t: (F,) s.

    Returns:
        (F, 36) probability given the whole clip; (F,) rad, the likeliest path, within its bin where the probability is.
    """
    log_p = sum(np.log(np.maximum(p, 1e-6)) for p in said) * independent(t)[:, None]
    slow = _decided(log_p, t, 0.0, TURN)
    # Between frames far apart a spin is half a turn, which is what a mirror image looks like.
    spins = SPINS[SPINS * np.median(np.diff(t)) < _STEP] if len(t) > 1 else SPINS[:0]
    spinning = [_decided(log_p, t, spin, SPREAD) for spin in (*spins, *-spins)]
    best = max(spinning, key=lambda found: found[2], default=slow)
    marginal, path, _ = best if best[2] - _FEW > slow[2] else slow

    offset = np.arange(-_NEAR, _NEAR + 1)
    near = np.take_along_axis(marginal, (path[:, None] + offset) % BINS, 1)
    shift = (near @ offset) / np.maximum(near.sum(1), 1e-12) * (2 * np.pi / BINS)
    azimuth = CENTRES[path] + shift
    return marginal.astype(np.float32), (np.mod(azimuth + np.pi, 2 * np.pi) - np.pi).astype(np.float32)


def _decided(log_p: Array, t: Array, rate: float, spread: float) -> tuple[Array, Array, float]:
    """(F, 36) probability given the whole clip, (F,) the bins of the likeliest path, and the log likelihood of all that
    is said, of a body that turns by `rate`, give or take `spread` (rad/s)."""
    unique, which = np.unique(np.round(np.diff(t), 4), return_inverse=True)
    moves = np.array([_moves(x, rate, spread) for x in unique]).reshape(-1, BINS, BINS)
    log_moves = np.log(moves)
    F = len(t)
    likely = np.exp(log_p - log_p.max(1, keepdims=True))
    ahead, back = np.empty((F, BINS)), np.ones((F, BINS))
    total = likely[0].sum() / BINS
    evidence, ahead[0] = np.log(total), likely[0] / likely[0].sum()
    for f in range(1, F):
        ahead[f] = likely[f] * (ahead[f - 1] @ moves[which[f - 1]])
        total = ahead[f].sum()
        evidence += np.log(total)
        ahead[f] /= total
    for f in range(F - 2, -1, -1):
        back[f] = moves[which[f]] @ (likely[f + 1] * back[f + 1])
        back[f] /= back[f].sum()
    marginal = ahead * back
    marginal /= marginal.sum(1, keepdims=True)

    best, came = log_p[0], np.zeros((F, BINS), int)
    for f in range(1, F):
        via = best[:, None] + log_moves[which[f - 1]]
        came[f] = via.argmax(0)
        best = via.max(0) + log_p[f]
    path = np.empty(F, int)
    path[-1] = best.argmax()
    for f in range(F - 1, 0, -1):
        path[f - 1] = came[f, path[f]]
    return marginal, path, float(evidence)


def independent(t: Array) -> Array:
    """(F,) in (0, 1]: what each frame counts, for frames at t (F,) s whose errors are alike over `CORRELATION`."""
    gap = np.diff(t)
    room = 0.5 * (np.concatenate([gap, gap[-1:]]) + np.concatenate([gap[:1], gap])) if len(gap) else np.ones(len(t))
    return np.clip(room / CORRELATION, 0.05, 1.0)


def _moves(dt: float, rate: float, spread: float) -> Array:
    """(36, 36) probability to go from one bin to another within dt (s), by a rate and its spread (rad/s)."""
    apart = np.abs(np.mod(CENTRES - CENTRES[:, None] - rate * dt + np.pi, 2 * np.pi) - np.pi)
    moves = np.exp(-apart / (spread * dt)) + _LEAK
    return moves / moves.sum(1, keepdims=True)


def up_over_clip(up: Array, view: Array, path: Array, t: Array, *, tau: float = 0.15) -> Array:
    """(F, 3) unit up axes, averaged over about `tau` (s) of neighbours that see the subject from the clip's side.

    Args:
        up: (F, 3). view: (F, 36) of each frame by itself. path: (F,) rad of the clip. t: (F,) s.
    """
    apart = np.abs(np.mod(CENTRES - path[:, None] + np.pi, 2 * np.pi) - np.pi)
    agrees = np.where(apart < np.radians(45), view, 0).sum(1) + 1e-3
    weight = np.exp(-0.5 * ((t[:, None] - t) / tau) ** 2) * agrees
    mean = weight @ up
    return (mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-6)).astype(np.float32)
