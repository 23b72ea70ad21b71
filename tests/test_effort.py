import itertools

import pytest

from slomo.reconstruct.effort import LIMBS, PHASES, Effort
from slomo.reconstruct.problem import Schedule

MANY = Effort(tuple(Schedule(n, 8, 100, ()) for n in (10, 12, 15, 30, 10, 10, 30, 30)), 4, 4)


@pytest.mark.parametrize("rare", [set(s) for n in range(4) for s in itertools.combinations(PHASES[LIMBS + 1 :], n)])
def test_progress_never_goes_back(rare: set[str]):
    told, over = [], []
    for phase in (p for p in PHASES if PHASES.index(p) <= LIMBS or p in rare):
        told += [MANY.reached(over, phase, share) for share in (0.0, 0.5, 1.0)]
        over.append(phase)
    assert told == sorted(told)
    assert told[0] == 0
    assert 0.8 < told[-1] <= 1
    assert told[-1] == pytest.approx(1) or PHASES[-1] not in rare


def test_progress_without_any_work():
    none = Effort(tuple(Schedule(0, 8, 100, ()) for _ in PHASES), 4, 4)
    assert none.reached(PHASES[:3], "final") == 0
