"""When legs do the same again: stride frequencies from the self-similarity of silhouettes, and the clock they keep.

Who speeds up takes longer strides, and more of them: the stride frequency grows as a power of the speed, of a little
more than a half in people who walk (Grieve and Gear, Ergonomics 1966), of nearly nothing in animals that gallop
(Heglund and Taylor, J. Exp. Biol. 1988), of 1 where strides keep their length. No frequency in Hz fits a clip of such a
change, but one of a clock that runs with the speed does, and the silhouettes say which: by that clock they repeat
themselves best.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from slomo.reconstruct.observations import Observations

Array = np.ndarray

POWERS = (0.0, 0.5, 1.0)  # of the speed, by which the stride frequency may grow
_BETTER = 1.3  # times as deep a dip in self-similarity that a clock must give to be taken for that of seconds
_SMOOTH = 0.2  # s over which the speed is averaged for it
_SLOWEST = 0.05  # of the mean speed
_AS_DEEP = 0.45  # share of the depth of a dip, for a shorter lag to be the period of a longer one
_MULTIPLE = 0.06  # how far the longer one may be from a multiple of it
_BAND = (48, 16)  # cells of the legs' silhouettes


@dataclass(frozen=True)
class Steps:
    """How the legs' silhouettes repeat themselves.

    Attributes:
        power: of the speed, by which the stride frequency grows.
        clock: (T,) s, at the clip's times: as long as the clip, and as fast in the mean.
        lags: (n,) s of that clock. unlike: (n,) mean difference of silhouettes that lag apart, in [0, 1].
    """

    power: float
    clock: Array
    lags: Array
    unlike: Array

    @property
    def depth(self) -> Array:
        """(n,) how much more alike they are than around that lag."""
        return np.convolve(np.pad(self.unlike, 8, "edge"), np.ones(17) / 17, "valid") - self.unlike

    def dips(self) -> list[int]:
        """Indices of the lags at which they are more alike than at those next to it, the deepest first."""
        d, depth = self.unlike, self.depth
        return sorted(
            (i for i in range(1, len(d) - 1) if d[i] <= d[i - 1] and d[i] < d[i + 1]), key=lambda i: -depth[i]
        )

    def frequencies(self, low: float, high: float) -> list[float]:
        """Candidate stride frequencies, Hz of the clock, from `low` to `high`, most likely first.

        Silhouettes are most alike at the stride period, about as much at half of it where left and right look alike,
        and at its multiples: of each of the two deepest dips the shortest lag that it is a multiple of is read in both
        ways, then the dips themselves.
        """
        d, depth, dips = self.unlike, self.depth, self.dips()
        step = self.lags[1] - self.lags[0] if len(self.lags) > 1 else 0.0

        def lag(i: int) -> float:
            c = d[i - 1] - 2 * d[i] + d[i + 1]
            return self.lags[i] + step * (0.5 * (d[i - 1] - d[i + 1]) / c if c > 0 else 0.0)

        def whole(i: int) -> int:
            """The shortest lag that dip i is a multiple of: after two strides or three all looks as after one."""
            parts = [j for j in dips if j < i and depth[j] > _AS_DEEP * depth[i]]
            parts = [j for j in parts if abs(lag(i) / lag(j) / round(lag(i) / lag(j)) - 1) < _MULTIPLE]
            return min(parts, default=i)

        out: list[float] = []
        for i in [*map(whole, dips[:2]), *dips[:2]]:
            for f in (1 / lag(i), 0.5 / lag(i)):
                if low <= f <= high and all(abs(f / g - 1) > 0.06 for g in out):
                    out.append(float(f))
        return out


def steps_of(obs: Observations, speed: Array) -> Steps:
    """The clock by which the legs' silhouettes repeat themselves best, seconds if none does so plainly.

    Args:
        speed: (T,) of the body over the ground, in any unit.
    """
    t, at = obs.t.numpy(), obs.at.numpy()
    bands = _bands(obs)
    smooth = gaussian_filter1d(speed, _SMOOTH / float(np.median(np.diff(t)))) if len(t) > 1 else speed
    relative = np.maximum(smooth / max(float(smooth.mean()), 1e-9), _SLOWEST)
    found = [_kept(bands, t, at, relative**power, power) for power in POWERS]
    deepest = [float(s.depth[s.dips()[0]]) if s.dips() else 0.0 for s in found]
    best = int(np.argmax(deepest))
    return found[best] if deepest[best] > _BETTER * deepest[0] else found[0]


def _kept(bands: Array, t: Array, at: Array, pace: Array, power: float) -> Steps:
    """Silhouettes (F, ...) of the clip's frames `at`, compared by a clock of `pace` (T,)."""
    clock = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * np.diff(t))])
    clock *= (t[-1] - t[0]) / max(clock[-1], 1e-9)
    then = clock[at]
    dt = float(np.median(np.diff(t[at]))) if len(at) > 1 else 1.0
    even = then[0] + dt * np.arange(round((then[-1] - then[0]) / dt) + 1)
    i = np.clip(np.searchsorted(then, even, "right") - 1, 0, max(len(then) - 2, 0))
    after = np.minimum(i + 1, len(then) - 1)
    share = ((even - then[i]) / np.maximum(then[after] - then[i], 1e-9)).clip(0, 1)[:, None, None]
    x = (1 - share) * bands[i] + share * bands[after]
    lags = np.arange(1, max(2, int(0.75 * len(x))))
    unlike = np.array([np.abs(x[k:] - x[:-k]).mean() if k < len(x) else 0.0 for k in lags])
    return Steps(power, clock, lags * dt, unlike)


def _bands(obs: Observations) -> Array:
    """(F, 16, 48) the lower half of each mask's box, where legs are."""
    bands = []
    for m, (u0, v0, u1, v1), empty in zip(obs.mask.numpy(), obs.box, obs.empty, strict=True):
        full = m.reshape(obs.K.height, obs.K.width)
        crop = full[int((v0 + v1) / 2) : int(v1) + 1, int(u0) : int(u1) + 1]
        bands.append(np.zeros(_BAND[::-1]) if empty or not crop.size else
                     cv2.resize(crop.astype(np.float32), _BAND, interpolation=cv2.INTER_AREA))  # fmt: skip
    return np.stack(bands)
