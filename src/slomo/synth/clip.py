"""Render a clip of a procedural animal or person, with its truth: `clip.mp4`, `truth.npz` and `masks.npz`."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slomo.errors import UsageError
from slomo.formats.mp4 import encode_mp4
from slomo.packed import pack
from slomo.raycast import Part, Scene
from slomo.stage import Progress
from slomo.synth.actor import ACTORS, Actor, act, moves
from slomo.synth.scene import ANIMAL, CAMERAS, camera, light, surroundings

# How fast the motion is played, by the share of the clip that is over.
TEMPOS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "steady": np.ones_like,
    "faster": lambda u: 0.4 + 1.2 * u,
    "slower": lambda u: 1.6 - 1.2 * u,
    "stops": lambda u: ((0.62 - u) / 0.15).clip(0, 1),
    "starts": lambda u: ((u - 0.3) / 0.2).clip(0, 1),
}


@dataclass(frozen=True)
class Config:
    """What is rendered; the same config and seed give the same truth.

    Attributes:
        animal: "dog", "cat", "horse" or "person"; its proportions and coat, or clothes, vary with the seed.
        gait: "walk", "pace", "trot", "gallop", "rotary" (a gallop whose front and hind leads differ), or on the spot
            "stand", "reach" (lifts a front paw), "graze", "rear", "sit" and "lie" (down, and up again; not a horse); of
            a person "walk", "run", "stand", "squat", "jack", "wave", "stretch", "bend" or "jump".
        speed: m/s; 0 = the usual speed of the gait.
        turn: degrees/s, positive to the left.
        tempo: "steady", or played "faster" or "slower" (fourfold from one end to the other), or it "stops" after half
            of the clip or "starts" after a third: strides keep their length, and no gait has one frequency.
        camera: "follow", "orbit", "pan" or "static".  view: degrees, 0 = the left flank, 90 = from the front.
        shake: camera shake, 1 = a hand.  clutter: posts near the animal.
        seconds, fps, width, height: of the clip (px).
        noise: standard deviation of the sensor noise, of 255.  crf: H.264 quality, lower is better.
        seed: of the animal, its small motions, the place and the hand.
    """

    animal: str = "dog"
    gait: str = "walk"
    speed: float = 0.0
    turn: float = 0.0
    tempo: str = "steady"
    camera: str = "follow"
    view: float = 15.0
    shake: float = 1.0
    clutter: bool = False
    seconds: float = 3.0
    fps: float = 30.0
    width: int = 480
    height: int = 270
    noise: float = 2.0
    crf: int = 22
    seed: int = 0

    def __post_init__(self):
        choices = (("animal", ACTORS), ("gait", moves(self.animal)), ("tempo", tuple(TEMPOS)), ("camera", CAMERAS))
        for name, known in choices:
            if getattr(self, name) not in known:
                raise UsageError(f"no {name} {getattr(self, name)!r}", where="synth", valid=known)
        ranges = dict(seconds=(0.2, 120), fps=(5, 240), width=(64, 3840), height=(64, 2160), speed=(0, 20))
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"{name} is {getattr(self, name)}", where="synth", valid=[f"{low} to {high}"])
        if self.width % 2 or self.height % 2:
            raise UsageError(f"H.264 needs an even width and height, not {self.width}x{self.height}", where="synth")


# The clip that comes with slomo (assets/walk), and the truth beside it.
EMBEDDED = Config(width=640, height=360, crf=26)


def _staged(config: Config) -> tuple[Actor, np.ndarray, np.ndarray]:
    """The actor, K (3, 3) px and T_world_cam (T, 4, 4)."""
    t = np.arange(round(config.seconds * config.fps)) / config.fps
    rate = TEMPOS[config.tempo](t / max(t[-1], 1e-9))
    played = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))])
    turn, view, size = np.radians(config.turn), np.radians(config.view), (config.width, config.height)
    try:
        actor = act(config.animal, config.gait, played, speed=config.speed or None, turn=turn, seed=config.seed)
    except ValueError as e:
        raise UsageError(str(e), where="synth", todo="give a lower --speed, another --gait or another --seed") from None
    K, T_world_cam = camera(
        config.camera, actor.target, t, length=actor.length, view=view, size=size, shake=config.shake, seed=config.seed
    )
    return actor, K, T_world_cam


def truth(config: Config) -> dict[str, Any]:
    """The arrays of `truth.npz`, without rendering anything.

    `keypoints` (T, N, 3) m, world, z up, ground at 0, joint centres named `keypoint_names`; `T_world_cam` (T, 4, 4) in
    the OpenCV convention; `K` (3, 3) px; `foot_contact` (T, feet) for `foot_names`; `kind` of the skeleton;
    `body_length` m (withers to tail base, standing height); `contact_height` (m) and `contact_speed` (m/s) as
    thresholds for a contact detector; `bones` as "a-b"; `config` as JSON.
    """
    actor, K, T_world_cam = _staged(config)
    return dict(
        fps=np.float64(config.fps),
        K=K,
        T_world_cam=T_world_cam,
        keypoints=actor.keypoints,
        keypoint_names=np.array(actor.names),
        foot_contact=actor.contact,
        foot_names=np.array(actor.feet),
        kind=np.array(actor.kind),
        body_length=np.float64(actor.body_length),
        contact_height=np.float64(actor.contact_height),
        contact_speed=np.float64(actor.contact_speed),
        image_size=np.array([config.width, config.height]),
        bones=np.array([f"{x}-{y}" for x, y in actor.bones]),
        gravity=np.array([0.0, 0, -1]),
        config=np.array(json.dumps(asdict(config))),
    )


def render(config: Config, progress: Progress):
    """Yield (rgb (H, W, 3) uint8 with sensor noise, mask (H, W) bool) frame by frame."""
    actor, K, T_world_cam = _staged(config)
    skin = actor.skin()
    eye, path = T_world_cam[:, :2, 3], actor.target[:, :2]
    parts = surroundings(path, eye, actor.size, clutter=config.clutter, seed=config.seed)
    coat = Part(skin.at(0), skin.triangles, skin.colors, ANIMAL, grain=0.35, grain_size=0.012 * actor.size)
    toward = float(np.arctan2(*(eye - path).mean(0)[::-1]))
    scene = Scene({"animal": coat, **parts}, light(actor.size, toward, config.seed))
    rng = np.random.default_rng([config.seed, 7])
    frames = len(actor.keypoints)
    for i in range(frames):
        scene.move({"animal": skin.at(i)})
        image = scene.render(K, T_world_cam[i], (config.width, config.height), supersample=2)
        noise = config.noise * rng.standard_normal(image.rgb.shape, np.float32)
        progress.update((i + 1) / frames, f"frame {i + 1} of {frames}")
        yield np.clip(image.rgb + noise + 0.5, 0, 255).astype(np.uint8), image.mask(ANIMAL)


def write_clip(out_dir: Path, config: Config, progress: Progress) -> None:
    """Write `clip.mp4`, `truth.npz` and `masks.npz` (packed bits of the silhouette, and their shape) into `out_dir`.

    Raises:
        UsageError: the animal cannot move as asked.
    """
    arrays = truth(config)
    masks: list[np.ndarray] = []

    def frames():
        for rgb, mask in render(config, progress):
            masks.append(mask)
            yield rgb

    clip = encode_mp4(frames(), config.fps, crf=config.crf, preset="slow")
    out_dir.mkdir(parents=True, exist_ok=True)
    stack = np.stack(masks)
    np.savez_compressed(out_dir / "masks.npz", allow_pickle=False, **pack(stack))
    np.savez_compressed(out_dir / "truth.npz", **arrays)
    (out_dir / "clip.mp4").write_bytes(clip)
