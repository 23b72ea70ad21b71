"""The skinned, coloured body of the procedural quadruped, around the joints of `slomo.synth.animal`."""

from dataclasses import dataclass

import numpy as np

from slomo.flesh import Cone, mesh, value_noise
from slomo.synth.animal import BONES, KEYPOINTS, Proportions, rest_joints


def _flesh(p: Proportions, j: dict[str, np.ndarray]) -> list[Cone]:
    h, g, r = p.height, p.girth, p.limb
    bone = {b: i for i, b in enumerate(BONES)}
    out: list[Cone] = []

    def add(name: tuple[str, str], a, b, ra: float, rb: float) -> None:
        out.append(Cone(bone[name], np.asarray(a, float), np.asarray(b, float) + 1e-6, ra * h, rb * h))

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
        vertices: (V, 3) m at rest.  triangles: (F, 3).  colors: (V, 3) sRGB.
        weights: (V, B) of `BONES`, rows sum to 1.
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
    n = value_noise(x * 6 + 9, rng) * 0.65 + value_noise(x * 15 + 3, rng) * 0.35
    below = np.clip((0.60 - x[:, 2] + 0.25 * (n - 0.5)) / 0.14, 0, 1)[:, None]
    color = base * (1 - below) + light * below
    if animal == "cat":
        wave = np.sin(34 * x[:, 0] + 9 * (value_noise(x * 5, rng) - 0.5) + 6 * x[:, 2])
        spots = np.clip(3 * wave - 0.6, 0, 1) * np.clip((x[:, 2] - 0.2) / 0.2, 0, 1)
    else:
        spots = np.clip((n - 0.56) / 0.03, 0, 1)
    color = color * (1 - spots[:, None]) + patch * spots[:, None]
    color *= (0.82 + 0.36 * value_noise(x * 40, rng))[:, None]

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
    v, f = mesh(cones, cell=0.0145 * p.height, blend=0.016 * p.height)
    near = np.full((len(v), len(BONES)), np.inf)
    for c in cones:
        near[:, c.bone] = np.minimum(near[:, c.bone], c.distance(v))
    w = np.exp(-(near - near.min(1, keepdims=True)) / (0.03 * p.height))
    w[w < 0.02] = 0
    colors = _coat(animal, p, v, joints, np.random.default_rng([seed, 2]))
    return Body(v, f, colors, w / w.sum(1, keepdims=True), joints)
