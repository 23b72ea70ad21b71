"""Background feature tracks: corners followed by Lucas-Kanade from frame to frame, outside the subject's mask."""

from dataclasses import dataclass

import cv2
import numpy as np

_LK = {"winSize": (15, 15), "maxLevel": 3, "criteria": (3, 20, 0.01)}
_MAX_ROUND_TRIP = 0.4  # px, forward-backward error above which a track ends
_BLANK = 2.0  # levels (of 255), standard deviation of a picture below which its corners are noise
# Part of the corners that must be found again. In another picture one to three in a hundred are, by chance.
_GO_ON = 0.05  # in the next frame, or all are taken for lost there
_COME_BACK = 0.2  # in a later one, for those that were lost
_BRIDGED = 15  # frames after which corners that were lost are given up


@dataclass(frozen=True)
class Tracks:
    """Observations of tracked corners.

    Attributes:
        frame, track: (M,) int, which frame and which track.
        xy: (M, 2) px.
    """

    frame: np.ndarray
    track: np.ndarray
    xy: np.ndarray

    def places(self, frames: np.ndarray) -> np.ndarray:
        """(M,) the place in `frames`, which increase, of each observation's frame; -1 of those that are not there."""
        at = np.searchsorted(frames, self.frame).clip(max=len(frames) - 1)
        return np.where(frames[at] == self.frame, at, -1)

    def pairs(self, gaps: tuple[int, ...], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Correspondences between frames of `frames` that lie `gaps` places apart in it.

        Returns (P, 2) places in `frames`, (P, 2) px in the first and (P, 2) px in the second.
        """
        place = self.places(frames)
        keep = place >= 0
        k, track, xy = place[keep], self.track[keep], self.xy[keep]
        order = np.lexsort((k, track))
        k, track, xy = k[order], track[order], xy[order]
        # Both sorted by track, then place: a track that ends does not run on into the next one.
        width = int(k.max(initial=0)) + max(gaps) + 1
        code = track * width + k
        which, first, second = [], [], []
        for gap in gaps:
            at = np.searchsorted(code, code + gap).clip(max=len(code) - 1)
            here = np.flatnonzero(code[at] == code + gap)
            there = at[here]
            which.append(np.column_stack([k[here], k[there]]))
            first.append(xy[here])
            second.append(xy[there])
        return np.concatenate(which), np.concatenate(first), np.concatenate(second)

    def rows_by_frame(self, T: int) -> list[np.ndarray]:
        """Indices of the observations in each of T frames, by increasing track."""
        order = np.lexsort((self.track, self.frame))
        return np.split(order, np.searchsorted(self.frame[order], np.arange(1, T)))


def follow(a: np.ndarray, b: np.ndarray, xy: np.ndarray, guess: np.ndarray | None = None):
    """Follow points (N, 2) px from gray image a to b. Returns (N, 2) px and (N,) bool, which ones came home again."""
    if len(xy) == 0:
        return xy, np.zeros(0, bool)
    p = xy.astype(np.float32)[:, None]
    options = dict(_LK) | ({"flags": cv2.OPTFLOW_USE_INITIAL_FLOW} if guess is not None else {})
    start = None if guess is None else guess.astype(np.float32)[:, None].copy()
    q, found, _ = cv2.calcOpticalFlowPyrLK(a, b, p, start, **options)  # type: ignore[call-overload]
    home, found_home, _ = cv2.calcOpticalFlowPyrLK(b, a, q, p.copy(), **_LK, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)  # type: ignore[call-overload]
    good = (found[:, 0] > 0) & (found_home[:, 0] > 0) & (np.linalg.norm(home - p, axis=-1)[:, 0] < _MAX_ROUND_TRIP)
    h, w = a.shape
    end = q[:, 0]
    return end, good & (end[:, 0] > 1) & (end[:, 0] < w - 2) & (end[:, 1] > 1) & (end[:, 1] < h - 2)


@dataclass(frozen=True)
class _Corners:
    """Corners xy (N, 2) px of tracks `ids` (N,) in frame t, whose gray picture is `image`."""

    t: int
    image: np.ndarray
    xy: np.ndarray
    ids: np.ndarray

    def followed(self, image: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those that are found in another picture (H, W) where it is `free` (H, W): their places and their tracks."""
        xy, good = follow(self.image, image, self.xy)
        col, row = xy.round().astype(int).T.clip(0)
        good &= free[row.clip(0, image.shape[0] - 1), col.clip(0, image.shape[1] - 1)]
        return xy[good], self.ids[good]


def background_tracks(frames: np.ndarray, masks: np.ndarray, *, corners: int = 500, progress=lambda f: None) -> Tracks:
    """Corners of (T, H, W, 3) uint8 RGB frames outside (T, H, W) masks, topped up to `corners` in every frame.

    A blank frame, or a flash, ends no track: corners that are lost all at once are looked for in the frames after it,
    too. After a cut they are not found.
    """
    side = max(frames.shape[1:3])
    around = np.ones((max(3, side // 40) | 1,) * 2, np.uint8)
    distance = side / 70
    count = 0
    waiting: list[_Corners] = []  # those of the frame before, and those that were lost
    seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for t, (frame, mask) in enumerate(zip(frames, masks, strict=True)):
        image = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        free = cv2.dilate(mask.astype(np.uint8), around) == 0
        if image.std() < _BLANK:
            free[:] = False
        found, lost = [(np.zeros((0, 2), np.float32), np.zeros(0, int))], []
        for group in waiting:
            xy, ids = group.followed(image, free)
            if len(xy) >= (_GO_ON if group.t == t - 1 else _COME_BACK) * len(group.xy):
                found.append((xy, ids))
            elif t - group.t < _BRIDGED:
                lost.append(group)
        xy, ids = (np.concatenate(column) for column in zip(*found, strict=True))
        if len(xy) < 0.8 * corners:
            room = free.astype(np.uint8) * 255
            for x, y in xy:
                cv2.circle(room, (int(x), int(y)), int(distance), 0, -1)
            new = cv2.goodFeaturesToTrack(image, corners - len(xy), 0.005, distance, mask=room)
            if new is not None:
                xy = np.concatenate([xy, new[:, 0]])
                ids = np.concatenate([ids, count + np.arange(len(new))])
                count += len(new)
        seen.append((np.full(len(xy), t), ids, xy))
        waiting = [_Corners(t, image, xy, ids), *lost]
        progress((t + 1) / len(frames))
    return Tracks(*(np.concatenate(column) for column in zip(*seen, strict=True)))
