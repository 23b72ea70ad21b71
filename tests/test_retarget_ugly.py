"""Retargeting of spoiled input, drawn at random: a robot-sized motion within reach, or one clear line why not."""

from collections.abc import Callable

import numpy as np
import pytest

import ugly
from slomo.errors import InvalidData
from slomo.motion import KeypointMotion
from slomo.retarget.stage import Config, run
from slomo.robot import Robot, load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Terrain

ROBOTS = {"go1": load_robot("go1"), "g1": load_robot("g1")}
SPEED = 6.0  # m/s: what no foot or hand of these animals and people reaches in the robot's size


def retarget(motion: KeypointMotion, robot: Robot, options: dict) -> tuple[KeypointMotion, Terrain, dict]:
    source = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    out = run(Inputs(artifacts={"import": source}, robot=robot), Config(**options), Silent())
    terrain = Terrain.from_json(out.json["terrain.json"])
    return KeypointMotion.from_arrays(out.npz["keypoints.npz"]), terrain, out.json["report.json"]


@pytest.mark.parametrize(("draw", "name"), [(ugly.quadruped, "go1"), (ugly.human, "g1")])
@pytest.mark.parametrize("seed", range(12))
def test_spoiled_input_gives_a_motion_or_a_reason(draw: Callable[[int], ugly.Ugly], name: str, seed: int):
    case, robot = draw(seed), ROBOTS[name]
    assert 0.3 <= case.friction <= 1.0
    refused = ""
    try:
        motion, terrain, report = retarget(case.motion, robot, case.options)
    except InvalidData as e:
        refused = str(e)
    if refused:
        # Of what the generator does, only a step may not fit.
        assert case.options, (case.done, refused)
        assert "a step does not fit" in refused, case.done
        return
    points = np.stack([motion[n] for n in robot.key_points], axis=1)
    hips = np.stack([motion[f"{n}_hip"] for n in robot.limb_names], axis=1)
    distance = np.linalg.norm(points - hips, axis=2)
    assert np.all(distance <= robot.leg_reach[:, 1] + 1e-6), case.done
    assert np.all(points[..., 2] >= terrain.height(points) - 1e-9), case.done
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=2).max() / (motion.t[1] - motion.t[0])
    assert speed < SPEED, case.done
    ground = terrain.height(motion["base"])
    assert np.all(motion["base"][:, 2] > ground + 0.3 * robot.standing_height), case.done
    assert np.all(motion["base"][:, 2] < 1.6 * robot.standing_height + 0.1), case.done
    assert np.linalg.norm(motion["base"][0, :2]) < 1e-9
    assert report["scale"] > 0


def test_the_generator_repeats_itself():
    a, b = ugly.human(3), ugly.human(3)
    np.testing.assert_array_equal(a.motion.positions, b.motion.positions)
    assert (a.friction, a.options, a.done) == (b.friction, b.options, b.done)
