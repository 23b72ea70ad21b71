"""A person's key points as a `Subject`, from a whole skeleton or from pelvis, wrists and ankles alone."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion
from slomo.retarget.subject import Hands, Subject
from slomo.retarget.trunk import Pairs, Trunk, across, frame, middle, seen
from slomo.rotation import rot_z
from slomo.skeleton import load_skeleton

Array = np.ndarray
SIDES = LIMBS = ("left", "right")
_HIPS, _SHOULDERS = ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")
_WRISTS, _ANKLES = ("left_wrist", "right_wrist"), ("left_ankle", "right_ankle")
_LOWER = (_HIPS, ("pelvis",))
_UPPER = (_SHOULDERS, ("neck",), ("chest",), ("head",))
PAIRS: Pairs = (_HIPS, _SHOULDERS)
_TURN = 0.5  # s, standard deviation of the window in which swinging arms and legs show the heading
_STILL = 0.15  # of the mean: a spread of left minus right that is noise rather than a swing
# Squared cosine between the mean and the spread of left minus right: limbs swing up to the first, open from the second.
_SWINGS, _OPENS = 0.5, 0.85
_BACKWARDS = 2.0  # rad
_TURNED_OUT = 0.8  # rad, toes further from the heading than this are not seen right


def ends(limb: str) -> tuple[str, ...]:
    """Key points of a leg and an arm, the first of which is needed."""
    return tuple(f"{limb}_{n}" for n in ("ankle", "toe", "knee", "wrist", "elbow"))


def trunk_of(motion: KeypointMotion, *, dt: float | None = None) -> Trunk:
    """From hips and shoulders, or upright and looking where wrists and ankles say.

    Raises:
        InvalidData: no hips and no pelvis, or nothing that tells left from right.
    """
    origin = middle(motion, _LOWER, "the hips")
    if any(seen(motion, group) for group in _UPPER):
        up = middle(motion, _UPPER, "the upper end of the trunk") - origin
        if np.median(np.linalg.norm(up, axis=1)) == 0:
            raise InvalidData("upper and lower end of the trunk coincide", where="key points")
    else:
        up = np.broadcast_to([0.0, 0.0, 1.0], origin.shape)
    left = across(motion, PAIRS)
    if not np.any(left):
        step = dt or float(np.median(np.diff(motion.t)))
        left = _left_of_swinging(across(motion, (_ANKLES, _WRISTS)), window=_TURN / step)
    if not np.any(left):
        raise InvalidData("nothing tells left from right", where="key points", valid=[n for p in PAIRS for n in p])
    return Trunk(origin=origin, rotation=frame(up, left, axis="z"))


def _left_of_swinging(d: Array, *, window: float) -> Array:
    """(T, 3) horizontal direction to the left from d (T, 3), right to left between limbs that swing fore and aft.

    In each window d is a constant to the left and a swing ahead. Its mean has a part of the swing left, unless the
    window holds whole strides; that part lies along the direction in which d varies most, and is taken out of the
    mean. Where d varies along its mean instead, limbs open and close (jumping jacks), and the mean stays as it is.
    The windows turn with the body: what was found is undone, and found again, which leaves less to find.

    Args:
        window: standard deviation, in frames.
    """
    heading = np.zeros(len(d))
    for _ in range(4):
        left = _left_in_window((rot_z(-heading) @ d[..., None])[:, :2, 0], window)
        heading = heading + np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))
    return np.stack([-np.sin(heading), np.cos(heading), np.zeros(len(d))], axis=1)


def _left_in_window(d: Array, window: float) -> Array:
    """(T, 2) unit vectors: the mean of d (T, 2) in a window without the part that swings."""

    def mean(x: Array) -> Array:
        flat = gaussian_filter1d(x.reshape(len(x), -1), window, axis=0, mode="constant")
        return (flat / gaussian_filter1d(np.ones(len(x)), window, mode="constant")[:, None]).reshape(x.shape)

    m = mean(d)
    spread, axes = np.linalg.eigh(mean(d[:, :, None] * d[:, None]) - m[:, :, None] * m[:, None])
    swing = axes[..., 1]
    length = np.maximum(np.linalg.norm(m, axis=1), 1e-300)
    along = np.sum(m * swing, axis=1) / length
    lopsided = (spread[:, 1] - spread[:, 0]) / (spread.sum(axis=1) + (_STILL * length) ** 2)
    part = lopsided * np.clip((_OPENS - along**2) / (_OPENS - _SWINGS), 0, 1)
    left = m / length[:, None] - (part * along)[:, None] * swing
    return left / np.maximum(np.linalg.norm(left, axis=1), 1e-300)[:, None]


def read(motion: KeypointMotion) -> Subject:
    """The person: soles are the left and the right foot."""
    trunk, said = trunk_of(motion), []
    if not any(seen(motion, group) for group in _UPPER):
        said.append("nothing marks the upper body: it is kept upright, and shoulders are placed by usual proportions")
    usual = load_skeleton("human")
    at = dict(zip(usual.names, usual.rest(), strict=True))
    thigh_and_shank = at["left_hip"][2] - at["left_ankle"][2]
    ankle = at["left_ankle"][2] - at["left_toe"][2] + usual.sole

    feet, confidence, stands = [], [], []
    for side in SIDES:
        c = motion.index(f"{side}_ankle")
        feet.append(_sole(motion, side))
        confidence.append(motion.confidence[:, c])
        given = [n for n in (f"{side}_toe", f"{side}_ankle") if n in motion.contact_names]
        if motion.contact is not None and given:
            stands.append(motion.contact[:, motion.contact_names.index(given[0])])
        else:
            stands.append(np.full(len(motion.t), np.nan))
    feet, confidence = np.stack(feet, axis=1), np.stack(confidence, axis=1)

    standing = _bones(motion, ("hip", "knee", "ankle"))
    if standing is None:
        known = confidence.max(axis=0) > 0
        over = trunk.origin[:, 2] - np.where(known, feet[..., 2], np.inf).min(axis=1)
        standing = float(np.percentile(over, 90))
        said.append("no knees: the leg is as long as the hips are high over the lower ankle when they are highest")
    fixed = bool(np.ptp(trunk.origin, axis=0).max() < 1e-6 * abs(standing))
    if fixed:
        said.append("the body never moves: its height and path are those that keep the feet on the ground")
    return Subject(
        trunk=trunk,
        feet=feet,
        confidence=confidence,
        stands=np.stack(stands, axis=1),
        pointing=_pointing(motion, trunk),
        standing=standing,
        leg=standing * (1 + ankle / thigh_and_shank),
        hands=_hands(motion, trunk, standing / thigh_and_shank, at),
        fixed=fixed,
        said=tuple(said),
    )


def _bones(motion: KeypointMotion, names: tuple[str, str, str]) -> float | None:
    """Length (m) of two bones in a row, the median over time and both sides, or None."""
    lengths = []
    for side in SIDES:
        points = tuple(f"{side}_{n}" for n in names)
        if seen(motion, points):
            trusted = np.min([motion.confidence[:, motion.index(n)] for n in points], axis=0) > 0
            a, b, c = (motion[n][trusted] for n in points)
            lengths.append(np.linalg.norm(a - b, axis=1) + np.linalg.norm(b - c, axis=1))
    lengths = np.concatenate([x for x in lengths if len(x)]) if any(map(len, lengths)) else None
    return None if lengths is None else float(np.median(lengths))


def _sole(motion: KeypointMotion, side: str) -> Array:
    """(T, 3) m: over the middle of the foot, as high as the ankle, but not higher where only the heel rises."""
    ankle = motion[f"{side}_ankle"]
    if not seen(motion, (f"{side}_toe",)):
        return ankle
    toe = motion[f"{side}_toe"]
    apart = np.percentile(ankle[:, 2], 15) - np.percentile(toe[:, 2], 15)
    return np.column_stack([(ankle + toe)[:, :2] / 2, np.minimum(ankle[:, 2], toe[:, 2] + apart)])


def _pointing(motion: KeypointMotion, trunk: Trunk) -> Array | None:
    """(T, 2) rad, world, continuous; the heading for a foot whose toe was never seen; None without toes."""
    if not any(seen(motion, (f"{s}_toe",)) for s in SIDES):
        return None
    out, turns = np.empty((len(motion.t), 2)), []
    for s, side in enumerate(SIDES):
        out[:, s] = trunk.heading
        if seen(motion, (f"{side}_toe", f"{side}_ankle")):
            d = motion[f"{side}_toe"] - motion[f"{side}_ankle"]
            turned = np.arctan2(d[:, 1], d[:, 0]) - trunk.heading
            turned = np.angle(np.exp(1j * turned))
            # A foot seen from its toes, as in a kneeling person's, points nowhere.
            flat = np.linalg.norm(d[:, :2], axis=1) > 0.3 * np.linalg.norm(d, axis=1)
            usual = float(np.median(turned[flat])) if flat.any() else 0.0
            turns.append(usual)
            out[:, s] += np.clip(np.where(flat, turned, usual), -_TURNED_OUT, _TURNED_OUT)
    if turns and min(np.abs(turns)) > _BACKWARDS:
        raise InvalidData(
            "the toes point backwards", where="key points", todo="check that left and right are not exchanged"
        )
    return out


def _hands(motion: KeypointMotion, trunk: Trunk, height: float, at: dict[str, Array]) -> Hands | None:
    """Hands from shoulders; `height` (m) is the person's by the leg, `at` the usual proportions."""
    if not any(seen(motion, (f"{s}_wrist",)) for s in SIDES):
        return None
    offsets, confidence = np.zeros((len(motion.t), 2, 3)), np.zeros((len(motion.t), 2))
    R = trunk.rotation
    for s, side in enumerate(SIDES):
        if not seen(motion, (f"{side}_wrist",)):
            continue
        confidence[:, s] = motion.confidence[:, motion.index(f"{side}_wrist")]
        if seen(motion, (f"{side}_shoulder",)):
            shoulder = motion[f"{side}_shoulder"]
        else:
            usual = at[f"{side}_shoulder"] - (at["left_hip"] + at["right_hip"]) / 2
            shoulder = trunk.origin + R.apply(height * usual)
        offsets[:, s] = R.inv().apply(motion[f"{side}_wrist"] - shoulder)
    arm = _bones(motion, ("shoulder", "elbow", "wrist"))
    if arm is None:
        bones = np.diff([at["left_shoulder"], at["left_elbow"], at["left_wrist"]], axis=0)
        usual = height * float(np.linalg.norm(bones, axis=1).sum())
        stretched = np.linalg.norm(offsets, axis=2)[confidence > 0]
        arm = max(usual, float(np.percentile(stretched, 98)) if len(stretched) else 0.0)
    return Hands(offset=offsets / arm, confidence=confidence, arm=arm)
