"""Masks against the truth: `python tests/bench_masks.py [--segmenter motion] [--only camel,post] [--pictures DIR]`.

Prints, a clip: mean, 5 % and minimum IoU over the frames that show the subject (more than 0.1 % of the picture), the
rank correlation of the quality with the IoU, frames without a subject that got a mask, and CPU seconds a frame.
Clips: ../shared/truth/*, the camel (both skipped, saying so, where they are absent), the embedded clip, and the
rendered cases of `mask_cases.py`. The network's weights: --weights, else ../shared/weights.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import spearmanr

from mask_cases import CASES, make_case
from slomo.errors import SlomoError
from slomo.packed import unpack
from slomo.reconstruct import decode_stage
from slomo.reconstruct.stage import MasksConfig, run_masks
from slomo.stage import Artifact, Inputs, Silent

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
SEEN = 0.001  # of the picture


def clips(only: set[str]):
    """Yield name, frames (T, H, W, 3) uint8 and true masks (T, H, W) bool."""
    folders = [*sorted((SHARED / "truth").glob("*/")), SHARED / "clips/camel", ROOT / "src/slomo/assets/walk"]
    for folder in folders:
        if only and folder.name not in only:
            continue
        if not (folder / "clip.mp4").exists():
            print(f"{folder.name:14s} skipped: {folder} is absent")
            continue
        decoded = decode_stage.run(Inputs(files={"clip": folder / "clip.mp4"}), decode_stage.Config(), Silent())
        frames = decoded.npz["frames.npz"]["frames"]
        with np.load(folder / "masks.npz") as z:
            given = unpack(z)
        size = frames.shape[2:0:-1]
        yield (
            folder.name,
            frames,
            np.array(
                [
                    cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
                    for m in given[: len(frames)]
                ]
            ),
        )
    for name in CASES:
        if not only or name in only:
            case = make_case(name)
            yield name, case.frames, case.masks


def iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a & b).sum((1, 2)) / np.maximum((a | b).sum((1, 2)), 1)


def picture(path: Path, frames: np.ndarray, masks: np.ndarray, quality: np.ndarray) -> None:
    """Twelve frames with the mask's outline, and the quality written in."""
    tiles = []
    for i in np.linspace(0, len(frames) - 1, 12).round().astype(int):
        tile = frames[i].copy()
        contours, _ = cv2.findContours(masks[i].astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(tile, contours, -1, (255, 0, 0), 2)
        cv2.putText(tile, f"{i} q {quality[i]:.2f}", (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 0), 2)
        tiles.append(tile)
    columns = 4 if frames.shape[2] > frames.shape[1] else 6
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, 12, columns)]
    cv2.imwrite(str(path), np.vstack(rows)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segmenter", default="u2netp")
    parser.add_argument("--weights", type=Path, default=SHARED / "weights/u2netp.onnx")
    parser.add_argument("--only", default="", help="names, comma separated")
    parser.add_argument("--pictures", type=Path)
    args = parser.parse_args()
    print(f"{'clip':14s} {'IoU':>5s} {'5 %':>5s} {'min':>5s} {'rank':>5s} {'quality':>7s} invented s/frame")
    for name, frames, truth in clips({n for n in args.only.split(",") if n}):
        files = {"weights": args.weights} if args.segmenter == "u2netp" else {}
        decoded = Artifact(npz={"frames.npz": {"frames": frames, "t": np.arange(len(frames)) / 30}})
        start = time.process_time()
        try:
            out = run_masks(
                Inputs(artifacts={"decode": decoded}, files=files), MasksConfig(segmenter=args.segmenter), Silent()
            )
        except SlomoError as error:
            print(f"{name:14s} {error}", flush=True)
            continue
        spent = (time.process_time() - start) / len(frames)
        masks, quality = unpack(out.npz["masks.npz"]), out.npz["masks.npz"]["quality"]
        seen = truth.mean((1, 2)) > SEEN
        score = iou(masks, truth)
        shown = score[seen] if seen.any() else np.zeros(1)
        rank = spearmanr(score[seen], quality[seen]).statistic if seen.sum() > 2 else np.nan  # pyright: ignore[reportAttributeAccessIssue]
        invented = int((masks.any((1, 2)) & ~truth.any((1, 2))).sum())
        print(
            f"{name:14s} {shown.mean():5.3f} {np.quantile(shown, 0.05):5.3f} {shown.min():5.3f} {rank:5.2f} "
            f"{quality.mean():7.2f} {invented:8d} {spent:7.2f}",
            flush=True,
        )
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            picture(args.pictures / f"{name}-{args.segmenter}.png", frames, masks, quality)


if __name__ == "__main__":
    main()
