"""How far a reconstruction is to be trusted, and why: figures that need no truth, each with what is good and what is
not usable any more. Limits are rules of thumb from rendered clips, wide on purpose: they warn, they do not measure."""

from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray

ALOFT = 0.5  # s: nothing that walks, trots or jumps on the spot is off the ground for longer
OVERLAP = 0.72  # of silhouettes: the rest pose at the right place has 0.5 to 0.6, a fit that is right 0.75 and more
_BY_MOTION = "shadows and boxes may be in the masks: run `slomo weights fetch`, then this again"
NEAR = 0.08  # body lengths above its stance height at which a foot still is at the ground


@dataclass(frozen=True)
class Check:
    """One figure.

    Attributes:
        value: None where it could not be told.
        good: the limit up to which there is nothing to say; unusable: the one beyond which the result is worth nothing,
            None where the figure alone never says so. `least`: both are least values, not largest ones.
        todo: what it may mean, or what the user can do about it.
    """

    name: str
    value: float | None
    good: float
    unusable: float | None
    todo: str
    least: bool = False

    @property
    def level(self) -> str:
        """good, poor, unusable or unknown."""
        if self.value is None or not np.isfinite(self.value):
            return "unknown"
        sign = -1.0 if self.least else 1.0
        if self.unusable is not None and sign * self.value > sign * self.unusable:
            return "unusable"
        return "good" if sign * self.value <= sign * self.good else "poor"

    def as_dict(self) -> dict[str, Any]:
        value = None if self.level == "unknown" else round(float(self.value or 0.0), 4)
        out = {"name": self.name, "value": value, "good": self.good, "unusable": self.unusable, "level": self.level}
        return out | ({"todo": self.todo} if self.level in ("poor", "unusable") else {})


@dataclass(frozen=True)
class Facts:
    """What the checks look at.

    Attributes:
        report: of the fit (`outcome.assess`). masks: report of the masks. camera: report of the camera.
        feet: (T, F, 3) m; sole: m, height of a standing foot's key point; t: (T,) s; length: m, the body's.
        stretch: (M,) lengths of the bones over the skeleton's own, the body's length taken off; of short ones less.
    """

    report: dict[str, Any]
    masks: dict[str, Any]
    camera: dict[str, Any]
    feet: Array
    sole: float
    t: Array
    length: float
    stretch: Array


def checks(f: Facts) -> list[Check]:
    """All checks, in the order of the stages that they are about."""
    look = "look at the masks; choose the subject with --subject-at, or give your own with --masks"
    limb = f"look at {f.report['silhouette_low_s']:.1f} s: some limb is not where it is seen"
    frames = max(len(f.t), 1)
    # Where the mean over the clip is low, so is this: that would count twice.
    low = f.report["silhouette_iou_low"] if f.report["silhouette_iou"] >= OVERLAP else None
    height = (f.feet[..., 2] - f.sole) / f.length
    return [
        Check("masks_by_motion", float(f.masks.get("segmenter") == "motion"), 0, None, _BY_MOTION),
        Check("mask_quality", f.masks.get("quality_mean"), 0.7, 0.3, look, least=True),
        Check("frames_without_subject", f.masks.get("frames_without_subject", 0) / frames, 0.1, 0.6, look),
        Check("camera_error_px", f.camera.get("reprojection_error_px"), 1.5, None, "a camera in doubt: give --fov"),
        Check("gravity_std_deg", f.camera.get("gravity_std_deg"), 4.0, None, "film more of the ground"),
        Check("silhouette_iou", f.report["silhouette_iou"], OVERLAP, 0.45, look, least=True),
        Check("silhouette_iou_low", low, 0.75, None, limb, least=True),
        Check("flow_residual_px", f.report["flow_residual_px"], 2.0, None, "motion blur, or another body"),
        Check("swap_margin", f.report["swap_margin"], 0.01, None, "left and right legs may be swapped", least=True),
        Check("foot_skate", f.report["foot_skate_mps"] / f.length, 0.35, 2.5, "standing feet slide: the camera is off"),
        Check("penetration", float(np.quantile(np.maximum(-height, 0), 0.99)), 0.04, 0.4, "feet are below the ground"),
        Check("floating_s", floating(height, f.t), ALOFT, None, "nothing touches the ground: is it a jump?"),
        Check("bone_change", float(np.abs(np.log(f.stretch)).max()), 0.6, 1.5, "give a --skeleton that is more alike"),
    ]  # fmt: skip


def floating(height: Array, t: Array) -> float:
    """s, the longest time during which no foot (T, F) is near the ground."""
    longest, since = 0.0, None
    for time, foot in zip(t.tolist(), height.min(1).tolist(), strict=True):
        since = (time if since is None else since) if foot > NEAR else None
        longest = max(longest, time - since if since is not None else 0.0)
    return longest


def verdict(found: list[Check]) -> dict[str, Any]:
    """`trust` ("good", "fair" with at most two poor figures, "poor", or "unusable"), `text` and the checks."""
    bad = [c for c in found if c.level == "unusable"]
    poor = [c for c in found if c.level == "poor"]
    trust = "unusable" if bad else "good" if not poor else "fair" if len(poor) <= 2 else "poor"
    said = "; ".join(_said(c) for c in bad or poor)
    return {"trust": trust, "text": said or "nothing speaks against it", "checks": [c.as_dict() for c in found]}


def _said(c: Check) -> str:
    limit = c.unusable if c.level == "unusable" else c.good
    return f"{c.name} {c.value:.3g} ({'at least' if c.least else 'at most'} {limit:g}): {c.todo}"
