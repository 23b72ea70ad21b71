"""The evidence stage: with networks that the tests make, with the user's own points, and with nothing."""

import json

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="needs the onnx package (pip install 'slomo[dev]')")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from slomo.errors import InvalidData, UsageError  # noqa: E402
from slomo.packed import pack  # noqa: E402
from slomo.prior import stage  # noqa: E402
from slomo.prior.crop import Box, from_crop  # noqa: E402
from slomo.prior.external import ExternalModel, load_map  # noqa: E402
from slomo.prior.inference import OUTPUTS, Prior  # noqa: E402
from slomo.prior.labels import labels  # noqa: E402
from slomo.prior.user_keypoints import load_user_keypoints, to_decoded  # noqa: E402
from slomo.skeleton import load_skeleton  # noqa: E402
from slomo.stage import Artifact, Inputs, Silent  # noqa: E402

T, H, W = 20, 60, 80
QUADRUPED = labels(load_skeleton("quadruped"))


class Notes(Silent):
    def __init__(self):
        self.said = []

    def note(self, message):
        self.said.append(message)


def constant_network(path, outputs, *, shape, metadata=None, to_the_left=None):
    """An ONNX file that gives the same `outputs` (name -> array without the batch's axis) for each picture; or
    `to_the_left` where the subject moves to the left (channel 4 is negative)."""
    rank = len(shape)
    nodes = [
        helper.make_node("ReduceMean", ["input"], ["mean"], axes=list(range(1, rank)), keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
    ]
    fixed = [numpy_helper.from_array(np.zeros(1, np.float32), "zero")]
    if to_the_left is not None:
        fixed.append(numpy_helper.from_array(np.array([4], np.int64), "channel"))
        nodes += [
            helper.make_node("Gather", ["input", "channel"], ["motion"], axis=1),
            helper.make_node("ReduceMean", ["motion"], ["speed"], axes=[1, 2, 3], keepdims=1),
            helper.make_node("Less", ["speed", "zero"], ["left"]),
        ]
    for name, value in outputs.items():
        value = np.asarray(value, np.float32)[None]
        fixed += [
            numpy_helper.from_array(value, f"{name}_value"),
            numpy_helper.from_array(np.array([-1] + [1] * (value.ndim - 1), np.int64), f"{name}_shape"),
        ]
        nodes += [
            helper.make_node("Reshape", ["nothing", f"{name}_shape"], [f"{name}_nothing"]),
            helper.make_node("Add", [f"{name}_nothing", f"{name}_value"], [f"{name}_right" if to_the_left else name]),
        ]
        if to_the_left is not None:
            other = np.asarray(to_the_left[name], np.float32)[None]
            fixed.append(numpy_helper.from_array(other, f"{name}_other"))
            nodes += [
                helper.make_node("Reshape", ["left", f"{name}_shape"], [f"{name}_left"]),
                helper.make_node("Where", [f"{name}_left", f"{name}_other", f"{name}_right"], [name]),
            ]
    graph = helper.make_graph(
        nodes, "constant",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["n", *np.shape(v)]) for n, v in outputs.items()],
        fixed,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    for key, value in (metadata or {}).items():
        helper.set_model_props(model, {key: value})
    onnx.save(model, path)
    return path


def heatmap(cells, side):
    """(K, side, side) logits that are highest at the cells (K, 2)."""
    y, x = np.mgrid[:side, :side]
    return np.stack([-0.5 * ((x - u) ** 2 + (y - v) ** 2) for u, v in cells])


CELLS = np.random.default_rng(0).integers(4, 28, (len(QUADRUPED.keypoints), 2))


def about(**changes):
    known = {"kind": "quadruped", "keypoints": QUADRUPED.keypoints, "parts": QUADRUPED.parts, "size": 128}
    return {"slomo": json.dumps(known | {"temperature": {"parts": 2.0}} | changes)}


