"""Randomised trials: what they do to the robot, their statistics, and how a run goes on after it was killed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from references import standing
from slomo.errors import UsageError
from slomo.pointfoot import PointFootModel
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, Terrain
from slomo.track import trials
from slomo.track.trial import ROWS, Result, describe, make_world, parse_trial
from slomo.track.trials_report import as_text, summary, wilson

ROBOT = load_robot("go1")
MODEL = PointFootModel.from_robot(ROBOT)
FEET = ROBOT.nominal_feet + [0, 0, ROBOT.standing_height]
STAND = standing(MODEL, np.array([0, 0, ROBOT.standing_height, 0, 0, 0, 1.0]), FEET, steps=80)
STEP = Terrain((Box(0.1, 1.0, -1.0, 1.0, 0.1),))


def walk():
    """A reference whose feet stand still at places further and further ahead."""
    q, v = STAND.q.copy(), STAND.v.copy()
    ahead = 0.3 * np.arange(len(q)) // 10 * 0.3
    q[:, 0::3][:, :1] += ahead[:, None]
    for c in range(4):
        q[:, 7 + 3 * c] += ahead
    return replace(STAND, q=q, v=v)


def world(row, number=0, *, seed=0, reference=STAND, terrain=STEP):
    found = make_world(row, number, seed=seed, reference=reference, terrain=terrain)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (95, 100, 0.8882, 0.9785), (7, 20, 0.1812, 0.5671)],
)
def test_wilson_interval_against_published_values(successes, n, low, high):
    assert wilson(successes, n) == pytest.approx((low, high), abs=1e-4)


def test_intervals_cover_the_true_rate():
    """Of intervals of binomial samples about 95 % hold the rate that made them."""
    rng = np.random.default_rng(0)
    for rate in (0.7, 0.95):
        intervals = [wilson(int(k), 200) for k in rng.binomial(200, rate, 400)]
        covered = np.mean([low <= rate <= high for low, high in intervals])
        assert 0.91 < covered < 0.99


def test_a_trial_follows_from_seed_row_and_number():
    a = world("all", 3)
    assert a == world("all", 3)
    assert a != world("all", 4)
    assert a != world("all", 3, seed=1)
    assert world("push-12", 3).disturbance.pushes[0].direction != a.disturbance.pushes[0].direction


def test_rows_do_what_they_say():
    many = {row: [world(row, n).disturbance for n in range(40)] for row in ROWS}
    plain = replace(many["none"][0], seed=0)
    assert plain == type(plain)()
    assert len({d.seed for d in many["none"]}) == 40
    for row, impulse in (("push-12", 12.0), ("push-18", 18.0), ("all", 9.0)):
        pushes = [d.pushes[0] for d in many[row]]
        assert all(p.impulse == impulse and 0 <= p.time <= STAND.t[-1] - 1.0 for p in pushes)
        assert np.ptp([p.direction for p in pushes]) > 270
        assert np.ptp([p.time for p in pushes]) > 0.5 * (STAND.t[-1] - 1.0)
    assert {round(d.mass_scale, 9) for d in many["mass"]} == {0.8, 1.2}
    assert {round(d.mass_scale, 9) for d in many["all"]} == {0.9, 1.1}
    assert {d.friction_scale for d in many["friction"]} == {0.6}
    assert {round(d.friction_scale, 9) for d in many["all"]} == {0.8}
    assert {d.step_height for d in many["step"]} == {-0.02, 0.02}
    assert {d.step_height for d in many["all"]} == {-0.01, 0.01}
    assert {d.latency for d in many["latency"]} == {0.01}
    assert {d.latency for d in many["all"]} == {0.005}


def test_on_flat_ground_a_step_is_a_block_where_a_foot_lands_later():
    reference = walk()
    for n in range(20):
        (block,) = world("step", n, reference=reference, terrain=Terrain()).ground.boxes
        assert block.height == 0.02
        on = Terrain((block,)).height(reference.points) > 0
        assert not on[0].any()
        assert on.any()
    assert make_world("step", 0, seed=0, reference=STAND, terrain=Terrain()) is None
    assert "block" not in describe(world("all", 0, terrain=Terrain()), Terrain())


def test_names_of_trials():
    assert parse_trial("push-12/7") == ("push-12", 7)
    for bad in ("push-12", "push/7", "push-12/x", "push-12/-1", ""):
        with pytest.raises(UsageError, match="push-18"):
            parse_trial(bad)


def result(row, number, fall=None, controller="ci-mpc", body=0.01):
    return Result(controller, row, number, fall, 1.0, body, 0.02, 1.0, 0.5, 0.9, "done to it")


def test_summary_counts_falls_and_names_them():
    results = [result("mass", n, "it lay down at 1.00 s" if n in (2, 5) else None) for n in range(8)]
    results += [result("none", 0, controller="open-loop", body=None)]
    rows = summary(reversed(results))
    mass = rows[0]
    assert (mass["row"], mass["trials"], mass["successes"], mass["success_rate"]) == ("mass", 8, 6, 0.75)
    assert mass["interval"] == pytest.approx(wilson(6, 8))
    assert [f["trial"] for f in mass["falls"]] == ["mass/2", "mass/5"]
    assert mass["body_rmse"] == pytest.approx(0.01)
    text = as_text(rows)
    assert "6/8 (41 to 93 %)" in text
    assert "open-loop" in text
    assert "push" not in text


class Keeping(Silent):
    """Progress that remembers its checkpoint, and can break off after some."""

    def __init__(self, state=None, after=None):
        self.state, self.saves, self.after, self.notes = state, 0, after, []

    def note(self, message):
        self.notes.append(message)

    def save(self, state):
        self.state, self.saves = state, self.saves + 1
        if self.saves == self.after:
            raise KeyboardInterrupt

    def load(self):
        return self.state


def run(progress, **config):
    upstream = Artifact(npz={"reference.npz": STAND.to_arrays()}, json={"terrain.json": Terrain().to_json()})
    robot_reference = replace(STAND, robot_digest=ROBOT.digest, point_names=ROBOT.foot_names)
    upstream = replace(upstream, npz={"reference.npz": robot_reference.to_arrays()})
    return trials.run(Inputs({"optimize": upstream}, {}, ROBOT), trials.Config(**config), progress)


def test_a_run_goes_on_with_the_trials_that_are_left(monkeypatch):
    asked = []

    def simulated(setting, keys):
        for key in keys:
            asked.append(key)
            controller, row, number = key
            yield {}
            yield {key: None if row == "step" else result(row, number, controller=controller)}

    monkeypatch.setattr(trials, "_simulate", simulated)
    config = dict(trials=3, rows=("mass", "step"), controllers=("ci-mpc", "open-loop"))
    progress = Keeping(after=5)
    with pytest.raises(KeyboardInterrupt):
        run(progress, **config)
    assert len(asked) == 5
    again = Keeping(progress.state)
    artifact = run(again, **config)
    assert again.saves == 7
    assert len(set(asked)) == len(asked) == 12
    assert [r["trials"] for r in artifact.json["trials.json"]["rows"]] == [3, 3]
    assert artifact.npz["trials.npz"]["row"].tolist() == ["mass"] * 6
    assert any("step: left out" in note for note in again.notes)
    assert artifact.blobs["trials.png"].startswith(b"\x89PNG")
    json.dumps(artifact.json["trials.json"])


@pytest.mark.parametrize("config", [dict(trials=0), dict(rows=("fire",)), dict(rows=()), dict(controllers=("pid",))])
def test_nonsense_is_refused(config):
    with pytest.raises(UsageError, match=r"trials\."):
        run(Silent(), **config)


@pytest.mark.slow
def test_two_processes_find_what_one_trial_finds():
    """Real trials in processes of their own, and one of them again by itself: the same end."""
    from slomo.track.trial import run_trial

    artifact = run(Silent(), trials=2, rows=("push-12",), settle=0.1, blend=0.1)
    table = artifact.npz["trials.npz"]
    assert table["number"].tolist() == [0, 1]
    robot_reference = replace(STAND, robot_digest=ROBOT.digest, point_names=ROBOT.foot_names)
    found = run_trial(
        "push-12", 1, seed=0, robot=ROBOT, reference=robot_reference, terrain=Terrain(),
        config=trials.Config(settle=0.1, blend=0.1), progress=Silent(),
    )  # fmt: skip
    assert found is not None
    assert found[0].body_rmse == table["body_rmse"][1]
