"""How right networks are: parts, key points, left and right, the view. Distances are fractions of sqrt(mask area)."""

from collections.abc import Sequence

import numpy as np

from slomo.prior.labels import BINS, rotation_of, view_of

Array = np.ndarray

PCK = 0.2  # of the square root of the mask's area: a key point this near is right
VIEW = np.radians(20.0)  # a view this near is right
APART = 0.1  # left and right that are nearer in the picture than this cannot be told
FEET = ("_paw", "_toe")


def azimuth_of(view: Array) -> Array:
    """(...,) rad: where probabilities (..., 36) are highest, between bins by the parabola of logarithms."""
    k = view.argmax(-1)
    logs = np.log(np.maximum(view, 1e-6))
    before, at, after = (np.take_along_axis(logs, ((k + d) % BINS)[..., None], -1)[..., 0] for d in (-1, 0, 1))
    angle = (k + (after - before) / np.maximum(2 * (2 * at - before - after), 1e-6)) * (2 * np.pi / BINS)
    return (angle + np.pi) % (2 * np.pi) - np.pi


def azimuth_error(azimuth: Array, true: Array) -> Array:
    """(...,) rad in [0, pi]."""
    return np.abs((azimuth - true + np.pi) % (2 * np.pi) - np.pi)


def rotation_error(R: Array, true: Array) -> Array:
    """(...,) rad between rotations (..., 3, 3)."""
    return np.arccos(np.clip((np.einsum("...ij,...ij->...", R, true) - 1) / 2, -1, 1))


def view_errors(view: Array, up: Array, true: Array) -> tuple[Array, Array]:
    """Azimuth error and full rotation error (F,) rad. Args: view (F, 36), up (F, 3), true R_view_body (F, 3, 3)."""
    azimuth = azimuth_of(view)
    return azimuth_error(azimuth, view_of(true)[0]), rotation_error(rotation_of(azimuth, up), true)


def feet(names: Sequence[str]) -> Array:
    """(K,) bool: paws and toes."""
    return np.array([name.endswith(FEET) for name in names])


def leg_pairs(names: Sequence[str]) -> Array:
    """(L, 2) indices of the left and right joints of legs, from elbow or knee downwards (the hips hardly differ)."""
    ends = ("_elbow", "_wrist", "_paw", "_knee", "_hock", "_ankle", "_toe")
    left = [i for i, n in enumerate(names) if "left" in n and n.endswith(ends)]
    human = "left_toe" in names  # arms are no legs
    left = [i for i in left if not (human and names[i].endswith(("_elbow", "_wrist")))]
    return np.array([(i, list(names).index(names[i].replace("left", "right"))) for i in left]).reshape(-1, 2)


def sides_right(predicted: Array, true: Array, size: Array, names: Sequence[str]) -> Array:
    """(F, L) 1 where a pair of legs is nearer to the truth as it is than swapped, 0 the other way, NaN if not to tell.

    Args:
        predicted, true: (F, K, 2) px.  size: (F,) px, sqrt of the mask's area.
    """
    left, right = leg_pairs(names).T
    d = [[np.linalg.norm(predicted[:, i] - true[:, j], axis=-1) for j in (left, right)] for i in (left, right)]
    as_is, swapped = d[0][0] + d[1][1], d[0][1] + d[1][0]
    apart = np.linalg.norm(true[:, left] - true[:, right], axis=-1) > APART * size[:, None]
    return np.where(apart & np.isfinite(as_is), (as_is < swapped).astype(float), np.nan)


def keypoint_errors(predicted: Array, true: Array, size: Array) -> Array:
    """(F, K) distances over sqrt(mask area)."""
    return np.linalg.norm(predicted - true, axis=-1) / size[:, None]


def share(x: Array) -> float:
    """Mean of what is known; NaN when nothing is."""
    known = np.isfinite(x)
    return float(x[known].mean()) if known.any() else float("nan")


def within(error: Array, limit: float) -> float:
    """Share of the known errors that are at most `limit`."""
    known = np.isfinite(error)
    return float((error[known] <= limit).mean()) if known.any() else float("nan")


class PartScore:
    """Intersection over union of part labels, counted over many pictures."""

    def __init__(self, count: int):
        self._confusion = np.zeros((count, count))

    def add(self, predicted: Array, true: Array) -> None:
        """Label images of the same shape."""
        n = len(self._confusion)
        self._confusion += np.bincount(true.ravel() * n + predicted.ravel(), minlength=n * n).reshape(n, n)

    def iou(self) -> Array:
        """(P,) of the parts, without the background; NaN for parts never met."""
        both = np.diag(self._confusion)
        either = self._confusion.sum(0) + self._confusion.sum(1) - both
        with np.errstate(invalid="ignore"):
            return (both / either)[1:]
