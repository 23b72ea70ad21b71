"""Rendered clips that are hard for masks, with their truth, by slomo's own renderer."""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.raycast import Part, Scene
from slomo.synth.animal import KEYPOINTS, proportions
from slomo.synth.body import build_body
from slomo.synth.gait import animate
from slomo.synth.scene import ANIMAL, NEAR, box, camera, light, surroundings

CASES = ("plain", "post", "crossing", "leaves", "blurred", "nobody")
OTHER = 9  # part id of a second animal
SIZE = (384, 216)


@dataclass(frozen=True)
class Case:
    """Frames (T, H, W, 3) uint8 RGB, the subject's visible part (T, H, W) bool, and the second animal's, if any."""

    frames: np.ndarray
    masks: np.ndarray
    other: np.ndarray


def make_case(name: str, *, animal: str = "dog", seed: int = 3, seconds: float = 2.5, fps: float = 24.0) -> Case:
    """One of `CASES`: an animal that walks, filmed by hand.

    "post": posts stand in front of its path. "crossing": a second animal walks the other way behind it. "leaves": the
    camera turns away for a third of the clip. "blurred": shaken frames in between, and a flickering exposure. "nobody":
    no animal in the scene.
    """
    t = np.arange(round(seconds * fps)) / fps
    p = proportions(animal, seed)
    motion = animate(p, "walk", t, speed=None, turn=0.0, seed=seed)
    k = motion.keypoints
    length = float(np.linalg.norm(k[:, KEYPOINTS.index("nose")] - k[:, KEYPOINTS.index("tail_tip")], axis=1).mean())
    target = (k[:, KEYPOINTS.index("nose")] + k[:, KEYPOINTS.index("tail_tip")]) / 2
    target[:, 2] = 0.55 * p.height
    K, T_world_cam = camera("follow", target, t, length=1.25 * length, view=0.25, size=SIZE, shake=1.0, seed=seed)
    eye = T_world_cam[:, :2, 3]
    body = build_body(animal, p, seed)
    coat = Part(body.vertices, body.triangles, body.colors, ANIMAL, grain=0.35, grain_size=0.012 * p.height)
    parts = surroundings(target[:, :2], eye, p.height, clutter=name == "plain", seed=seed)
    moving = {}
    if name != "nobody":
        parts["animal"], moving["animal"] = coat, (body, k, motion.lateral)
    if name == "post":
        for i, along in enumerate((0.3, 0.55)):  # of the path
            at = target[round(along * (len(t) - 1)), :2]
            at = at + 0.45 * (eye.mean(0) - at) / np.linalg.norm(eye.mean(0) - at) * length
            v, f = box(at[0], at[1], (0.06 * length, 0.06 * length, 0.9 * p.height), 0.3 + i)
            parts[f"post{i}"] = Part(v, f, np.array([0.45, 0.33, 0.25]), NEAR, grain=0.7, grain_size=0.03, smooth=False)
    if name == "crossing":
        q = proportions("dog", seed + 11)
        second = build_body("dog", q, seed + 11)
        walk = animate(q, "walk", t, speed=None, turn=0.0, seed=seed + 11)
        middle = target[len(t) // 2]
        behind = middle[:2] + 1.2 * length * (middle[:2] - eye[len(t) // 2]) / np.linalg.norm(middle[:2] - eye.mean(0))
        points = walk.keypoints - [*walk.keypoints[len(t) // 2, 0, :2], 0.0]
        points = points * [-1, -1, 1] + [*behind, 0.0]  # half a turn: it walks the other way
        parts["other"] = Part(second.vertices, second.triangles, second.colors, OTHER, grain=0.35, grain_size=0.006)
        moving["other"] = (second, points, walk.lateral * [-1, -1, 1])
    if name == "leaves":
        away = np.radians(70) * np.clip(1.6 * np.sin(np.pi * np.clip((t / t[-1] - 0.2) / 0.6, 0, 1)) - 0.35, 0, 0.75)
        for T, a in zip(T_world_cam, away, strict=True):
            c, s = np.cos(a), np.sin(a)
            T[:3, :3] = T[:3, :3] @ [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    toward = float(np.arctan2(*(eye - target[:, :2]).mean(0)[::-1]))
    scene = Scene(parts, light(p.height, toward, seed))
    rng = np.random.default_rng([seed, 8])
    frames, masks, other = [], [], []
    for i in range(len(t)):
        scene.move({n: b.skin(x[i], side[i]) for n, (b, x, side) in moving.items()})
        image = scene.render(K, T_world_cam[i], SIZE, supersample=2)
        rgb = image.rgb.astype(np.float32)
        if name == "blurred":
            rgb *= 1 + 0.15 * np.sin(1.9 * i)
            if i % 12 in (5, 6, 7):
                smear = np.zeros((15, 15), np.float32)
                cv2.line(smear, (0, 4), (14, 10), 1.0)
                rgb = cv2.filter2D(rgb, -1, smear / smear.sum())
        rgb += 2.0 * rng.standard_normal(rgb.shape, np.float32)
        frames.append(np.clip(rgb + 0.5, 0, 255).astype(np.uint8))
        masks.append(image.mask(ANIMAL))
        other.append(image.mask(OTHER))
    return Case(np.array(frames), np.array(masks), np.array(other))
