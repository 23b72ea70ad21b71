"""The report: from artifacts of the whole line to a video, pictures and a table."""

from dataclasses import fields
from importlib.resources import files
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from slomo.formats.mp4 import encode_mp4
from slomo.motion import KeypointMotion, Reference, Rollout
from slomo.report import meshes, stage, table
from slomo.report.evidence import evidence_picture
from slomo.report.panels import KeypointPanel, RobotPanel, bones, heading
from slomo.report.plots import foot_heights
from slomo.report.video import Composer, FootFalls
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Box, Terrain

TRUTH = Path(str(files("slomo"))) / "assets" / "walk" / "truth.npz"
SECONDS = 0.5


@pytest.fixture(scope="module")
def robot():
    return load_robot("go1")


@pytest.fixture(scope="module")
def truth():
    with np.load(TRUTH) as z:
        return dict(z)


@pytest.fixture(scope="module")
def artifacts(robot, truth):
    """A robot that glides ahead on straight legs: what the stages would write, made up."""
    t = np.arange(len(truth["keypoints"])) / 30
    source = KeypointMotion(
        t, truth["keypoints"], tuple(truth["keypoint_names"]), np.ones(truth["keypoints"].shape[:2])
    )
    frames = np.random.default_rng(0).integers(0, 255, (len(t), 36, 64, 3), np.uint8)
    K = truth["K"] / 10
    K[2, 2] = 1

    C = len(robot.limbs)
    t = np.arange(0, SECONDS + 1e-9, 0.05)
    T = len(t)
    height = robot.standing_height
    base = np.stack([0.3 * t, 0 * t, height + 0 * t], 1)
    feet = base[:, None] + robot.nominal_feet
    feet[..., 2] = np.maximum(0.05 * np.sin(10 * t[:, None] + np.pi * np.array([0, 1, 1, 0])), 0)
    q = np.concatenate([base, np.tile([0, 0, 0, 1.0], (T, 1)), feet.reshape(T, -1)], 1)
    lam = np.zeros((T - 1, C, 3))
    lam[..., 2] = np.where(feet[:-1, :, 2] == 0, 60.0, 0.0)
    reference = Reference(
        t, np.diff(t), q, np.zeros((T, 6 + 3 * C)), np.zeros((T - 1, 3 * C)), lam, robot.foot_names, robot.digest
    )
    names = ("base", *(f"{n}_foot" for n in robot.limb_names))
    target = KeypointMotion(t, np.concatenate([base[:, None], feet], 1), names, np.ones((T, 1 + C)))

    r = np.arange(-0.2, SECONDS, 0.01)
    n = len(r)
    qs = np.tile(robot.q_nominal, (n, 1))
    qs[:, 0] += 0.3 * r
    body = np.concatenate([qs[:, :3], np.tile([0, 0, 0, 1.0], (n, 1))], 1)
    points = body[:, None, :3] + robot.nominal_feet
    nj = len(robot.joint_names)
    rollout = Rollout(
        t=r, q=qs, v=np.zeros((n, 6 + nj)), q_des=qs[:, 7:], tau=np.zeros((n, nj)), body=body, points=points,
        lam=np.full((n, C, 3), 30.0), body_ref=body, points_ref=points, mpc_t=r, mpc_ms=0 * r, mpc_status=0 * r,
        point_names=robot.foot_names, joint_names=robot.joint_names,
    )  # fmt: skip
    terrain = Terrain((Box(0.6, 1.2, -0.5, 0.5, 0.1),)).to_json()
    limits = {"penetration": 1e-3}
    return {
        "decode": Artifact(npz={"frames.npz": {"frames": frames, "t": source.t}}),
        "reconstruct": Artifact(
            npz={"keypoints.npz": {**source.to_arrays(), "K": K, "T_world_cam": truth["T_world_cam"]}}
        ),
        "retarget": Artifact(
            npz={"keypoints.npz": target.to_arrays()}, json={"report.json": {"used_s": [0.2, 1.0], "scale": 0.7}}
        ),
        "optimize": Artifact(
            npz={"reference.npz": reference.to_arrays()},
            json={"report.json": {"verified": True, "penetration": 2e-4, "limits": limits}, "terrain.json": terrain},
        ),
        "track": Artifact(
            npz={"rollout.npz": rollout.to_arrays()}, json={"metrics.json": {"fell": False}, "terrain.json": {}}
        ),
    }


