"""A camera's tremble against cameras and flow that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.pinhole import Intrinsics
from slomo.reconstruct.steady import steadied

T, K = 40, Intrinsics(320.0, 320.0, 159.5, 89.5, 320, 180)
CELLS = (23, 40)


def cameras(*, travels: bool) -> np.ndarray:
    """(T, 4, 4) looking along y with z up, turning slowly, beside a path or in one place."""
    out = np.tile(np.eye(4), (T, 1, 1))
    out[:, :3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    turn = Rotation.from_euler("z", 0.3 * np.sin(np.linspace(0, 3, T))[:, None]).as_matrix()
    out[:, :3, :3] = turn @ out[:, :3, :3]
    out[:, :3, 3] = [0.0, 0.0, 1.2]
    if travels:
        out[:, 0, 3] = np.linspace(0, 2, T)
    return out


def seen_flow(cameras: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(T-1, h, w, 2) px of a background of random depths, with a tenth of a pixel of noise."""
    h, w = CELLS
    v, u = np.mgrid[:h, :w]
    u, v = (u + 0.5) * K.width / w - 0.5, (v + 0.5) * K.height / h - 0.5
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], -1)
    out = np.empty((T - 1, h, w, 2))
    for k in range(T - 1):
        X = rays * rng.uniform(2, 20, (h, w, 1)) @ cameras[k, :3, :3].T + cameras[k, :3, 3]
        Y = (X - cameras[k + 1, :3, 3]) @ cameras[k + 1, :3, :3]
        out[k] = np.stack([K.fx * Y[..., 0] / Y[..., 2] + K.cx - u, K.fy * Y[..., 1] / Y[..., 2] + K.cy - v], -1)
    return out + rng.normal(0, 0.1, out.shape)


def spoiled(cameras: np.ndarray, degrees: float, rng: np.random.Generator) -> np.ndarray:
    out = cameras.copy()
    axis = rng.standard_normal((T, 3))
    axis *= np.radians(degrees) / np.linalg.norm(axis, axis=1, keepdims=True)
    out[:, :3, :3] = cameras[:, :3, :3] @ Rotation.from_rotvec(axis).as_matrix()
    return out


def off(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """(T,) degrees between the cameras' rotations."""
    return np.degrees(Rotation.from_matrix(A[:, :3, :3].swapaxes(1, 2) @ B[:, :3, :3]).magnitude())


@pytest.mark.parametrize("travels", [False, True])
def test_a_tremble_is_taken_back(travels):
    rng = np.random.default_rng(3)
    true = cameras(travels=travels)
    flow, background = seen_flow(true, rng), np.ones((T - 1, *CELLS), bool)
    # Some cells move on their own, as what is not masked may: most harmful where depth hides it.
    flow[:, :, : 4 if travels else 13] += [4.0, 1.0]
    steady = steadied(spoiled(true, 0.5, rng), K, flow, background)
    # What the errors of many frames have in common remains: differences do not tell it.
    assert np.mean(off(true, steady)) < 0.2
    np.testing.assert_array_equal(steady[:, :3, 3], true[:, :3, 3])


def test_a_camera_that_is_right_stays():
    rng = np.random.default_rng(4)
    true = cameras(travels=True)
    assert off(true, steadied(true, K, seen_flow(true, rng), np.ones((T - 1, *CELLS), bool))).max() < 0.02


def test_flow_that_knows_nothing_changes_nothing():
    """A wall without texture: the flow stays zero while the camera turns, always the same way."""
    true = cameras(travels=False)
    blank = np.zeros((T - 1, *CELLS, 2))
    np.testing.assert_array_equal(steadied(true, K, blank, np.ones((T - 1, *CELLS), bool)), true)
    trembling = spoiled(true, 0.5, np.random.default_rng(5))
    nothing = np.zeros((T - 1, *CELLS), bool)
    np.testing.assert_array_equal(steadied(trembling, K, blank, nothing), trembling)
