"""The verdict: what each figure says, and what all of them do."""

import numpy as np
import pytest

from slomo.reconstruct.verdict import Check, Facts, checks, floating, verdict

GOOD = Facts(
    report=dict(silhouette_iou=0.85, flow_residual_px=0.4, swap_margin=0.05, foot_skate_mps=0.01),
    masks=dict(quality_mean=0.9, frames_without_subject=0),
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
