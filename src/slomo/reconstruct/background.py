"""What stands out from the background seen at other times: frames laid over each other by the homography of most
background tracks. Where the background is no such plane the laid-over frames disagree, and that says so."""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.reconstruct.tracks import Tracks

_NOISE = 9.0  # levels (of 255) in RGB that noise and sub-pixel shifts leave
_UNLIKE = 2.7  # times those levels, from which on nothing but shade explains a pixel by the background
_LIKE = 1.25  # times those levels, up to which a pixel is the background's own
PATTERN = 0.85  # correlation with the background, of what shows its pattern
_CONTRAST = 3.0  # levels, s.d. of a background that has a pattern
_OFTEN = 4  # frames that must show it
_AROUND = 0.7  # of the pixels around it, that must as well: single ones of a leg look like the ground by chance
_SURELY = -6.0  # log odds then: what moves there is a shadow, or the ground between legs
SHADOW = (0.3, 0.95)  # a cast shadow multiplies the ground's colour by a factor in this range


@dataclass(frozen=True)
class Overlay:
    """Frames shrunk to `size` (width, height) in RGB, and the tracks that lay them over each other."""

    rgb: np.ndarray  # (T, h, w, 3) uint8
    tracks: list[dict[int, np.ndarray]]
    factor: float

    @classmethod
    def of(cls, frames: np.ndarray, tracks: Tracks, size: tuple[int, int]) -> "Overlay":
        rgb = [cv2.GaussianBlur(cv2.resize(f, size, interpolation=cv2.INTER_AREA), (0, 0), 0.8) for f in frames]
        table: list[dict[int, np.ndarray]] = [{} for _ in frames]
        for t, i, xy in zip(tracks.frame.tolist(), tracks.track.tolist(), tracks.xy, strict=True):
            table[t][i] = xy
        return cls(np.array(rgb), table, size[0] / frames.shape[2])

    def homography(self, source: int, target: int) -> np.ndarray | None:
        """(3, 3) from shrunk pixels of `source` to those of `target`, or None when too few tracks last."""
        shared = sorted(self.tracks[source].keys() & self.tracks[target].keys())
        if len(shared) < 30:
            return None
        a, b = (self.factor * np.array([self.tracks[t][i] for i in shared]) for t in (source, target))
        cv2.setRNGSeed(0)
        model, inliers = cv2.findHomography(a, b, cv2.RANSAC, 1.0)
        return model if model is not None and inliers.mean() > 0.4 else None

    def evidence(self, t: int, covered: dict[int, np.ndarray], others: list[int]) -> np.ndarray:
        """(h, w) log odds, about -2 to 4, that a pixel of frame t is no background; 0 where that cannot be said, and -6
        where it surely is: seen alike, or darker with the same pattern, in several other frames.

        Args:
            covered: frame -> (h, w) bool, where the subject may be; such samples do not count.
            others: frames to lay over t.
        """
        h, w = self.rgb.shape[1:3]
        samples, valid = [], []
        for u in others:
            if (model := self.homography(t, u)) is None:
                continue
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            samples.append(cv2.warpPerspective(self.rgb[u].astype(np.float32), model, (w, h), flags=flags))
            free = (~covered[u]).astype(np.float32)
            valid.append(cv2.warpPerspective(free, model, (w, h), flags=flags, borderValue=0.0) > 0.7)
        if len(samples) < 2:
            return np.zeros((h, w), np.float32)
        x, ok = np.stack(samples), np.stack(valid)
        count = ok.sum(0)
        order = np.sort(np.where(ok[..., None], x, np.inf), axis=0)
        middle = np.clip((count - 1) // 2, 0, None)[None, ..., None]
        median = np.take_along_axis(order, middle, axis=0)[0]
        now = self.rgb[t].astype(np.float32)
        median = np.where(np.isfinite(median), median, now)
        spread = (np.abs(x - median).mean(-1) * ok).sum(0) / np.maximum(count, 1)
        odds, factor = log_odds(now, median, spread), shade_factor(now, median)
        like = np.linalg.norm(now - median, axis=-1) < _LIKE * (_NOISE + 1.5 * spread)
        shade = (factor > SHADOW[0]) & (factor < SHADOW[1]) & (alike(now.mean(-1), median.mean(-1)) > PATTERN)
        sure = (count >= _OFTEN) & (odds < 0) & (like | shade)
        sure &= cv2.boxFilter(sure.astype(np.float32), -1, (5, 5)) > _AROUND
        odds = np.where(sure, _SURELY, odds)
        return np.where(count >= 2, odds, 0.0).astype(np.float32)


def log_odds(
    now: np.ndarray,
    median: np.ndarray,
    spread: np.ndarray,
    noise: float = _NOISE,
    *,
    shade: float = -2.0,
    darkest: float = SHADOW[0],
) -> np.ndarray:
    """(h, w) about -2 to 4, that a pixel is no background.

    Args:
        now, median: (h, w, 3) RGB, now and in the background.  spread: (h, w), levels by which samples of the
            background differ.  noise: levels that always are.
        shade: least value where only shade makes the background look like that: a dark body may look so too.
        darkest: least factor by which shade multiplies the background.
    """
    size, level = np.linalg.norm(now - median, axis=-1), noise + 1.5 * spread
    factor = shade_factor(now, median)
    shaded = (factor > darkest) & (factor < SHADOW[1])
    ratio = np.where(shaded, np.linalg.norm(now - factor[..., None] * median, axis=-1), size) / level
    trust = np.clip(2.0 - spread / noise, 0.0, 1.0)  # of "like the background": nothing where samples disagree
    odds = np.clip(np.where(ratio > 2.0, 1.5 * (ratio - 2.0), trust * (ratio - 2.0)), -2.0, 4.0)
    return np.where(shaded & (size > _UNLIKE * level), np.maximum(odds, shade), odds)


def shade_factor(now: np.ndarray, median: np.ndarray) -> np.ndarray:
    """(h, w) by which the background (h, w, 3) is multiplied to look most like (h, w, 3) now."""
    return (now * median).sum(-1) / np.maximum((median**2).sum(-1), 1.0)


def alike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(h, w) correlation of two pictures (h, w) around every pixel, 0 where the second has no pattern."""
    mean = lambda x: cv2.boxFilter(x.astype(np.float32), -1, (9, 9))  # noqa: E731
    ma, mb = mean(a), mean(b)
    va, vb = mean(a * a) - ma * ma, mean(b * b) - mb * mb
    return np.where(vb > _CONTRAST**2, (mean(a * b) - ma * mb) / np.sqrt(np.maximum(va * vb, 1e-6)), 0.0)
