"""The feet of the real cat beside the paper's own (Zhang et al., RA-L 2023) of the same clip:

    python tests/bench_cat.py OUT [--quality draft]

The file of the authors is of every third frame (121 of 366, and its strides are three times too fast). How far each
foot is ahead of the middle of the four, along the way from the hind to the front feet, goes to and fro once a stride:
printed are its correlation with theirs over the first strides and over the whole clip, and when each foot swings
forward. OUT/feet.png shows the two. The project is in OUT; a second call takes it from there.
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import uniform_filter1d

from bench_prior import SHARED
from slomo.cli.session import Session
from slomo.formats import paper

EVERY, FPS = 3, 30.0
SEEN = 3.4  # s; then the cat slows down and turns, and feet leave the picture
LATE = 0.15  # s, that the first frame of theirs may be from that of the clip


def ahead(feet: np.ndarray, stride: int) -> np.ndarray:
    """(T, 4) of feet (T, 4, 3), front ones first, in the file's units; `stride` frames are averaged over."""
    middle = uniform_filter1d(feet[..., :2].mean(1), stride, axis=0)
    along = uniform_filter1d((feet[:, :2].mean(1) - feet[:, 2:].mean(1))[:, :2], stride, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.einsum("tfi,ti->tf", feet[..., :2] - middle[:, None], along)


def swings(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Times in the middle of each way forward of x (T,), s: what is on its way from a low to a high."""
    x = x - np.median(x)
    span = 0.5 * (np.quantile(x, 0.9) - np.quantile(x, 0.1))
    low, out = None, []
    for i in range(1, len(x)):
        if x[i] < -0.4 * span:
            low = i
        if low is not None and x[i] > 0.4 * span:
            out.append((t[low] + t[i]) / 2)
            low = None
    return np.array(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--quality", default="normal")
    args = parser.parse_args()
    session = Session(project_option=args.out)
    args.out.mkdir(parents=True, exist_ok=True)
    files = {"clip": session.user_path(SHARED / "clips" / "cat-pikachu-0.mp4", "clip")}
    if (u2net := SHARED / "weights" / "u2netp.onnx").is_file():
        files["weights"] = session.user_path(u2net, "weights")
    runner = session.runner(session.configure({"inputs": files, "reconstruct": {"quality": args.quality}}))
    made = session.root / runner.make("reconstruct")["directory"]
    names = [f"{f}_{s}_paw" for f in ("front", "hind") for s in ("left", "right")]
    with np.load(made / "keypoints.npz") as z:
        number = [str(n) for n in z["keypoint_names"]]
        t, ours = z["t"], z["keypoints"][:, [number.index(n) for n in names]]
    theirs = paper.load(SHARED / "keypoints" / "cat00.json")
    feet = theirs.positions[:, [theirs.names.index(n) for n in names]]
    stride = round(FPS)
    x, y = ahead(ours, stride), ahead(feet, round(stride / EVERY))
    best = (-2.0, 0.0, np.zeros(4), np.zeros(4))
    for late in np.arange(-LATE, LATE + 1e-9, 1 / FPS):
        at = late + np.arange(len(y)) * EVERY / FPS
        at, known = at[(at >= t[0]) & (at <= t[-1])], (at >= t[0]) & (at <= t[-1])
        both = np.stack([np.interp(at, t, x[:, i]) for i in range(4)], 1), y[known]
        alike = [[np.corrcoef(a[:, i], b[:, i])[0, 1] for i in range(4)]
                 for a, b in (both, tuple(v[at < SEEN] for v in both))]  # fmt: skip
        best = max(best, (float(np.mean(alike[1])), late, *alike), key=lambda b: b[0])
    _, late, whole, first = best
    at = late + np.arange(len(y)) * EVERY / FPS
    figure, axes = plt.subplots(4, 1, figsize=(10, 8), sharex=True)
    for i, name in enumerate(names):
        begin = [swings(v[s <= SEEN, i], s[s <= SEEN]) for v, s in ((x, t), (y, at))]
        print(f"{name:<18} r {first[i]:.2f} over {SEEN} s, {whole[i]:.2f} over all; swings at "
              + " s, the paper's at ".join(" ".join(f"{s:.2f}" for s in b) for b in begin) + " s")  # fmt: skip
        axes[i].plot(t, x[:, i] / np.std(x[:, i]), label="slomo")
        axes[i].plot(at, y[:, i] / np.std(y[:, i]), label="the paper")
        axes[i].set_ylabel(name.replace("_", " "))
    axes[0].legend()
    axes[3].set_xlabel("s")
    figure.savefig(args.out / "feet.png")
    print(f"mean r {np.mean(first):.2f} and {np.mean(whole):.2f}; {args.out / 'feet.png'}")


if __name__ == "__main__":
    main()