def our_network(path, *, metadata=None):
    """Sees the trunk in the middle, the subject from its left, and every key point at its cell; all of it mirrored when
    the subject moves to the left of the picture."""
    P, K = len(QUADRUPED.parts), len(QUADRUPED.keypoints)
    parts = np.zeros((P + 1, 64, 64))
    parts[0] = 6.0
    parts[1, 20:40, 20:40] = 12.0
    surface = np.full((4, 64, 64), 0.25)
    surface[3] = np.log(0.1)
    view = np.zeros(36)
    view[9] = 8.0
    heat, seen, up = heatmap(CELLS, 32), np.full(K, 3.0), np.array([0.0, -3.0, 0.0])
    mirrored = {
        "parts": parts[QUADRUPED.mirror_part][..., ::-1],
        "surface": surface[..., ::-1] * np.array([1, -1, 1, 1])[:, None, None],
        "heatmaps": heat[QUADRUPED.mirror_keypoint][..., ::-1], "seen": seen, "view": np.roll(view[::-1], 1), "up": up,
    }  # fmt: skip
    return constant_network(
        path,
        {"parts": parts, "surface": surface, "heatmaps": heat, "seen": seen, "view": view, "up": up},
        shape=["n", 6, "s", "s"],
        metadata=about() if metadata is None else metadata,
        to_the_left=mirrored,
    )


def inputs(**files):
    """A clip of a rectangle that moves to the right, in frames of half the clip's size."""
    rng = np.random.default_rng(0)
    masks = np.zeros((T, H, W), bool)
    for f in range(T):
        masks[f, 20:40, 10 + f : 40 + f] = True
    masks[6] = False  # the subject is lost for a frame
    flow = np.zeros((T - 1, H, W, 2), np.float16)
    flow[masks[:-1]] = (1, 0)
    packed = {**pack(masks), "quality": np.full(T, 0.8)}
    video = dict(
        source_width=2 * W,
        source_height=2 * H,
        pixel_aspect=1.0,
        width=W,
        height=H,
        rotation=0,
        fps=30.0,
        source_fps=60.0,
        start_s=1.0,
    )
    frames = {"frames": rng.integers(0, 255, (T, H, W, 3), np.uint8), "t": np.arange(T) / 30.0}
    # It looks up into the sky: nothing follows from where the subject goes.
    camera = {
        "K": np.array([[80.0, 0, W / 2], [0, 80, H / 2], [0, 0, 1]]),
        "T_world_cam": np.tile(np.eye(4), (T, 1, 1)),
    }
    return Inputs(
        artifacts={
            "decode": Artifact(npz={"frames.npz": frames}, json={"video.json": video}),
            "masks": Artifact(npz={"masks.npz": packed, "flow.npz": {"flow": flow}}),
            "camera": Artifact(npz={"camera.npz": camera}),
        },
        files=files,
    )


def run(config=None, progress=None, **files):
    done = stage.run(inputs(**files), config or stage.Config(fps=15.0), progress or Silent())
    return done.npz["evidence.npz"], done.json["report.json"]


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return our_network(tmp_path_factory.mktemp("network") / "prior.onnx")


