"""The verdict: what each figure says, and what all of them do."""

import numpy as np
import pytest

from slomo.reconstruct.outcome import _swap_margin, lowest
from slomo.reconstruct.verdict import Check, Facts, checks, floating, verdict

GOOD = Facts(
    report=dict(
        silhouette_iou=0.85, silhouette_iou_low=0.8, silhouette_low_s=1.2, flow_residual_px=0.4, swap_margin=0.05,
        foot_skate_mps=0.01,
    ),
    masks=dict(segmenter="u2netp", quality_mean=0.9, frames_without_subject=0),
    camera=dict(reprojection_error_px=0.3, gravity_std_deg=1.0),
    feet=np.full((30, 4, 3), 0.02), sole=0.02, t=np.arange(30) / 15, length=0.5, stretch=np.ones(10),
)  # fmt: skip


def _with(**changes) -> Facts:
    whole = vars(GOOD) | {k: (vars(GOOD)[k] | v if isinstance(v, dict) else v) for k, v in changes.items()}
    return Facts(**whole)


def test_nothing_speaks_against_a_good_one():
    found = verdict(checks(GOOD))
    assert found["trust"] == "good"
    assert {c["level"] for c in found["checks"]} == {"good"}


@pytest.mark.parametrize(
    ("changes", "trust", "name"),
    [
        (dict(report=dict(swap_margin=0.002)), "fair", "swap_margin"),
        (dict(report=dict(silhouette_iou=0.3)), "unusable", "silhouette_iou"),
        (dict(report=dict(silhouette_iou_low=0.7)), "fair", "silhouette_iou_low"),
        (dict(masks=dict(segmenter="motion")), "fair", "masks_by_motion"),
        (dict(masks=dict(frames_without_subject=25)), "unusable", "frames_without_subject"),
        (dict(camera=dict(reprojection_error_px=9.0)), "fair", "camera_error_px"),
        (dict(feet=np.full((30, 4, 3), -0.1)), "poor or worse", "penetration"),
        (dict(feet=np.full((30, 4, 3), 0.3)), "fair", "floating_s"),
        (dict(report=dict(foot_skate_mps=2.0)), "unusable", "foot_skate"),
        (dict(stretch=np.array([1.0, 2.5])), "fair", "bone_change"),
    ],
)
def test_a_bad_figure_is_named(changes, trust, name):
    found = verdict(checks(_with(**changes)))
    assert found["trust"] in (trust, *(("fair", "poor", "unusable") if trust == "poor or worse" else ()))
    assert name in found["text"]
    said = next(c for c in found["checks"] if c["name"] == name)
    assert said["level"] in ("poor", "unusable")
    assert said["todo"]


def test_many_poor_figures_are_poor():
    worse = _with(report=dict(swap_margin=0.0, flow_residual_px=5.0), camera=dict(gravity_std_deg=9.0))
    assert verdict(checks(worse))["trust"] == "poor"


def test_what_could_not_be_told_is_unknown_and_not_held_against_it():
    found = verdict(checks(_with(report=dict(swap_margin=None), camera=dict(reprojection_error_px=None))))
    assert found["trust"] == "good"
    assert {c["name"] for c in found["checks"] if c["level"] == "unknown"} == {"swap_margin", "camera_error_px"}


def test_the_opposite_of_legs_on_their_own_has_them_exchanged():
    own = {"heading": "front", "gait": "none", "legs": "on their own"}
    rivals = [own | {"loss": 0.80}, {"heading": "front", "gait": "none", "loss": 0.804}]
    rivals += [own | {"legs": "exchanged", "loss": 1.2}]
    log = {"rivals": rivals, "final": [own | {"loss": 0.7}], "limbs": [own | {"loss": 0.6}]}
    assert _swap_margin(log) == pytest.approx(0.5)


def test_the_lowest_overlap_is_that_of_a_while_and_not_of_one_frame():
    t = np.arange(60) / 30
    iou = np.full(60, 0.9)
    iou[10] = 0.3  # by itself .6 away from the others, spread over nine frames less than what follows
    iou[30:39] = 0.7
    iou[40:45] = np.nan
    low, at = lowest(iou, t)
    assert low == pytest.approx(0.7)
    assert at == pytest.approx(34 / 30)


