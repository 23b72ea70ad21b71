"""The whole of a deployment: the way into a motion and out of it, the stage that reads the log, the commands."""

import io
import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from slomo.cli import app
from slomo.deploy.approach import with_approach
from slomo.deploy.brain import InProcess
from slomo.deploy.log import read
from slomo.deploy.run import Plan, Way, perform
from slomo.deploy.stage import identity, run
from slomo.deploy.stops import Stops
from slomo.errors import MissingInput
from slomo.motion import Reference, Rollout
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Terrain
from slomo.track.stage import Config
from test_track import sway
from twin_bench import QUICK, go1

KEYPOINTS = Path(__file__).parents[2] / "shared" / "keypoints"


def walked_into():
    """A reference whose feet begin and end elsewhere than below the hips, one of them in the air at the end."""
    reference = sway(go1(), seconds=0.4)
    q = reference.q.copy()
    q[:, [7, 13]] += 0.06  # the left feet, ahead
    q[-5:, 12] += np.linspace(0, 0.03, 5)  # the right fore foot rises
    return replace(reference, q=q)


def test_the_way_into_a_motion_and_out_of_it_steps_and_never_slides():
    robot, terrain, track = go1(), Terrain(), Config()
    motion = walked_into()
    whole = with_approach(motion, robot, terrain=terrain, track=track, rest=0.3)
    # The motion itself is as it was, at its own times.
    inside = (whole.t >= -1e-9) & (whole.t <= motion.t[-1] + 1e-9)
    np.testing.assert_array_equal(whole.q[inside], motion.q)
    np.testing.assert_allclose(np.diff(whole.t), whole.h, atol=1e-9)
    # Both ends are the robot's own stand, at rest.
    stand = robot.nominal_feet - robot.nominal_feet.mean(axis=0)
    for k in (0, -1):
        feet = whole.points[k] - whole.points[k].mean(axis=0)
        np.testing.assert_allclose(feet[:, :2], stand[:, :2], atol=1e-6)
        assert whole.q[k, 2] == pytest.approx(robot.standing_height, abs=1e-6)
        assert not whole.v[k].any()
    # Outside of the motion and its lead-in a foot on the ground stays, and at most one is in the air.
    lead = track.settle + track.blend
    for k in np.flatnonzero((whole.t[1:] < -lead) | (whole.t[:-1] > motion.t[-1] + 0.41)):
        on = (whole.points[k, :, 2] < 1e-9) & (whole.points[k + 1, :, 2] < 1e-9)
        assert on.sum() >= 3
        assert np.abs(whole.points[k + 1, on, :2] - whole.points[k, on, :2]).max() < 2.1e-3
    assert np.linalg.norm(np.diff(whole.points, axis=0), axis=-1).max() < 0.05
    # While one swings, the centre of mass is over the other three.
    swinging = np.flatnonzero((whole.points[:, :, 2] > 0.04).any(axis=1) & (whole.t < -lead))
    assert len(swinging)
    for k in swinging:
        on = whole.points[k, :, 2] < 1e-9
        com = (robot.body.mass * whole.q[k, :2] + robot.foot_mass @ whole.points[k, :, :2]) / robot.mass
        corners = np.vstack([whole.points[k, on, :2].T, np.ones(3)])
        assert np.linalg.solve(corners, [*com, 1.0]).min() > 0.2


@cache
def tracked():
    """Upstream artifacts of a swaying motion; the metrics of the track are not of interest here."""
    reference = sway(go1(), seconds=0.5).to_arrays()
    optimized = Artifact(npz={"reference.npz": reference}, json={"terrain.json": Terrain().to_json()})
    metrics = {"body_rmse": 0.01, "foot_rmse": 0.01, "orientation_rmse": 1.0}
    track = Artifact(npz={"rollout.npz": {"reference_digest": np.array("abc")}}, json={"metrics.json": metrics})
    return {"optimize": optimized, "track": track}