def test_the_network_s_word_is_kept_by_the_contract(network):
    arrays, report = run(prior=network)
    F, P = 9, len(QUADRUPED.parts)
    assert arrays["frame"].tolist() == [0, 2, 4, 8, 10, 12, 14, 16, 18]
    shapes = {k: v.shape for k, v in arrays.items()}
    N = len(QUADRUPED.keypoints)
    assert shapes == {
        "frame": (F,), "box": (F, 3), "view": (F, 36), "view_up": (F, 3), "view_path": (F,),
        "keypoint_names": (N,), "keypoints": (F, N, 2), "keypoint_confidence": (F, N), "keypoint_side": (N,),
        "part_names": (P,), "part_side": (),
        "parts": (F, P + 1, 64, 64), "surface": (F, 3, 64, 64), "surface_scale": (F, 64, 64),
    }  # fmt: skip
    assert tuple(arrays["keypoint_names"]) == QUADRUPED.keypoints
    assert np.allclose(arrays["box"][1], [12 + 15 - 1.25 * 15, 30 - 1.25 * 15, 37.5])
    assert np.abs(arrays["view_path"] - np.pi / 2).max() < 0.02
    assert np.allclose(arrays["view_up"], [0, -1, 0])
    assert arrays["parts"].dtype == np.uint8
    assert np.abs(arrays["parts"].astype(int).sum(1) - 255).max() < P + 1
    inside = 255 / (1 + np.exp(-3.0) + (P - 1) * np.exp(-6.0))  # logits 12, 6 and 0 at temperature 2
    assert abs(int(arrays["parts"][0, 1, 30, 30]) - inside) <= 1
    assert np.allclose(arrays["surface_scale"], 0.1, atol=1e-3)
    middle = [i for i, n in enumerate(QUADRUPED.keypoints) if "left" not in n and "right" not in n]
    expected = from_crop((CELLS + 0.5) * 4 - 0.5, arrays["box"][:, None], 128)
    assert np.abs(arrays["keypoints"] - expected)[:, middle].max() < 0.05
    confidence = arrays["keypoint_confidence"]
    assert np.allclose(confidence.max(), 0.8 * 0.95 * 0.976, atol=0.02)
    assert report["prior"] == "quadruped (prior.onnx)"
    assert report["weights_sha256"] == Prior(network).digest
    assert report["sources"]["prior"]["view_certainty"] > 0.9
    assert set(report["sources"]["prior"]["left_right"]) == {"front_shoulder", "hind_hip"}


def test_without_anybody_there_is_nothing():
    for config, said in ((stage.Config(prior="none"), "no prior"), (stage.Config(), "name your own")):
        notes = Notes()
        arrays, report = run(config, notes)
        assert said in " ".join(notes.said)
        assert report["prior"] == "none"
        assert report["frames"] == len(arrays["frame"]) == len(arrays["box"]) == 0
        assert arrays["keypoints"].shape == (0, 0, 2)
        assert all(len(arrays[k]) == 0 for k in ("view", "view_up", "view_path", "parts", "surface", "surface_scale"))


def test_none_silences_a_file_too(network):
    assert run(stage.Config(prior="none"), prior=network)[1]["weights_sha256"] is None


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({}, "no metadata"),
        ({"slomo": "{"}, "metadata is incomplete"),
        ({"slomo": '{"kind": "quadruped"}'}, "metadata is incomplete"),
        (about(kind="spider"), "was trained for 'spider', the skeleton is 'quadruped'"),
        (about(kind="human"), "key points are not the skeleton's: .*withers"),  # whose skeleton is the network's, then
        (about(keypoints=[*QUADRUPED.keypoints[:-1], "wing"]), "key points are not the skeleton's: .*wing"),
        (about(parts=QUADRUPED.parts[::-1]), "its parts are not the skeleton's: their order"),
    ],
)
def test_networks_that_do_not_fit(tmp_path, metadata, message):
    with pytest.raises(InvalidData, match=message):
        run(prior=our_network(tmp_path / "other.onnx", metadata=metadata))


def test_files_that_are_no_networks(tmp_path):
    (tmp_path / "a.onnx").write_bytes(b"no network")
    with pytest.raises(InvalidData, match=r"a\.onnx: not a network that can be loaded"):
        run(prior=tmp_path / "a.onnx")
    constant_network(tmp_path / "b.onnx", {"parts": np.zeros(3)}, shape=["n", 6, "s", "s"], metadata=about())
    with pytest.raises(InvalidData, match=r"is not a network of slomo's \(lacks surface, heatmaps"):
        run(prior=tmp_path / "b.onnx")


