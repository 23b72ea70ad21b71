"""A procedural quadruped: proportions, joints at rest, a skinned body and a coat, all from a seed.

Rest frame: the animal stands on z = 0, faces +x, left is +y, the pelvis at x = y = 0. Proportions are in units of the withers' height.
"""

from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from warp.geometry import IsoSurfaceMarchingCubes

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
    (f"{leg}_{a}", f"{leg}_{b}")
    for leg in FEET
    for js in (LEG_JOINTS[leg.split("_")[0]],)
    for a, b in zip(js, js[1:], strict=False)
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


@dataclass(frozen=True)
class _Cone:
    """A capsule with two radii (m) that bone `bone` carries."""

    bone: int
    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float

    def distance(self, x: np.ndarray) -> np.ndarray:
        d = self.b - self.a
        s = np.clip((x - self.a) @ d / (d @ d), 0, 1)
        return np.linalg.norm(x - self.a - s[..., None] * d, axis=-1) - (self.ra + s * (self.rb - self.ra))


def _flesh(p: Proportions, j: dict[str, np.ndarray]) -> list[_Cone]:
    h, g, r = p.height, p.girth, p.limb
    bone = {b: i for i, b in enumerate(BONES)}
    out: list[_Cone] = []

    def add(name: tuple[str, str], a, b, ra: float, rb: float) -> None:
        out.append(_Cone(bone[name], np.asarray(a, float), np.asarray(b, float) + 1e-6, ra * h, rb * h))

    def at(name: str, x: float = 0, y: float = 0, z: float = 0) -> np.ndarray:
        return j[name] + h * np.array([x, y, z])

    rear, fore = ("pelvis", "spine_mid"), ("spine_mid", "withers")
    add(rear, at("pelvis", -0.06, 0, -0.04), at("spine_mid", 0, 0, -0.07), 0.70 * g, 0.84 * g)
    add(fore, at("spine_mid", 0, 0, -0.07), at("withers", -0.10, 0, -0.12), 0.84 * g, 0.92 * g)
    add(fore, at("spine_mid", 0.06, 0, -0.12), at("chest", -0.06, 0, -0.03), 0.84 * g, 0.85 * g)
    add(fore, at("withers", -0.02, 0, 0.02), at("withers", -0.2, 0, 0.0), 0.5 * g, 0.5 * g)
    add(("withers", "chest"), at("chest", 0, 0, 0.02), at("chest", -0.05, 0, 0.08), 0.72 * g, 0.8 * g)
    add(("withers", "neck"), at("withers", -0.02, 0, -0.04), j["neck"], 0.66 * g, 0.50 * g)
    add(("neck", "head"), j["neck"], j["head"], 0.50 * g, 0.80 * p.skull)
    d = (j["nose"] - j["head"]) / h
    skull = at("head", *(0.22 * d))
    add(("head", "nose"), skull, skull + 0.1 * h * d, p.skull, 0.95 * p.skull)
    add(
        ("head", "nose"),
        skull + h * (0.2 * d - [0, 0, 0.1 * p.skull]),
        j["nose"] - 0.13 * h * d,
        0.68 * p.skull,
        0.36 * p.skull,
    )
    tail = ("tail_base", "tail_tip")
    add(tail, at("tail_base", 0.04), j["tail_tip"], 0.28 * g + 0.004, 0.10 * g + 0.006)
    for s, y in (("left", 1), ("right", -1)):
        ear = skull + h * np.array([-0.02, 0.62 * y * p.skull, 0.62 * p.skull])
        add(("head", "nose"), ear, ear + h * p.ear * np.array([-0.05, 0.28 * y, 0.95]), 0.40 * p.skull, 0.10 * p.skull)
        f, k = f"front_{s}_", f"hind_{s}_"
        upper = (f + "shoulder", f + "elbow")
        add(upper, at(f + "shoulder", -0.01, -0.02 * y), at(f + "elbow"), 0.46 * g, 0.32 * g + 0.3 * r)
        add((f + "elbow", f + "wrist"), at(f + "elbow", -0.01), j[f + "wrist"], 1.35 * r, 0.80 * r)
        add((f + "wrist", f + "paw"), j[f + "wrist"], at(f + "paw", -0.03, 0, 0.02), 0.80 * r, 0.75 * r)
        thigh = (k + "hip", k + "knee")
        add(thigh, at(k + "hip", 0, -0.04 * y, -0.02), at(k + "knee", -0.02, 0, 0.02), 0.68 * g, 0.36 * g)
        add((k + "knee", k + "hock"), at(k + "knee", -0.02), j[k + "hock"], 0.36 * g, 0.80 * r)
        add((k + "hock", k + "paw"), j[k + "hock"], at(k + "paw", -0.03, 0, 0.02), 0.82 * r, 0.75 * r)
        for leg in (f, k):
            joint = "wrist" if leg is f else "hock"
            toe = (leg + joint, leg + "paw")
            add(toe, at(leg + "paw", -0.6 * p.paw, 0, 0.008), at(leg + "paw", 0.35 * p.paw), 0.036, 0.026)
    return out