def test_frames_of_which_nothing_is_known_make_no_while_of_one_frame():
    """Who leaves the picture, say, and comes back after more than a while."""
    t, iou = np.arange(90) / 30, np.full(90, 0.9)
    iou[30], iou[31:60] = 0.5, np.nan
    low, at = lowest(iou, t)
    assert low == pytest.approx(0.9 - 0.4 / 5)  # with the four before it, half of a while
    assert at == pytest.approx(28 / 30)
    assert np.isnan(lowest(np.full(90, np.nan), t)).all()


def test_the_end_of_a_clip_counts_as_its_beginning_does():
    t, iou = np.arange(60) / 30, np.full(60, 0.9)
    iou[-9:] = 0.6
    assert lowest(iou, t)[0] == pytest.approx(0.6)
    assert lowest(iou[::-1], t)[0] == pytest.approx(0.6)


def test_a_low_overlap_all_the_time_does_not_count_twice():
    found = {c.name: c.level for c in checks(_with(report=dict(silhouette_iou=0.6, silhouette_iou_low=0.5)))}
    assert (found["silhouette_iou"], found["silhouette_iou_low"]) == ("poor", "unknown")


def test_the_lowest_overlap_of_a_short_clip_is_that_of_all_its_frames():
    low, at = lowest(np.array([0.8, 0.6, np.nan, 0.7]), np.arange(4) / 30)
    assert low == pytest.approx(0.7)
    assert at == pytest.approx(4 / 90)


def test_limits_are_inclusive():
    assert Check("x", 1.0, 1.0, 2.0, "").level == "good"
    assert Check("x", 2.0, 1.0, 2.0, "").level == "poor"
    assert Check("x", 0.5, 0.5, 0.2, "", least=True).level == "good"
    assert Check("x", 0.1, 0.5, 0.2, "", least=True).level == "unusable"
    assert Check("x", float("nan"), 1.0, 2.0, "").level == "unknown"


def test_floating_is_the_longest_time_aloft():
    t = np.arange(10) / 10
    height = np.zeros((10, 2))
    height[3:7] = 0.5
    height[5, 1] = 0.0
    assert floating(height, t) == pytest.approx(0.1)
    height[5, 1] = 0.5
    assert floating(height, t) == pytest.approx(0.3)
    assert floating(np.zeros((10, 2)), t) == 0.0


def _log(*limbs: dict) -> dict:
    """Of a person who stays in place, worse among the rivals than the one turned around, by a fiftieth."""
    own = {"heading": "front", "gait": "none"}
    turned = own | {"seen": "turned around"}
    rivals = [own | {"loss": 0.51}, turned | {"loss": 0.5}]
    return {"rivals": rivals, "final": [own | {"loss": 0.45}], "limbs": [own | entry for entry in limbs]}


@pytest.mark.parametrize(
    ("limbs", "margin"),
    [
        ([{"loss": 0.4}], -0.0196),
        ([{"loss": 0.4}, {"seen": "the other way", "loss": 0.42}], 0.05),  # fitted for longer than the rivals
        ([{"seen": "the other way", "loss": 0.4}, {"loss": 0.41}], 0.025),
        ([{"loss": 0.4}, {"seen": "the other way", "loss": 0.42}, {"exchanged": "legs", "loss": 0.404}], 0.01),
        ([{"apart": "shoulder", "loss": 0.4}, {"loss": 0.401}, {"seen": "the other way", "loss": 0.44}], 0.1),  # arms
    ],
)
def test_swap_margin_is_of_the_longest_fits(limbs: list[dict], margin: float):
    assert _swap_margin(_log(*limbs)) == pytest.approx(margin, abs=1e-4)


def test_swap_margin_is_of_legs_that_overtake_each_other_too():
    log = _log({"loss": 0.4}, {"seen": "the other way", "loss": 0.42}) | {
        "overtaking": [dict(loss=0.41, picture=0.4), dict(loss=0.4, picture=0.402)]
    }
    assert _swap_margin(log) == pytest.approx(0.005, abs=1e-4)