def test_slomo_s_own_network_gives_way_to_another_skeleton(network, monkeypatch, tmp_path):
    monkeypatch.setattr(stage, "packaged", lambda kind: network)
    notes = Notes()
    assert run(None, notes, prior=network)[1]["prior"] == "quadruped (packaged)"
    text = (stage.load_skeleton.__globals__["resources"].files("slomo") / "skeletons" / "quadruped.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("nose", "snout"))
    arrays, _ = run(None, notes, prior=network, skeleton=tmp_path / "mine.toml")
    assert len(arrays["frame"]) == 0
    assert "does not fit the skeleton: its key points are not the skeleton's: nose, snout" in notes.said[-1]


def points_file(path, names, frames):
    path.write_text(json.dumps({"names": names, "frames": frames}))
    return path


def test_the_user_s_points_come_back_where_they_were_given(tmp_path):
    """Frames 0, 2, 4 ... of 30 a second are looked at; the clip has 60, pixels half as large, and 1 s before."""
    nose, paw = np.array([40.0, 56.0]), np.array([31.0, 70.0])  # px of the clip
    points = points_file(
        tmp_path / "points.json",
        ["nose", "front_left_paw"],
        [
            {"frame": 60, "points": [[*nose, 0.9], None]},
            {"t": 1 + 2 / 30, "points": [None, list(paw)]},
            {"frame": 60 + 2 * 5, "points": [[*nose], None]},  # between: carried
            {"frame": 60 + 2 * 6, "points": [[*nose], None]},  # the frame in which the subject is lost
            {"frame": 5, "points": [[*nose], None]},  # before the part that is used
        ],
    )
    notes = Notes()
    arrays, report = run(stage.Config(prior="none", fps=15.0), notes, keypoints2d=points)
    assert arrays["keypoint_names"].tolist() == ["nose", "front_left_paw"]
    assert arrays["frame"].tolist() == [0, 2, 4, 8, 10, 12, 14, 16, 18]
    half = lambda p: (p + 0.5) / 2 - 0.5  # noqa: E731
    assert np.allclose(arrays["keypoints"][0, 0], half(nose))
    assert np.allclose(arrays["keypoints"][1, 1], half(paw))
    assert np.allclose(arrays["keypoints"][2, 0], half(nose) - [1, 0], atol=0.05)
    expected = np.zeros((9, 2))
    expected[[0, 1, 2], [0, 1, 0]] = [0.9, 1, 1]
    assert np.allclose(arrays["keypoint_confidence"], expected)
    assert arrays["view"].shape == (0, 36)
    assert report["sources"]["keypoints2d"]["frames_unused"] == 2
    assert "2 of 5 frames of --keypoints2d are not used" in notes.said[-1]


def test_columns_of_several_sources_stand_side_by_side(network, tmp_path):
    points = points_file(tmp_path / "p.json", ["nose"], [{"frame": 60, "points": [[40, 56]]}])
    arrays, report = run(prior=network, keypoints2d=points)
    assert arrays["keypoint_names"].tolist() == [*QUADRUPED.keypoints, "nose"]
    assert arrays["keypoint_confidence"][:, -1].tolist() == [1.0] + 8 * [0.0]
    assert set(report["sources"]) == {"prior", "keypoints2d"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no json", "is not JSON"),
        ("[1]", "has no names or frames; expected"),
        ('{"names": ["nose"]}', "has no names or frames"),
        ('{"names": ["noze"], "frames": []}', r"no key point 'noze' \(valid: pelvis, .*nose"),
        ('{"names": ["nose", "nose"], "frames": []}', "names 'nose' twice"),
        ('{"names": ["nose"], "frames": [{"points": [[1, 2]]}]}', "entry 0 of frames: cannot be understood"),
        ('{"names": ["nose"], "frames": [{"frame": 1, "points": [["a", 2]]}]}', "cannot be understood"),
        ('{"names": ["nose"], "frames": [{"frame": 1, "points": []}]}', "has 0 points for 1 names"),
        ('{"names": ["nose"], "frames": [{"frame": 1, "points": [[1]]}]}', "nose has 1 numbers"),
        ('{"names": ["nose"], "frames": [{"frame": 1, "points": [[NaN, 2]]}]}', "nose is not finite; write null"),
        ('{"names": ["nose"], "frames": [{"frame": 1, "points": [[1, 2, 7]]}]}', r"confidence of 7 \(valid: 0 to 1\)"),
        ('{"names": ["nose"], "frames": [{"t": NaN, "points": [[1, 2]]}]}', "t is not a finite number"),
        (
            '{"names": ["nose"], "frames": [{"frame": 60, "points": [[900, 2]]}]}',
            r"far outside the picture \(160 x 120",
        ),
        (
            '{"names": ["nose", "head"], "frames": [{"frame": 60, "points": [[0.4, 0.2], [0.3, 0.1]]}]}',
            "give pixels, not fractions",
        ),
    ],
)
def test_wrong_points_of_the_user(tmp_path, text, message):
    (tmp_path / "points.json").write_text(text)
    with pytest.raises(InvalidData, match=message):
        run(stage.Config(prior="none"), keypoints2d=tmp_path / "points.json")


