import numpy as np

from slomo.runs import runs


def test_runs_have_a_start_and_an_exclusive_end():
    assert runs(np.array([True, True, False, True, False, True])) == [(0, 2), (3, 4), (5, 6)]
    assert runs(np.ones(4, bool)) == [(0, 4)]
    assert runs(np.zeros(3, bool)) == runs(np.zeros(0, bool)) == []
