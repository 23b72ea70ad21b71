"""Segmenter that runs U2-Net-p on some frames, each cropped to where the subject should be, and blends over time."""

from dataclasses import dataclass

import cv2
import numpy as np

from slomo.reconstruct.colour import cut, learn_colours, to_lab
from slomo.reconstruct.flow import Flow, sample
from slomo.reconstruct.segment import Masks, Report, blend_over_time, box_of, component_at, grown, no_subject
from slomo.reconstruct.u2net import U2Net

_FOREIGN = 0.17  # part of a mask in patches of the surroundings' colours, from which on it is cut anew


@dataclass(frozen=True)
class SaliencySegmenter:
    """U2-Net-p with tracking.

    Attributes:
        network: the loaded network.
        every: the network runs on every n-th frame; flow fills the frames between.
        probes: frames seen whole at first, to find where the subject is best seen.
        margin: by which the subject's box is grown, in parts of its longer side, before cropping.
    """

    network: U2Net
    every: int = 3
    probes: int = 7
    margin: float = 0.15
    name: str = "u2netp"

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        T = len(frames)
        keys = sorted({*range(0, T, self.every), T - 1})
        whole = {}
        for i, k in enumerate(np.linspace(0, len(keys) - 1, min(self.probes, len(keys))).round().astype(int)):
            whole[keys[k]] = self.network(frames[keys[k]])
            progress(0.2 * (i + 1) / self.probes)
        seed = max(whole, key=lambda t: _clarity(whole[t]))
        if _clarity(whole[seed]) <= 0:
            raise no_subject(f"the network sees nothing that stands out in {len(whole)} frames across the clip")

        layers: dict[int, np.ndarray] = {}
        for order in (keys[keys.index(seed) :], keys[: keys.index(seed) + 1][::-1]):
            self._track(order, whole[seed], frames, flow, layers)
            progress(0.2 + 0.5 * len(layers) / len(keys))
        repaired = _give_back_surroundings(frames, layers)
        progress(0.8)
        probability = blend_over_time(layers, flow, lambda f: progress(0.8 + 0.15 * f))
        masks = np.empty(frames.shape[:3], bool)
        for t, p in enumerate(probability):
            masks[t] = component_at(p > 0.5, p > 0.8)
        if not masks.any():
            raise no_subject("the network's answer does not hold over time")
        report = {"weights_sha256": self.network.digest, "network_frames": len(keys), "seed_frame": seed}
        return Masks(masks, report | {"colour_repaired_frames": repaired})

    def _track(self, order: list[int], first: np.ndarray, frames, flow: Flow, layers: dict[int, np.ndarray]) -> None:
        """Fill `layers` along `order`, whose first frame has the probability `first`."""
        hint = component_at(first > 0.5)
        for previous, t in zip([order[0], *order], order, strict=False):
            if t != previous:
                hint = sample(hint.astype(np.float32), flow.chain(t, previous)) > 0.5
            seen = layers.get(t)
            if seen is None:
                box = box_of(hint, margin=self.margin) if hint.sum() > 50 else (0, 0, hint.shape[1], hint.shape[0])
                seen = self.network.crop(frames[t], box)
                seen = seen * component_at(seen > 0.3, hint if hint.any() else None)
            layers[t] = seen.astype(np.float16)
            if (found := seen > 0.5).any():
                hint = found


def _give_back_surroundings(frames: np.ndarray, layers: dict[int, np.ndarray]) -> int:
    """Take out of `layers`, in place, what the network added of furniture and the like. Returns the frames concerned.

    Colours are learned from the quarter of the masks that are smallest (though no slivers), against their
    surroundings. A mask a good part of which is patches of the colours of those surroundings is cut anew with them;
    what then is left without most of the usual area says nothing and is dropped, for the frames next to it to fill.
    """
    bodies = {k: component_at(p > 0.5) for k, p in layers.items()}
    area = {k: int(b.sum()) for k, b in bodies.items() if b.any()}
    usual = np.median(list(area.values())) if area else 0.0
    whole = sorted((k for k in area if area[k] > 0.3 * usual), key=lambda k: area[k])
    trusted = whole[: max(2, len(whole) // 4)]
    if len(trusted) < 2:
        return 0
    model = learn_colours(frames, {k: bodies[k] for k in trusted}, reach=2.0)
    colour = lambda k: cv2.GaussianBlur(model(to_lab(frames[k])), (0, 0), 1.5)  # noqa: E731
    swallowing = [k for k in area if _foreign(bodies[k], colour(k)) > _FOREIGN]
    for k in swallowing:
        # The network has shown here that it does not know, so colour outweighs it.
        logit = 2.0 * (np.clip(colour(k), -2.0, 2.0) - 0.5) + layers[k] - 0.5
        probability = np.where(grown(bodies[k], 0.1), 1.0 / (1.0 + np.exp(-logit)), 0.0)
        layers[k] = component_at(cut(frames[k], probability)).astype(np.float16)
    if swallowing:
        left = {k: float((p > 0.5).sum()) for k, p in layers.items()}
        trusted_area = np.median([area[k] for k in trusted])
        for k in swallowing:
            if left[k] < 0.5 * trusted_area and len(layers) > len(left) // 3:
                del layers[k]
    return len(swallowing)


def _foreign(body: np.ndarray, colour: np.ndarray) -> float:
    """Part of a mask that is whole patches of the surroundings' colours; the speckles of a coat do not count."""
    radius = max(1, round(0.06 * np.sqrt(body.sum())))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    patches = cv2.morphologyEx((body & (colour < -0.5)).astype(np.uint8), cv2.MORPH_OPEN, disc)
    return float(patches.sum() / body.sum())


def _clarity(probability: np.ndarray) -> float:
    """How clearly one whole object stands out: confident largest component, away from the border."""
    mask = component_at(probability > 0.5)
    share = mask.mean()
    if not 0.002 < share < 0.7:
        return 0.0
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    confident = probability[mask].mean() * mask.sum() / max(1, (probability > 0.5).sum())
    return float(confident * max(0.0, 1.0 - 4.0 * border) * min(1.0, share / 0.02))
