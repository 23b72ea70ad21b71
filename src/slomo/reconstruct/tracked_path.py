"""The path of a moving camera from background tracks alone, all frames at once.

Incremental structure from motion grows from one pair of frames. Where those see little but a plane, two motions explain
them (Longuet-Higgins, Proc. R. Soc. B 1986), and the wrong one, once taken, is kept to the end with small errors.
Here two steps take turns, each over all frames: positions and points of known rotations, which is a linear problem
(as Kahl and Hartley, PAMI 2008, by reweighted squares instead of the largest error), and rotations and positions that
obey the epipolar constraint of every pair of frames (Sampson distance; Hartley and Zisserman, 2nd ed., eq. 11.9).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.reconstruct.pairwise import huber_cost, minimise
from slomo.reconstruct.rotation_ba import RotationFit, skew
from slomo.reconstruct.tracks import Tracks

_MOST_SHARED = 40  # correspondences of two frames, on average, that are used
_MOST_TRACKS = 2000
_ROUNDS = 6
_SETTLED = 0.98  # of the cost before, above which another round is of no use
# Of the cost with the focal length that is given, below which another one is taken. A wrong one bends the path of a
# camera that turns far, and bundle adjustment does not find back from there; elsewhere the tracks hardly tell it.
_BETTER = 0.9
IN_FRONT = 0.97  # part of the tracks' sightings whose points must lie before the camera, for a path to be used
# Weight of the path's second differences, of the mean weight that the tracks give a frame's position: while rotations
# are wrong, and when they are right.
_SMOOTH, _SETTLED_SMOOTH = 1e-2, 1e-5


@dataclass(frozen=True)
class TrackedPath:
    """Result.

    Attributes:
        T_world_cam: (N, 4, 4) OpenCV convention; the first frame's camera is the world, the scale is arbitrary.
        focal: px.
        cost: of `Epipolar.cost`.
        in_front: part of the sightings whose point lies before the camera.
        agreed: whether another start led to the same; never where the focal length was freed.
    """

    T_world_cam: np.ndarray
    focal: float
    cost: float
    in_front: float
    agreed: bool = False


class Epipolar:
    """Correspondences of tracks between N frames, as many of them far apart as near.

    Attributes:
        least_shared: least number of tracks that go on from one of the frames to the next.

    Args:
        keys: (N,) increasing frames.  gaps: distances between them that are compared, counted in keys.
        center: (2,) px, principal point.
    """

    def __init__(self, tracks: Tracks, keys: np.ndarray, gaps: tuple[int, ...], center: np.ndarray, seed: int):
        which, first, second = tracks.pairs(gaps, keys)
        rng = np.random.default_rng(seed)
        gap = which[:, 1] - which[:, 0]
        drawn = []
        for g in np.unique(gap):
            rows = np.flatnonzero(gap == g)
            drawn.append(rng.choice(rows, min(len(rows), _MOST_SHARED * len(keys)), replace=False))
        rows = np.sort(np.concatenate(drawn)) if drawn else np.zeros(0, int)
        self.least_shared = int(np.bincount(which[gap == 1, 0], minlength=len(keys) - 1).min())
        self.count = len(keys)
        self.i, self.j = which[rows].T
        self.x, self.y = first[rows] - center, second[rows] - center

    def cost(self, T_world_cam: np.ndarray, focal: float) -> float:
        """px^2, mean Huber loss of the Sampson distances under cameras (N, 4, 4)."""
        residual, _ = self.linearise((T_world_cam[:, :3, :3], T_world_cam[:, :3, 3], focal))
        return huber_cost(np.abs(residual[:, 0])) / max(1, len(residual))

    def linearise(self, state) -> tuple[np.ndarray, np.ndarray]:
        """Sampson distances (P, 1) px of rotations (N, 3, 3), positions (N, 3) and focal length, and their derivatives
        (P, 1, 13) by turn (of the camera frame) and shift (of the world) of frame i and of frame j, and log focal."""
        R, p, focal = state
        one = np.ones(len(self.x))
        a, b = np.column_stack([self.x / focal, one]), np.column_stack([self.y / focal, one])
        Ri, Rj = R[self.i], R[self.j]
        Rij = np.swapaxes(Rj, 1, 2) @ Ri
        t = np.einsum("pba,pb->pa", Rj, p[self.i] - p[self.j])
        E = skew(t) @ Rij
        q, s = np.einsum("pab,pb->pa", E, a), np.einsum("pba,pb->pa", E, b)
        n = (b * q).sum(-1)
        d = np.sqrt((q[:, :2] ** 2).sum(-1) + (s[:, :2] ** 2).sum(-1)) + 1e-12
        dn, dq, ds = np.empty((len(a), 13)), np.empty((len(a), 3, 13)), np.empty((len(a), 3, 13))
        u = np.einsum("pab,pb->pa", Rij, a)
        back = np.swapaxes(Rij, 1, 2)
        turn_a = -skew(t) @ Rij @ skew(a)
        dn[:, :3], dq[:, :, :3], ds[:, :, :3] = np.cross(a, s), turn_a, skew(s)
        dn[:, 3:6], dq[:, :, 3:6], ds[:, :, 3:6] = np.cross(b, q), skew(q), -np.swapaxes(E, 1, 2) @ skew(b)
        shift = np.swapaxes(Rj, 1, 2)
        by_t = np.einsum("pa,pab->pb", np.cross(u, b), shift), -skew(u) @ shift, back @ skew(b) @ shift
        dn[:, 6:9], dq[:, :, 6:9], ds[:, :, 6:9] = by_t
        dn[:, 9:12], dq[:, :, 9:12], ds[:, :, 9:12] = (-v for v in by_t)
        da, db = -a * [1, 1, 0], -b * [1, 1, 0]
        dn[:, 12] = (s * da).sum(-1) + (q * db).sum(-1)
        dq[:, :, 12], ds[:, :, 12] = np.einsum("pab,pb->pa", E, da), np.einsum("pba,pb->pa", E, db)
        dd = (np.einsum("pa,pab->pb", q[:, :2], dq[:, :2]) + np.einsum("pa,pab->pb", s[:, :2], ds[:, :2])) / d[:, None]
        r = focal * n / d
        jacobian = focal * dn / d[:, None] - r[:, None] * dd / d[:, None]
        jacobian[:, 12] += r
        # Frame by frame: turn and shift of i, turn and shift of j.
        order = [0, 1, 2, 6, 7, 8, 3, 4, 5, 9, 10, 11, 12]
        return r[:, None], jacobian[:, None, order]


def track_path(
    epipolar: Epipolar,
    tracks: Tracks,
    keys: np.ndarray,
    center: np.ndarray,
    focal: float,
    seed: int,
    turning: np.ndarray,
    *,
    freed: RotationFit | None,
) -> list[TrackedPath]:
    """Cameras of the frames `keys` (N,): with the focal length that is given, and with one of their own where that
    explains the tracks better, or where it is in doubt; the better first. Empty where no track is seen in three of the
    frames, which alone tells how far each is from the next.

    Args:
        epipolar: correspondences of the tracks between these frames.
        center: (2,) px, principal point.  focal: px; kept where another one explains the tracks little better.
        seed: of the draw of tracks where there are many.
        turning: (N, 3, 3) rotations of a camera of this focal length that only turns and explains as much as it can.
            Which part of them is travel is unknown: the path is sought from all of them, none and half, until two
            agree. (One of refined focal length turns by several times as much where there is parallax.)
        freed: the turning camera whose focal length is refined: where there is hardly any parallax it is nearly right,
            and the path with a focal length of its own is sought from it too. None keeps the focal length.
    """
    sightings = _Sightings(tracks, keys, center, seed)
    if len(sightings.track) == 0:
        return []
    turns = Rotation.from_matrix(turning[0].T @ turning).as_rotvec()
    found: list[TrackedPath] = []
    for share in (1.0, 0.0, 0.5):
        start = Rotation.from_rotvec(share * turns).as_matrix()
        found.append(_from(epipolar, sightings, start, focal, free_focal=False))
        found.sort(key=lambda path: path.cost)
        if len(found) > 1 and _SETTLED * found[1].cost < found[0].cost:
            found[0] = replace(found[0], agreed=True)
            break
    kept = found[0]
    if freed is None:
        return [kept]
    starts = (kept.T_world_cam[:, :3, :3], focal), (freed.R_world_cam, freed.focal)
    other = min((_from(epipolar, sightings, *start, free_focal=True) for start in starts), key=lambda path: path.cost)
    if other.cost < _BETTER * kept.cost:
        return [other, kept]
    return [kept] if kept.agreed else [kept, other]


def _from(epipolar: Epipolar, sightings: "_Sightings", R: np.ndarray, focal: float, *, free_focal: bool) -> TrackedPath:
    """The path from rotations R (N, 3, 3)."""
    N, last = len(R), np.inf

    def move(state, step):
        R, p, focal = state
        turn = step[:-1].reshape(N, 6)
        return R @ Rotation.from_rotvec(turn[:, :3]).as_matrix(), p + turn[:, 3:], focal * float(np.exp(step[-1]))

    for _ in range(_ROUNDS):
        start = R, sightings.positions(R, focal, _SMOOTH)[0], focal
        found = minimise(
            start,
            epipolar.linearise,
            move,
            epipolar.i,
            epipolar.j,
            N,
            np.arange(6, 6 * N + free_focal),
            iterations=15,
            settled=1e-4,
        )
        R, _, focal = found.state
        if found.cost > _SETTLED * last:
            break
        last = found.cost
    # Of frames along one line, pairs tell directions only: how far each is from the next, the points do.
    p, in_front = sightings.positions(R, focal, _SETTLED_SMOOTH)
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R[0].T @ R, (p - p[0]) @ R[0]
    return TrackedPath(T, focal, epipolar.cost(T, focal), in_front)


class _Sightings:
    """Tracks that are seen in three of the frames `keys` or more."""

    def __init__(self, tracks: Tracks, keys: np.ndarray, center: np.ndarray, seed: int):
        at = tracks.places(keys)
        times = np.bincount(tracks.track[at >= 0])
        enough = np.flatnonzero(times >= 3)
        if len(enough) > _MOST_TRACKS:
            enough = np.random.default_rng(seed).choice(enough, _MOST_TRACKS, replace=False)
        keep = (at >= 0) & np.isin(tracks.track, enough)
        order = np.lexsort((at[keep], tracks.track[keep]))
        self.frame = at[keep][order]
        _, self.track = np.unique(tracks.track[keep][order], return_inverse=True)
        self.xy, self.count = tracks.xy[keep][order] - center, len(keys)

    def positions(self, R: np.ndarray, focal: float, smooth: float, iterations: int = 8) -> tuple[np.ndarray, float]:
        """Positions (N, 3) of cameras with rotations R (N, 3, 3) and this focal length, px, the first at the origin,
        that see the tracks' points with the least reprojection error; and which part of the sightings are of points in
        front.

        The squared distances between points and rays, divided by the squared depths of the step before, are those of
        the reprojection errors. The mean weighted depth is 1, or all would shrink to one place. Rotations that are
        still wrong leave room for jumps; a hand has none, hence the weight on second differences.
        """
        N, frame, track = self.count, self.frame, self.track
        M = int(track.max()) + 1
        ray = np.column_stack([self.xy / focal, np.ones(len(self.xy))])
        ray = np.einsum("pab,pb->pa", R[frame], ray / np.linalg.norm(ray, axis=-1, keepdims=True))
        across = np.eye(3) - ray[:, :, None] * ray[:, None]
        start = np.flatnonzero(np.r_[True, np.diff(track) != 0])
        bend = np.diff(np.eye(N), 2, axis=0)
        bend = np.kron(bend.T @ bend, np.eye(3))
        weight, p, depth = np.ones(len(ray)), np.zeros((N, 3)), np.ones(len(ray))
        for _ in range(iterations):
            A = across * weight[:, None, None]
            by_point = np.add.reduceat(A, start, axis=0)
            by_point += 1e-9 * np.trace(by_point, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            both = np.zeros((M, 3, N, 3))
            both[track, :, frame] = A
            both = both.reshape(M, 3, 3 * N)
            H = np.zeros((N, N, 3, 3))
            np.add.at(H, (frame, frame), A)
            H = H.transpose(0, 2, 1, 3).reshape(3 * N, 3 * N)
            points = np.linalg.solve(by_point, both)  # (M, 3, 3 N): the points are linear in the positions
            H -= both.reshape(3 * M, 3 * N).T @ points.reshape(3 * M, 3 * N)
            H += smooth * np.trace(H) / N * bend
            along = ray * np.sqrt(weight)[:, None]
            c = np.einsum("ma,mac->c", np.add.reduceat(along, start, axis=0), points)
            own = np.zeros((N, 3))
            np.add.at(own, frame, along)
            c -= own.ravel()
            free = np.linalg.solve(H[3:, 3:] + 1e-9 * np.trace(H) / N * np.eye(3 * N - 3), c[3:])
            flat = np.r_[np.zeros(3), free / (c[3:] @ free)]
            p = flat.reshape(N, 3)
            away = (points @ flat)[track] - p[frame]
            depth = (away * ray).sum(-1)
            size = np.maximum(np.abs(depth), 0.1 * np.median(np.abs(depth)))
            error = focal * (np.linalg.norm(away - depth[:, None] * ray, axis=-1) / size + (depth < 0))
            weight = np.minimum(1.0, np.maximum(1.0, np.median(error)) / np.maximum(error, 1e-6)) / size**2
            weight /= weight.mean()
        return p / np.linalg.norm(np.diff(p, axis=0), axis=-1).mean(), float((depth > 0).mean())
