"""Robust least squares over cameras that are compared two by two: correspondences of one pair of frames share their
columns, so that thousands of them are summed before they are put in their places."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

HUBER = 0.5  # px, where the loss turns linear


@dataclass(frozen=True)
class Minimum:
    """Where it ended.

    Attributes:
        state: what `move` makes.
        residual: (P, K) px.  cost: px^2, the sum of the Huber losses.
        hessian: (W N + 1, W N + 1) J^T W J there.
    """

    state: Any
    residual: np.ndarray
    cost: float
    hessian: np.ndarray


def huber_cost(length: np.ndarray) -> float:
    """Sum of the Huber losses of residuals (P,) px."""
    return float(np.where(length < HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER)).sum())


def minimise(
    state: Any,
    linearise: Callable[[Any], tuple[np.ndarray, np.ndarray]],
    move: Callable[[Any, np.ndarray], Any],
    i: np.ndarray,
    j: np.ndarray,
    count: int,
    free: np.ndarray,
    *,
    iterations: int = 40,
    settled: float = 1e-7,
) -> Minimum:
    """Levenberg-Marquardt with Huber weights.

    Args:
        linearise: residuals (P, K) px and derivatives (P, K, 2 W + 1) by the W parameters of frame i, those of frame j,
            and the one that all share.
        move: the state after a step (W N + 1,): W of each frame, the shared one last.
        i, j: (P,) frames of each correspondence, of `count` frames.
        free: (F,) places in the step that may change; the others are the gauge.
        settled: part of the cost that a step must take away for another to follow.
    """
    residual, jacobian = linearise(state)
    best, damping = (state, residual, huber_cost(np.linalg.norm(residual, axis=-1))), 1e-3
    hessian, gradient = normal_equations(residual, jacobian, i, j, count)
    for _ in range(iterations):
        H = hessian[np.ix_(free, free)]
        step = np.zeros(len(hessian))
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(len(free)), gradient[free])
        state = move(best[0], step)
        residual, jacobian = linearise(state)
        cost = huber_cost(np.linalg.norm(residual, axis=-1))
        if cost < best[2]:
            done = best[2] - cost < settled * cost
            best, damping = (state, residual, cost), damping / 5
            hessian, gradient = normal_equations(residual, jacobian, i, j, count)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return Minimum(*best, hessian)


def normal_equations(residual, jacobian, i, j, count):
    """J^T W J and J^T W r, W the Huber weights, over the parameters of `count` frames and the shared one."""
    width = (jacobian.shape[-1] - 1) // 2
    size = width * count + 1
    weight = HUBER / np.maximum(np.linalg.norm(residual, axis=-1), HUBER)
    H, g = np.zeros((size, size)), np.zeros(size)
    order = np.lexsort((j, i))
    i, j, jacobian = i[order], j[order], jacobian[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(i) != 0) | (np.diff(j) != 0)])
    weighted = jacobian * weight[order, None, None]
    blocks = np.add.reduceat(np.swapaxes(weighted, 1, 2) @ jacobian, starts, axis=0)
    slopes = np.add.reduceat((weighted * residual[order, :, None]).sum(1), starts, axis=0)
    own = np.arange(width)
    for a, b, block, slope in zip(i[starts], j[starts], blocks, slopes, strict=True):
        columns = np.r_[width * a + own, width * b + own, size - 1]
        H[np.ix_(columns, columns)] += block
        g[columns] += slope
    return H, g
