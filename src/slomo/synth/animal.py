"""The skeleton of a procedural quadruped: its key points, proportions by seed and joints at rest.

Rest frame: the animal stands on z = 0, faces +x, left is +y, the pelvis at x = y = 0.
Proportions are in units of the withers' height.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

FEET = ("front_left", "front_right", "hind_left", "hind_right")
LEG_JOINTS = {"front": ("shoulder", "elbow", "wrist", "paw"), "hind": ("hip", "knee", "hock", "paw")}
TRUNK = ("pelvis", "tail_base", "tail_tip", "spine_mid", "withers", "chest", "neck", "head", "nose")
KEYPOINTS = TRUNK + tuple(f"{leg}_{j}" for leg in FEET for j in LEG_JOINTS[leg.split("_")[0]])
BONES = (
    ("tail_base", "tail_tip"),
    ("pelvis", "tail_base"),
    ("pelvis", "spine_mid"),
    ("spine_mid", "withers"),
    ("withers", "chest"),
    ("withers", "neck"),
    ("neck", "head"),
    ("head", "nose"),
) + tuple(
    (f"{leg}_{a}", f"{leg}_{b}") for leg in FEET for js in (LEG_JOINTS[leg.split("_")[0]],) for a, b in pairwise(js)
)
ANIMALS = ("dog", "cat", "horse")


@dataclass(frozen=True)
class Proportions:
    """Sizes; all but `height` (m, of the withers) relative to it, angles in rad."""

    height: float
    trunk: float  # pelvis to withers
    hip: float  # heights of joints over the ground
    knee: float
    hock: float
    shoulder: float
    elbow: float
    wrist: float
    width: float  # between left and right feet
    girth: float  # radius of the ribcage
    limb: float  # radius of the forearm
    neck: float  # length
    neck_angle: float  # over the horizontal
    head: float  # skull base to nose
    skull: float  # radius
    ear: float  # length
    tail: float
    tail_angle: float  # of the tail over the horizontal, backwards
    paw: float  # half-length of the paw


# Estimated from side views of standing animals.
_SPECIES = {
    #           height trunk hip  knee hock shou elb  wri  width girth limb  neck ang  head  skull ear  tail ang  paw
    "dog": (
        0.56,
        0.84,
        0.76,
        0.52,
        0.26,
        0.66,
        0.50,
        0.17,
        0.24,
        0.170,
        0.046,
        0.36,
        0.85,
        0.37,
        0.115,
        0.15,
        0.52,
        0.55,
        0.075,
    ),
    "cat": (
        0.28,
        1.08,
        0.82,
        0.53,
        0.27,
        0.66,
        0.47,
        0.17,
        0.25,
        0.185,
        0.055,
        0.34,
        0.50,
        0.27,
        0.125,
        0.13,
        0.95,
        0.25,
        0.075,
    ),
    "horse": (
        1.50,
        0.86,
        0.78,
        0.59,
        0.37,
        0.66,
        0.55,
        0.29,
        0.22,
        0.190,
        0.036,
        0.52,
        0.75,
        0.37,
        0.085,
        0.10,
        0.48,
        -0.95,
        0.05,
    ),
}


def proportions(animal: str, seed: int, *, variation: float = 0.07) -> Proportions:
    """A member of a species ("dog", "cat", "horse"), every size off by up to `variation`."""
    x = np.array(_SPECIES[animal])
    return Proportions(*(x * (1 + variation * np.random.default_rng([seed, 1]).uniform(-1, 1, len(x)))).tolist())


def rest_joints(p: Proportions) -> dict[str, np.ndarray]:
    """Joint centres of the standing animal, (3,) m each, by the names of `KEYPOINTS`."""
    w = p.width / 2
    sole = 0.03
    up = np.array([np.cos(p.neck_angle), 0, np.sin(p.neck_angle)])
    withers = np.array([p.trunk, 0, 0.84])
    head = withers + p.neck * up
    tail_base = np.array([-0.13, 0, p.hip + 0.05])
    joints = dict(
        pelvis=np.array([0.0, 0, p.hip + 0.03]),
        tail_base=tail_base,
        tail_tip=tail_base + p.tail * np.array([-np.cos(p.tail_angle), 0, np.sin(p.tail_angle)]),
        spine_mid=np.array([p.trunk / 2, 0, (p.hip + 0.03 + 0.84) / 2]),
        withers=withers,
        chest=np.array([p.trunk + 0.06, 0, p.shoulder]),
        neck=withers + p.neck / 2 * up + 0.02 * np.array([up[2], 0, -up[0]]),
        head=head,
        nose=head + p.head * np.array([0.96, 0, -0.28]),
    )
    for side, y in (("left", 1), ("right", -1)):
        x = p.trunk - 0.04
        front = [(p.trunk + 0.06, 1.10, p.shoulder), (x, 1.05, p.elbow), (x + 0.01, 1, p.wrist), (x + 0.08, 1, sole)]
        hind = [(-0.02, 0.95, p.hip), (0.12, 1.08, p.knee), (-0.12, 1, p.hock), (-0.02, 1, sole)]
        for end, chain in (("front", front), ("hind", hind)):
            for name, (jx, jy, jz) in zip(LEG_JOINTS[end], chain, strict=True):
                joints[f"{end}_{side}_{name}"] = np.array([jx, y * w * jy, jz])
    return {k: v * p.height for k, v in joints.items()}