@dataclass(frozen=True)
class Body:
    """A skinned mesh.

    Attributes:
        vertices: (V, 3) m at rest.  triangles: (F, 3).  colors: (V, 3) sRGB.  weights: (V, B) of `BONES`, rows sum to 1.
        joints: name -> (3,) m at rest.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    weights: np.ndarray
    joints: dict[str, np.ndarray]

    def skin(self, keypoints: np.ndarray, lateral: np.ndarray) -> np.ndarray:
        """(V, 3) m, the posed body. Args: keypoints (N, 3) in order of `KEYPOINTS`; lateral (3,) the trunk's left."""
        rest = np.stack([self.joints[n] for n in KEYPOINTS])
        T = bone_frames(keypoints, lateral) @ np.linalg.inv(bone_frames(rest, np.array([0.0, 1, 0])))
        M = np.einsum("vb,bij->vij", self.weights, T[:, :3])
        return np.einsum("vij,vj->vi", M[..., :3], self.vertices) + M[..., 3]


def bone_frames(keypoints: np.ndarray, lateral: np.ndarray) -> np.ndarray:
    """(B, 4, 4): origin at each bone's first joint, x along the bone, y as near to `lateral` as can be."""
    at = {n: keypoints[i] for i, n in enumerate(KEYPOINTS)}
    T = np.tile(np.eye(4), (len(BONES), 1, 1))
    for i, (a, b) in enumerate(BONES):
        x = (at[b] - at[a]) / np.linalg.norm(at[b] - at[a])
        y = lateral - (lateral @ x) * x
        y /= np.linalg.norm(y)
        T[i, :3, :3] = np.stack([x, y, np.cross(x, y)], 1)
        T[i, :3, 3] = at[a]
    return T