@pytest.fixture(scope="module")
def dry(tmp_path_factory):
    """The log of a dry run: the real controller, in virtual time."""
    reference = tracked()["optimize"].npz["reference.npz"]
    config = replace(QUICK, rest=0.1)
    plan = Plan(
        robot="go1", reference=Reference.from_arrays(reference), terrain=Terrain(), world=Terrain(), track=Config(),
        deploy=config, identity=identity(reference, go1(), config),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("dry") / "run.log"
    way = Way("twin", "127.0.0.1", 8007, 0, dry=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("socket.socket", lambda *a: pytest.fail("a socket was made"))
        result = perform(plan, way, path, stops=Stops(), say=lambda text: None)
    assert result.trip is None
    return path, config


def test_a_dry_run_makes_the_whole_artifact(dry):
    path, config = dry
    artifact = run(Inputs(tracked(), {"deploy_log": path}, go1()), config, Silent())
    m = artifact.json["metrics.json"]
    assert artifact.failure is None
    assert m["trip"] is None
    assert m["dry_run"]
    assert m["state"] == "truth of the twin"
    assert m["body_rmse"] < 0.02
    assert m["foot_rmse"] < 0.02
    assert m["orientation_rmse"] < 3
    assert m["over_track"]["body_rmse"] == pytest.approx(m["body_rmse"] / 0.01)
    assert [p["phase"] for p in m["phases"]] == ["listen", "fold", "rise", "stand", "play", "lower", "damp"]
    rollout = Rollout.from_arrays(artifact.npz["rollout.npz"])
    assert rollout.reference_digest == "abc"
    assert rollout.t[0] < 0 < rollout.t[-1]
    # The twin's pose begins where the reference does, in the plane; no sensor could tell.
    np.testing.assert_allclose(rollout.body[0, :2], rollout.body_ref[0, :2], atol=0.01)


def test_the_mcap_says_what_the_log_says(dry):
    path, config = dry
    data = run(Inputs(tracked(), {"deploy_log": path}, go1()), config, Silent()).blobs["run.mcap"]
    header, records = read(path)
    reader = make_reader(io.BytesIO(data))
    found: dict[str, list] = {}
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        assert schema.encoding == "jsonschema"
        content = json.loads(message.data)
        assert set(content) <= set(json.loads(schema.data)["properties"])
        found.setdefault(channel.topic, []).append((message.log_time, content))
    assert set(found) == {"/joints", "/command", "/imu", "/status", "/tf", "/log"}
    assert len(found["/command"]) == len(records)
    t, last = found["/joints"][-1]
    assert t == pytest.approx((header["started"] + records["t"][-1]) * 1e9, abs=1e6)
    assert last["q"] == pytest.approx(records["q"][-1].tolist())
    assert last["name"] == list(go1().joint_names)
    assert {T["child_frame_id"] for T in found["/tf"][0][1]["transforms"]} >= {"trunk", "FL_foot"}
    assert [c["message"] for _, c in found["/log"]][:2] == ["phase: listen", "phase: fold"]


def test_a_log_of_something_else_is_refused(dry):
    path, config = dry
    inputs = Inputs(tracked(), {"deploy_log": path}, go1())
    with pytest.raises(MissingInput, match=r"another deploy.*slomo deploy --robot go1"):
        run(inputs, replace(config, max_tilt=40.0), Silent())
    other = sway(go1(), seconds=0.6).to_arrays()
    upstream = {**tracked(), "optimize": replace(tracked()["optimize"], npz={"reference.npz": other})}
    with pytest.raises(MissingInput, match="another reference"):
        run(Inputs(upstream, {"deploy_log": path}, go1()), config, Silent())


def test_a_log_that_was_cut_off_is_a_failure_that_can_be_looked_at(dry, tmp_path):
    path, config = dry
    data = path.read_bytes()
    (tmp_path / "cut.log").write_bytes(data[: len(data) // 2])
    artifact = run(Inputs(tracked(), {"deploy_log": tmp_path / "cut.log"}, go1()), config, Silent())
    assert artifact.failure == "the program was cut off during play"
    assert "rollout.npz" in artifact.npz


def test_the_controller_is_the_one_of_track():
    """The same class on the same reference: nothing of it is written a second time."""
    from slomo.track.controller import Controller

    plan = Plan("go1", sway(go1(), seconds=0.2), Terrain(), Terrain(), Config(), QUICK, {})
    assert isinstance(InProcess(plan.task)._controller, Controller)


def slomo(*args, code):
    done = CliRunner().invoke(app, [str(a) for a in args])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done.stderr.splitlines()[-1]


def test_commands_refuse_in_one_line(tmp_path):
    project = ("--project", tmp_path)
    deploy = ("deploy", "--robot", "go1", *project)
    assert "valid: twin, go1-udp" in slomo(*deploy, "--transport", "ros", code=2)
    assert "--yes" in slomo(*deploy, "--transport", "go1-udp", "--robot-address", "192.0.2.1", code=2)
    assert "in this computer" in slomo(*deploy, "--robot-address", "192.0.2.1", "--yes", code=2)
    assert "one robot" in slomo(*deploy, "--robot-address", "224.0.0.1", "--yes", code=2)
    # Who only listens is not asked: it goes on to what is missing.
    address = ("--transport", "go1-udp", "--robot-address", "192.0.2.1")
    assert "no motion yet" in slomo(*deploy, *address, "--dry-run", code=3)
    slomo(*deploy, code=3)
    assert "no wire format for 'b1'" in slomo("deploy", "--robot", "b1", *project, *address, "--yes", code=2)
    (tmp_path / "no.log").write_text("x")
    slomo("twin", "--robot", "go1", *project, "--host", "192.0.2.1", code=2)
    for name in ("g1", "b1"):
        assert "valid: go1" in slomo("twin", "--robot", name, *project, "--port", "0", "--seconds", "0", code=2)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cat00", "dog_cpr"])
def test_the_papers_motions_over_loopback(tmp_path, name):
    """Three processes in real time, stand up to lying down. Lateness is printed, never asserted."""
    if not KEYPOINTS.is_dir():
        pytest.skip(f"no {KEYPOINTS}")

    def call(*args):
        program = [sys.executable, "-c", "from slomo.cli import main; main()", *args, "--project", str(tmp_path)]
        done = subprocess.run(program, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    call("import", str(KEYPOINTS / f"{name}.json"))
    for command in (["retarget"], ["optimize"], ["track", "--sim", "--no-video"]):
        call(*command, "--robot", "go1")
    m = json.loads((Path(call("deploy", "--robot", "go1")) / "metrics.json").read_text())
    print({k: v for k, v in m.items() if k.startswith("late") or k in ("missed_deadlines", "held_commands")})
    assert m["trip"] is None
    assert m["phases"][-1]["phase"] == "damp"
    assert max(m["over_track"].values()) <= 1.5
