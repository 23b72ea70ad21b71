"""The verifier on ground that is not flat, between knots, and the contact sequence that it finds."""

from dataclasses import replace

import numpy as np
import pytest

from references import carrying, standing
from slomo.optimize.check import failure
from slomo.optimize.sequence import contact_sequence
from slomo.optimize.verify import verify
from slomo.terrain import Box, HeightField, Slope, Terrain
from test_verify import BODY, FEET, FLAT, HIND_LEFT, LEFT, MODEL, REST, RIGHT, failing, lifted, spoilt


def test_gap_force_and_friction_on_a_slope():
    """Standing on a slope: gaps and normal forces are along its normal, and gravity needs friction of its slope."""
    slope = 0.3
    ground = Terrain(slopes=(Slope(-9, 9, -9, 9, height=-9 * slope, slope_x=slope),))
    points = FEET + [0, 0, 1] * (slope * FEET[:, :1])
    assert np.allclose(ground.height(points), points[:, 2])
    rest = standing(MODEL, BODY, points)
    assert failing(MODEL, rest, terrain=ground, robot=None) == []
    slippery = verify(replace(MODEL, mu=slope - 1e-3), rest, terrain=ground)
    load = rest.lam[..., 2].max() / np.hypot(1, slope)
    assert slippery["friction_violation"].value == pytest.approx(1e-3 * load, rel=1e-6)
    assert failing(replace(MODEL, mu=slope + 1e-9), rest, terrain=ground, robot=None) == []
    off = standing(MODEL, BODY, points - [0, 0, 0.01])
    assert verify(MODEL, off, terrain=ground)["penetration"].value == pytest.approx(0.01 / np.hypot(1, slope))


def test_a_height_field_is_ground_too():
    grid = np.full((9, 9), 0.02)
    ground = Terrain(field=HeightField(-2, -2, 0.5, tuple(map(tuple, grid))))
    assert failing(MODEL, standing(MODEL, BODY, FEET + [0, 0, 0.02]), terrain=ground, robot=None) == []
    assert verify(MODEL, REST, terrain=ground)["penetration"].value == pytest.approx(0.02)


@pytest.mark.parametrize(("rise", "depth"), [(0.1, 0.05), (0.02, 0.01)])
def test_a_corner_cut_between_knots_is_a_warning(rise, depth):
    """The last step takes the foot through the edge of a box, half of it under the top and the wall far behind."""
    edge = FEET[LEFT, 0] + 0.001
    ground = Terrain((Box(edge, edge + 2, 0, 2, rise),))

    def points(p):
        p[-1, LEFT] += [0.2, 0, rise]

    def lam(f):
        f[-1] = carrying(MODEL, BODY[:3], FEET, on=[False, True, True, True])

    checks = verify(MODEL, spoilt(points, lam), terrain=ground)
    assert failure(checks) is None
    check = checks["penetration_between"]
    # Shallower than the top by what the way out sideways is shorter.
    assert 0.5 * depth < check.value < 2 * depth
    assert check.kept == (check.value <= 0.02)
    assert check.point == "front_left"
    assert REST.t[-2] < check.t < REST.t[-1]


def test_contact_sequence():
    found = contact_sequence(lifted(0.02), FLAT, names=MODEL.names)
    left, right = found["contacts"][:2]
    assert left == {
        "point": "front_left",
        "intervals": [[0.0, 0.95]],
        "duty_factor": pytest.approx(0.95),
    }
    assert right["intervals"] == [[0.0, 1.0]]
    assert found["touchdowns"] == []
    lam = REST.lam.copy()
    lam[3:6, RIGHT] = 0
    lam[:9, HIND_LEFT] = 0
    found = contact_sequence(replace(REST, lam=lam), FLAT, names=MODEL.names)
    assert found["touchdowns"] == [{"t": 0.3, "point": "front_right"}, {"t": 0.45, "point": "hind_left"}]
    assert [len(c["intervals"]) for c in found["contacts"]] == [1, 2, 1, 1]