def _value_noise(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(V,) smooth noise in [0, 1], cell 1, from points (V, 3)."""
    table = rng.random((32, 32, 32))
    i = np.floor(x).astype(int)
    f = x - i
    f = f * f * (3 - 2 * f)
    out = np.zeros(len(x))
    for c in np.ndindex(2, 2, 2):
        w = np.prod(np.where(c, f, 1 - f), axis=1)
        out += w * table[tuple(((i + c) % 32).T)]
    return out


_COATS = {
    "dog": [
        ((0.20, 0.17, 0.15), (0.72, 0.50, 0.30), (0.92, 0.90, 0.86)),
        ((0.58, 0.38, 0.20), (0.93, 0.90, 0.84), (0.30, 0.20, 0.13)),
    ],
    "cat": [
        ((0.62, 0.40, 0.20), (0.80, 0.62, 0.42), (0.38, 0.22, 0.10)),
        ((0.50, 0.47, 0.44), (0.82, 0.80, 0.76), (0.20, 0.19, 0.18)),
    ],
    "horse": [
        ((0.42, 0.24, 0.13), (0.30, 0.17, 0.09), (0.90, 0.88, 0.84)),
        ((0.80, 0.78, 0.74), (0.36, 0.30, 0.26), (0.25, 0.22, 0.20)),
    ],
}


def _coat(animal: str, p: Proportions, v: np.ndarray, j: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """(V, 3) sRGB: a base, a lighter belly and lower legs, patches or stripes, dark nose, eyes and toes."""
    base, light, patch = (np.array(c) for c in _COATS[animal][rng.integers(2)])
    x = v / p.height
    n = _value_noise(x * 6 + 9, rng) * 0.65 + _value_noise(x * 15 + 3, rng) * 0.35
    below = np.clip((0.60 - x[:, 2] + 0.25 * (n - 0.5)) / 0.14, 0, 1)[:, None]
    color = base * (1 - below) + light * below
    if animal == "cat":
        wave = np.sin(34 * x[:, 0] + 9 * (_value_noise(x * 5, rng) - 0.5) + 6 * x[:, 2])
        spots = np.clip(3 * wave - 0.6, 0, 1) * np.clip((x[:, 2] - 0.2) / 0.2, 0, 1)
    else:
        spots = np.clip((n - 0.56) / 0.03, 0, 1)
    color = color * (1 - spots[:, None]) + patch * spots[:, None]
    color *= (0.82 + 0.36 * _value_noise(x * 40, rng))[:, None]

    def paint(centre: np.ndarray, radius: float, rgb: tuple[float, float, float]) -> None:
        s = np.clip((radius - np.linalg.norm(x - centre / p.height, axis=1)) / 0.012 + 0.5, 0, 1)[:, None]
        color[:] = color * (1 - s) + np.array(rgb) * s

    along = j["nose"] - j["head"]
    paint(j["nose"], 0.12 * p.head, (0.07, 0.06, 0.06))
    for y in (1, -1):
        eye = j["head"] + 0.50 * along + p.height * np.array([0, 0.80 * y * p.skull, 0.45 * p.skull])
        paint(eye, 0.028, (0.05, 0.04, 0.04))
    toes = x[:, 2] < (0.075 if animal == "horse" else 0.022)
    color[toes] *= 0.35
    return np.clip(color, 0.02, 0.97)


def build_body(animal: str, p: Proportions, seed: int) -> Body:
    """Mesh the smooth union of the flesh (marching cubes), skin it to the bones and colour it."""
    joints = rest_joints(p)
    cones = _flesh(p, joints)
    cell, blend = 0.0145 * p.height, 0.016 * p.height
    ends = np.stack([e for c in cones for e in (c.a, c.b)])
    lower, upper = ends.min(0) - 0.24 * p.height, ends.max(0) + 0.24 * p.height
    shape = np.ceil((upper - lower) / cell).astype(int) + 1
    grid = lower + cell * np.stack(np.meshgrid(*(np.arange(s) for s in shape), indexing="ij"), -1)
    total = np.zeros(tuple(shape))
    for c in cones:
        total += np.exp(np.clip(-c.distance(grid) / blend, -60, 60))
    field = wp.array((-blend * np.log(total + 1e-20)).astype(np.float32), dtype=float, device="cpu")
    bounds = [wp.vec3(*lower), wp.vec3(*(lower + cell * (shape - 1)))]
    verts, faces = IsoSurfaceMarchingCubes.extract(field, 0.0, lower=bounds[0], upper=bounds[1])
    v, f = verts.numpy().astype(float), faces.numpy().reshape(-1, 3)
    near = np.full((len(v), len(BONES)), np.inf)
    for c in cones:
        near[:, c.bone] = np.minimum(near[:, c.bone], c.distance(v))
    w = np.exp(-(near - near.min(1, keepdims=True)) / (0.03 * p.height))
    w[w < 0.02] = 0
    colors = _coat(animal, p, v, joints, np.random.default_rng([seed, 2]))
    return Body(v, f, colors, w / w.sum(1, keepdims=True), joints)


assert len(fields(Proportions)) == len(_SPECIES["dog"])