def test_the_whole_report(artifacts, robot):
    out = stage.run(Inputs(artifacts, {"truth": TRUTH}, robot), stage.Config(fps=5, moments=2), Silent())
    pictures = ("side_by_side.png", "foot_heights.png", "contacts_and_torques.png")
    assert set(out.blobs) == {"side_by_side.mp4", *pictures}
    video = out.blobs["side_by_side.mp4"]
    assert 0 < video.find(b"moov") < video.find(b"mdat")  # browsers start at once
    for name in pictures:
        picture = cv2.imdecode(np.frombuffer(out.blobs[name], np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.std() > 10
    report = out.json["report.json"]
    assert report["reconstruction"]["pa_mpjpe_percent"] < 1e-6
    assert {r["quantity"] for r in report["rows"]} >= {"penetration", "fell", "scale, robot over creature"}
    assert "at most 0.001" in report["text"]


def test_what_was_seen_is_in_the_report(artifacts, robot):
    names = np.array(["nose", "withers", "front_left_paw", "nose"])
    F = 3
    parts = np.zeros((F, 4, 64, 64), np.uint8)
    parts[:, 0], parts[:, 0, 16:48, 16:48], parts[:, 2, 16:48, 16:48] = 255, 0, 255  # all of it a left leg
    evidence = {
        "frame": np.array([0, 4, 8]), "box": np.tile(np.float32([2, 3, 30]), (F, 1)),
        "view_path": np.zeros(F, np.float32), "view_up": np.tile(np.float32([0, -1, 0]), (F, 1)),
        "keypoint_names": names, "keypoints": np.full((F, 4, 2), 17.0, np.float32),
        "keypoint_confidence": np.tile(np.float32([0.9, 0.0, 0.5, 1.0]), (F, 1)),
        "part_names": np.array(["trunk", "front_left", "front_right"]), "parts": parts,
    }  # fmt: skip
    said = artifacts | {"evidence": Artifact(npz={"evidence.npz": evidence})}
    data = stage.run(Inputs(said, {}, robot), stage.Config(fps=5, moments=2), Silent()).blobs["evidence.png"]
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(float)
    assert picture.shape == (26 + 2 * (256 + 6), 3 * (256 + 6) + 6, 3)
    below = picture[26 + 256 + 6 :][:256, 6 : 6 + 256]
    leg, around = below[80:110, 80:110].mean((0, 1)), below[10:50, 10:50].mean((0, 1))
    assert leg[0] > leg[2] + 60  # warm
    assert np.ptp(around) < 5
    silent = {k: v[:0] if k not in ("keypoint_names", "part_names") else v for k, v in evidence.items()}
    frames = artifacts["decode"].npz["frames.npz"]
    assert evidence_picture(silent, frames["frames"], frames["t"]) is None
    only_points = evidence | {k: evidence[k][:0] for k in ("parts", "view_path", "view_up")}
    assert evidence_picture(only_points, frames["frames"], frames["t"])


def test_video_is_h264_with_one_frame_for_each_time(tmp_path, artifacts, robot):
    without_clip = {("import" if k == "reconstruct" else k): v for k, v in artifacts.items() if k != "decode"}
    keypoints = {
        k: v for k, v in artifacts["reconstruct"].npz["keypoints.npz"].items() if k not in ("K", "T_world_cam")
    }
    without_clip["import"] = Artifact(npz={"keypoints.npz": keypoints})
    out = stage.run(Inputs(without_clip, {}, robot), stage.Config(fps=5, moments=2), Silent())
    path = tmp_path / "a.mp4"
    path.write_bytes(out.blobs["side_by_side.mp4"])
    with av.open(str(path)) as c:
        stream = c.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate or 0) == 5
        assert sum(1 for _ in c.decode(video=0)) == 3
    assert out.json["report.json"]["reconstruction"] is None


def test_a_fall_is_shown_even_before_the_motion_begins(artifacts, robot):
    whole = Rollout.from_arrays(artifacts["track"].npz["rollout.npz"])
    rows = {f.name: getattr(whole, f.name) for f in fields(whole)}
    early = Rollout(**{k: v[:10] if isinstance(v, np.ndarray) else v for k, v in rows.items()})
    assert early.t[-1] < 0
    panel = RobotPanel(early, robot, Terrain(), azimuth=1.0, fell=True)
    assert panel.draw(0.1).std() > 5
    assert "fell" in panel.title
    reference = Reference.from_arrays(artifacts["optimize"].npz["reference.npz"])
    target = KeypointMotion.from_arrays(artifacts["retarget"].npz["keypoints.npz"])
    assert foot_heights(target, reference, early, limbs=robot.limb_names, terrain=Terrain(), robot="go1")


def test_encoding_is_deterministic_and_keeps_the_picture(tmp_path):
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    frames = [np.stack([2 * x + i, 3 * y, x + y], -1).astype(np.uint8) for i in range(5)]
    data = encode_mp4(frames, 29.97, crf=12)
    assert data == encode_mp4(frames, 29.97, crf=12)
    (tmp_path / "a.mp4").write_bytes(data)
    with av.open(str(tmp_path / "a.mp4")) as c:
        decoded = [f.to_ndarray(format="rgb24") for f in c.decode(video=0)]
    assert len(decoded) == 5
    assert np.abs(np.stack(decoded).astype(int) - np.stack(frames)).mean() < 4


def test_robot_meshes_stand_where_the_links_are(robot):
    parts, links = meshes.robot_parts(robot)
    assert set(links) == set(parts)
    assert {"trunk", "FL_calf", "RR_thigh"} <= set(links.values())
    trunk = np.concatenate([p.vertices for n, p in parts.items() if links[n] == "trunk"])
    assert 0.3 < np.ptp(trunk[:, 0]) < 0.7  # m
    assert sum(len(p.triangles) for p in parts.values()) < 150_000


def test_merging_detail_keeps_the_shape():
    ball = trimesh.creation.icosphere(5, 0.1)
    v, f = meshes.merge_detail(np.asarray(ball.vertices), np.asarray(ball.faces), 0.01)
    assert len(f) < 0.4 * len(ball.faces)
    merged = trimesh.Trimesh(v, f, process=False)
    assert merged.volume == pytest.approx(ball.volume, rel=0.05)


def test_a_stick_reaches_from_one_end_to_the_other():
    a, b = np.array([0.1, 0.2, 0.3]), np.array([-0.4, 0.9, 0.1])
    T = meshes.between(a, b, 0.02)
    np.testing.assert_allclose((T @ [0, 0, 0, 1])[:3], a)
    np.testing.assert_allclose((T @ [0, 0, 1, 1])[:3], b)
    assert np.linalg.det(T[:3, :3]) > 0


def test_bones_join_what_is_there():
    assert bones(("pelvis", "withers", "front_left_paw")) == [(1, 0), (1, 2)]
    human = ("pelvis", "chest", "left_shoulder", "left_elbow")
    assert set(bones(human)) == {(1, 0), (1, 2), (2, 3)}


def test_heading_of_animals_and_people():
    R = Rotation.from_euler("z", 0.7)
    animal = {"withers": R.apply([[1.0, 0, 0]]), "pelvis": np.zeros((1, 3))}
    person = {"left_hip": R.apply([[0, 0.1, 1.0]]), "right_hip": R.apply([[0, -0.1, 1.0]])}
    assert heading(animal)[0] == pytest.approx(0.7)
    assert heading(person)[0] == pytest.approx(0.7)


def test_the_camera_keeps_the_creature_in_the_picture(truth):
    t = np.arange(len(truth["keypoints"])) / 30
    motion = KeypointMotion(
        t, truth["keypoints"], tuple(truth["keypoint_names"]), np.ones(truth["keypoints"].shape[:2])
    )
    panel = KeypointPanel(motion, azimuth=1.0, start=0.0)
    for i in (0, 45, 89):
        K, T = panel._view.camera(t[i])
        x = (truth["keypoints"][i] - T[:3, 3]) @ T[:3, :3]
        uv = (x @ K.T)[:, :2] / x[:, 2:]
        assert (uv > 0).all()
        assert (uv < [480, 270]).all()


def test_composed_frames_have_even_sides():
    class Blank:
        title = "blank"

        def draw(self, t: float) -> np.ndarray:
            return np.zeros((270, 480, 3), np.uint8)

    t = np.linspace(0, 1, 11)
    falls = FootFalls(("front_left", "hind_left"), t, np.ones((11, 2), bool), t, np.zeros((11, 2), bool))
    for count in (2, 3, 4):
        panels = [Blank()] * count
        frame = Composer(panels, falls, duration=1.0).frame(0.5, [p.draw(0.5) for p in panels])
        assert frame.shape[0] % 2 == frame.shape[1] % 2 == 0


def test_table_leaves_out_what_is_not_known():
    rows = table.rows(None, {"scale": 0.5}, {"penetration": 1e-4, "limits": {"penetration": 1e-3}}, {"fell": True})
    assert [r["quantity"] for r in rows] == ["scale, robot over creature", "penetration", "fell"]
    assert table.as_text(rows).splitlines()[-1].split() == ["track", "fell", "yes"]
