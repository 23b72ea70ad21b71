"""What a network takes in of the furniture around a subject is given back by its colours."""

import cv2
import numpy as np

from slomo.reconstruct.colour import cut, learn_colours, to_lab
from slomo.reconstruct.segment import grown

_FOREIGN = 0.17  # part of a mask in patches of the surroundings' colours, from which on it is cut anew


def give_back_surroundings(frames: np.ndarray, layers: dict[int, np.ndarray]) -> int:
    """Take out of `layers`, in place, what the network added of furniture and the like. Returns the frames concerned.

    Colours are learned from the quarter of the masks that are smallest (though no slivers), against their
    surroundings. A mask a good part of which is patches of the colours of those surroundings is cut anew with them;
    what then is left without most of the usual area says nothing and is dropped, for the frames next to it to fill.
    """
    bodies = {k: p > 0.5 for k, p in layers.items()}
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
        layers[k] = cut(frames[k], probability).astype(np.float16)
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