def test_points_of_a_clip_that_is_turned_and_squeezed(tmp_path):
    """Stored 200 x 100 lying on its side; shown upright 100 x 200, decoded 40 x 100: pixels are not square."""
    video = dict(
        source_width=100,
        source_height=100,
        pixel_aspect=2.0,
        width=40,
        height=100,
        rotation=-90,
        fps=10.0,
        source_fps=10.0,
        start_s=0.5,
    )
    points = points_file(tmp_path / "p.json", ["nose"], [{"frame": 7, "points": [[99.5, 199.5]]}])
    frame, uv = to_decoded(load_user_keypoints(points, ["nose"]), video, where=points)
    assert frame[0] == pytest.approx(2)
    assert np.allclose(uv[0, 0], [39.5, 99.5])


HEAT_MAP = """
[input]
size = [96, 64]
[output]
type = "heatmaps"
[keypoints]
0 = "nose"
2 = "front_left_paw"
1 = "front_right_paw"
"""


def test_a_model_of_heat_maps(tmp_path):
    cells = np.array([[3, 4], [10, 12], [20, 6]])
    y, x = np.mgrid[:16, :24]
    heat = np.stack([0.7 * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2)) for u, v in cells])
    constant_network(tmp_path / "m.onnx", {"heat": heat}, shape=[1, 3, 64, 96])
    (tmp_path / "map.toml").write_text(HEAT_MAP)
    arrays, report = run(
        stage.Config(prior="none"), keypoint_model=tmp_path / "m.onnx", keypoint_map=tmp_path / "map.toml"
    )
    assert arrays["keypoint_names"].tolist() == ["nose", "front_left_paw", "front_right_paw"]
    # The input is 96 x 64 px, the square box takes its middle 64 x 64.
    expected = from_crop((cells + 0.5) * 4 - 0.5 - [16, 0], arrays["box"][:, None], 64)
    assert np.abs(arrays["keypoints"][:, 0] - expected[:, 0]).max() < 0.02
    paws = arrays["keypoints"][:, 1:]
    assert np.abs(np.sort(paws, 1) - np.sort(expected[:, 1:], 1)).max() < 0.02
    assert np.allclose(arrays["keypoint_confidence"], 0.7, atol=1e-3)
    assert set(report["sources"]["keypoint_model"]["left_right"]) == {"front_shoulder"}


