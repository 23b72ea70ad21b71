"""Alignment of point sets."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slomo.rotation import kabsch, rot_z, umeyama, yaw


@pytest.mark.parametrize("seed", range(5))
def test_umeyama_finds_the_similarity(seed: int):
    rng = np.random.default_rng(seed)
    X, R = rng.normal(size=(7, 3)), Rotation.random(rng=rng).as_matrix()
    s, p = rng.uniform(0.2, 5), rng.normal(size=3)
    got = umeyama(X, s * X @ R.T + p)
    assert got[0] == pytest.approx(s)
    np.testing.assert_allclose(got[1], R, atol=1e-9)
    np.testing.assert_allclose(got[2], p, atol=1e-9)


def test_never_a_reflection():
    X = np.random.default_rng(0).normal(size=(9, 3))
    R, _ = kabsch(X, X * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1)


def test_weights_leave_an_outlier_out():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(6, 3))
    Y = X @ rot_z(0.7).T
    Y[0] += 100
    R, _ = kabsch(X, Y, weights=np.array([0, 1, 1, 1, 1, 1.0]))
    assert yaw(R) == pytest.approx(0.7)
