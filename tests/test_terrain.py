"""Ground of boxes, slopes and a height field: heights, normals, files."""

import json

import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.retarget import stage as retarget
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, HeightField, Slope, Terrain
from walking import walk

FIELD = HeightField(-1.0, -1.0, 0.5, ((0.0, 0.1, 0.05), (0.2, 0.0, 0.1), (0.0, 0.3, 0.0)))
ALL = Terrain((Box(1, 2, -1, 1, 0.3),), (Slope(0, 3, 0, 1, 0.1, 0.2, -0.1),), FIELD)


def test_known_heights():
    assert ALL.height(np.array([5.0, 5.0])) == 0.0
    assert ALL.height(np.array([1.5, -0.5])) == 0.3
    assert ALL.height(np.array([2.5, 0.5])) == pytest.approx(0.1 + 0.5 - 0.05)
    # The higher of box and slope.
    assert ALL.height(np.array([1.9, 0.5])) == pytest.approx(0.1 + 0.38 - 0.05)
    assert ALL.height(np.array([-0.5, -1.0])) == pytest.approx(0.2)
    assert ALL.height(np.array([-0.75, -0.75])) == pytest.approx((0.0 + 0.1 + 0.2 + 0.0) / 4)
    # A slope may lead below the plane z = 0.
    assert Terrain(slopes=(Slope(0, 1, 0, 1, -0.5),)).height(np.array([0.5, 0.5])) == -0.5


def test_planes_touch_the_ground_along_its_gradient():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 3, (500, 2))
    planes, e = ALL.planes(xy), 1e-6
    n, z = planes[:, :3], ALL.height(xy)
    assert np.linalg.norm(n, axis=1) == pytest.approx(np.ones(500))
    assert np.sum(n * np.column_stack([xy, z]), axis=1) == pytest.approx(planes[:, 3])
    assert ALL.normal(xy) == pytest.approx(n)
    slope = np.stack([(ALL.height(xy + d) - ALL.height(xy - d)) / (2 * e) for d in e * np.eye(2)], axis=1)
    smooth = np.abs(slope).max(axis=1) < 5  # not across an edge
    assert smooth.mean() > 0.99
    assert -n[smooth, :2] / n[smooth, 2:] == pytest.approx(slope[smooth], abs=1e-6)


def test_files(tmp_path):
    path = tmp_path / "hill.json"
    path.write_text(json.dumps(ALL.to_json()))
    assert Terrain.load(path) == ALL
    assert Terrain.from_json({}) == Terrain()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ('{"slopes": 3}', "lists"),
        ('{"hills": []}', "unknown entries"),
        ('{"boxes": [{"x_min": 0}]}', "box"),
        ('{"slopes": [{"x_min": 1, "x_max": 0, "y_min": 0, "y_max": 1}]}', "x_min < x_max"),
        ('{"field": {"x_min": 0, "y_min": 0, "spacing": 1, "z": [[1, 2], [3]]}}', "2 x 2"),
        ('{"field": {"x_min": 0, "y_min": 0, "spacing": 0, "z": [[1, 2], [3, 4]]}}', "spacing"),
    ],
)
def test_wrong_files_are_refused_by_name(tmp_path, text, message):
    path = tmp_path / "hill.json"
    path.write_text(text)
    with pytest.raises(InvalidData, match=message) as e:
        Terrain.load(path)
    assert "hill.json" in str(e.value)


def test_retargeting_lifts_feet_and_body_onto_it(tmp_path):
    path, robot = tmp_path / "hill.json", load_robot("go1")
    hill = Terrain(slopes=(Slope(-9, 9, -9, 9, -1.8, 0.2),))
    path.write_text(json.dumps(hill.to_json()))
    source = {"import": Artifact(npz={"keypoints.npz": walk().to_arrays()})}
    flat, steep = (
        retarget.run(Inputs(source, files, robot), retarget.Config(), Silent()) for files in ({}, {"terrain": path})
    )
    assert Terrain.from_json(steep.json["terrain.json"]) == hill
    a, b = (x.npz["keypoints.npz"]["keypoints"] for x in (flat, steep))
    feet = slice(-4, None)
    assert b[:, feet, :2] == pytest.approx(a[:, feet, :2])
    assert b[:, feet, 2] == pytest.approx(a[:, feet, 2] + hill.height(a[:, feet]))
    with pytest.raises(UsageError, match="step"):
        retarget.run(Inputs(source, {"terrain": path}, robot), retarget.Config(step_height=0.1), Silent())