@pytest.mark.parametrize(("units", "order", "unit"), [("fraction", "yx", 64), ("pixel", "xy", 1)])
def test_a_model_of_coordinates_sees_the_picture_as_its_mapping_says(tmp_path, units, order, unit):
    """The network gives the mean of its input as the confidence: layout, colour and normalisation show in it."""
    at = np.array([[0.25, 0.75, 0.0]]) if units == "fraction" else np.array([[15.5, 47.5, 0.0]])
    at = at[:, [1, 0, 2]] if order == "yx" else at
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1, 2], keepdims=0),
        helper.make_node("Split", ["mean", "sizes"], ["first", "others"], axis=1),
        helper.make_node("Mul", ["first", "third"], ["scaled"]),
        helper.make_node("Add", ["scaled", "at"], ["points"]),
    ]
    fixed = [
        numpy_helper.from_array(np.array([1, 2], np.int64), "sizes"),
        numpy_helper.from_array(np.array([[[0, 0, 1]]], np.float32), "third"),
        numpy_helper.from_array(at[None].astype(np.float32), "at"),
    ]
    graph = helper.make_graph(
        nodes, "coordinates", [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 64, 64, 3])],
        [helper.make_tensor_value_info("points", TensorProto.FLOAT, [1, 1, 3])], fixed,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "m.onnx")
    (tmp_path / "map.toml").write_text(
        f"""
[input]
size = [64, 64]
layout = "nhwc"
colour = "bgr"
scale = 0.01
mean = [0.5, 0.0, 0.0]
std = [2.0, 1.0, 1.0]
[output]
name = "points"
type = "coordinates"
units = "{units}"
order = "{order}"
[keypoints]
0 = "nose"
"""
    )
    mapping = load_map(tmp_path / "map.toml", ["nose"])
    rgb = np.zeros((H, W, 3), np.uint8)
    rgb[...] = (10, 20, 200)
    box = Box(8.0, 8.0, 32.0)
    uv, confidence = ExternalModel(tmp_path / "m.onnx", mapping)(rgb, box)
    assert np.allclose(uv, from_crop(np.array([[15.5, 47.5]]), box, 64), atol=1e-4)
    assert confidence[0] == pytest.approx((200 * 0.01 - 0.5) / 2, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[input", "is not TOML"),
        ("[inputs]\nsize = [64, 64]", r"no section 'inputs' \(valid: input, output, keypoints\)"),
        ("[input]\nside = 64", r"\[input\]: no parameter 'side' \(valid: size"),
        ("[input]\nsize = 64", "size = 64: expected"),
        ("[input]\nstd = [1.0, 0.0, 1.0]", "std not 0"),
        ('[input]\nlayout = "chw"', r"layout = 'chw' \(valid: nchw, nhwc\)"),
        ("[keypoints]", "names no key points"),
        ('[keypoints]\na = "nose"', "'a' is no number"),
        ('[keypoints]\n0 = "nous"', r"no node 'nous' \(valid: pelvis"),
        ('[keypoints]\n0 = "nose"\n1 = "nose"', "names 'nose' twice"),
        ('[output]\nname = "x"\n[keypoints]\n0 = "nose"', r"no output 'x' \(valid: heat\)"),
        ('[output]\ntype = "coordinates"\n[keypoints]\n0 = "nose"', r"'heat' is \(1, 3, 16, 24\), no coordinates"),
        ('[keypoints]\n7 = "nose"', "has 3 key points, the mapping names 7"),
        ('[input]\nlayout = "nhwc"\n[keypoints]\n0 = "nose"', r"does not take an input of \(1, 64, 96, 3\)"),
    ],
)
def test_wrong_mappings(tmp_path, text, message):
    if "size" not in text and "[input" not in text:
        text = "[input]\nsize = [96, 64]\n" + text
    elif "nhwc" in text:
        text = text.replace("[input]", "[input]\nsize = [96, 64]")
    (tmp_path / "map.toml").write_text(text)
    constant_network(tmp_path / "m.onnx", {"heat": np.zeros((3, 16, 24))}, shape=[1, 3, 64, 96])
    with pytest.raises(InvalidData, match=message):
        run(stage.Config(prior="none"), keypoint_model=tmp_path / "m.onnx", keypoint_map=tmp_path / "map.toml")


def test_a_model_needs_its_mapping(tmp_path):
    with pytest.raises(UsageError, match="--keypoint-model: needs --keypoint-map too"):
        run(keypoint_model=tmp_path / "m.onnx")


def test_parameters_out_of_range():
    with pytest.raises(UsageError, match=r"unknown prior 'sam' \(valid: auto, none\); a file of your own"):
        stage.Config(prior="sam")
    with pytest.raises(UsageError, match=r"evidence\.fps: is 0"):
        stage.Config(fps=0)
    assert {"parts", "heatmaps", "seen", "view"} < set(OUTPUTS)


def test_front_and_back_of_one_outline():
    from slomo.prior.evidence import front_to_back

    view = np.zeros((2, 36))
    view[0, 2], view[1, 9] = 1, 1
    assert front_to_back(view).argmax(1).tolist() == [16, 9]
    assert np.array_equal(front_to_back(front_to_back(view)), view)


@pytest.mark.parametrize("kind", ["quadruped", "human"])
def test_slomo_s_own_network_is_asked_for_both_kinds(kind):
    from slomo.pipeline import _find_prior

    path = _find_prior(kind)
    assert path is not None
    assert not Prior(path).misfit(labels(load_skeleton(kind)))
