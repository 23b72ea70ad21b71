"""How well the optical flow tells how legs move, of the whole picture and from a closer look at the subject:

    python tests/bench_flow.py [--truth FOLDER ...]

Points on the lower legs of rendered clips (a third and two thirds along the bones below elbow and knee) that the
mask shows, against their true motion in the picture; the masks are the true ones. Points that another leg hides count
too, so no flow reaches 1.
"""

import argparse
from pathlib import Path

import numpy as np

from slomo.packed import pack, unpack
from slomo.reconstruct import decode_stage
from slomo.reconstruct.flow import dense_flow
from slomo.reconstruct.subject_flow import closer, merged
from slomo.reconstruct.video import decode

SHARED = Path(__file__).resolve().parents[2] / "shared"
BONES = (("elbow", "wrist"), ("wrist", "paw"), ("knee", "hock"), ("hock", "paw"), ("elbow", "wrist"), ("knee", "ankle"))
ALONG = (1 / 3, 2 / 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, nargs="*")
    args = parser.parse_args()
    folders = args.truth or sorted(p.parent for p in (SHARED / "truth").glob("*/truth.npz"))
    print(f"{'clip':<16} {'flow':<10} {'median px':>9} {'< 1 px':>7} {'< 2 px':>7}")
    for folder in folders:
        with np.load(folder / "truth.npz") as z:
            truth = dict(z)
        with np.load(folder / "masks.npz") as z:
            masks = unpack(z)
        frames = decode(folder / "clip.mp4", enlarge=decode_stage.Config().enlarge).frames
        if frames.shape[:3] != masks.shape:
            raise SystemExit(f"{folder}: masks of another size than the frames that are decoded")
        uv, moved = points(truth)
        whole = dense_flow(frames)
        arrays = {"flow": whole.forward, "consistent": pack(whole.consistent)["packed"]}
        for name, flow in {"whole": arrays, "subject": arrays | closer(frames, masks)}.items():
            off = []
            for t in range(len(moved)):
                x, y = np.rint(uv[t]).astype(int).T
                inside = (x >= 0) & (y >= 0) & (x < masks.shape[2]) & (y < masks.shape[1])
                inside[inside] = masks[t, y[inside], x[inside]]
                seen = merged(flow, t)[0][y[inside] // 2, x[inside] // 2]
                off.append(np.linalg.norm(seen - moved[t][inside], axis=-1))
            error = np.concatenate(off)
            shares = " ".join(f"{np.mean(error < px):7.2f}" for px in (1, 2))
            print(f"{folder.name:<16} {name:<10} {np.median(error):9.2f} {shares}", flush=True)


def points(truth: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, N, 2) px of the points, and how far they move to the next frame (T-1, N, 2) px."""
    names, X, T, K = [str(n) for n in truth["keypoint_names"]], truth["keypoints"], truth["T_world_cam"], truth["K"]
    x = np.einsum("tji,tnj->tni", T[:, :3, :3], X - T[:, None, :3, 3]) @ K.T
    uv = x[..., :2] / x[..., 2:]
    ends = [
        (names.index(n), names.index(n.replace(a, b)))
        for a, b in dict.fromkeys(BONES) for n in names if n.endswith(a) and n.replace(a, b) in names
    ]  # fmt: skip
    of = np.concatenate([[uv[:, i] * (1 - w) + uv[:, j] * w for i, j in ends] for w in ALONG]).swapaxes(0, 1)
    return of, of[1:] - of[:-1]


if __name__ == "__main__":
    main()
