"""Bench of the networks: `make bench-prior`, or

    python tests/bench_prior.py [--weights FOLDER] [--truth FOLDER ...] [--projects FOLDER] [--pictures FOLDER]

Rendered clips with truth (truth.npz, clip.mp4, masks.npz in a folder each) and the camel's annotations, three times:
the network alone, frame by frame, with the true masks and with estimated ones, and what the stage `evidence` decides
over the clip with estimated masks and camera. The estimates are made in projects below `--projects`, which a second
call takes from there. Then the time a frame takes. `--pictures` writes what the network sees and says.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from slomo.cli.session import Session
from slomo.packed import unpack
from slomo.prior import metrics
from slomo.prior.evaluate import Truth, judge, predict, truth_of
from slomo.prior.inference import Prior, packaged, peaks
from slomo.prior.labels import Labels, labels, view_of
from slomo.reconstruct import decode_stage
from slomo.reconstruct.video import decode
from slomo.skeleton import load_skeleton

SHARED = Path(__file__).parents[2] / "shared"
# Joints of SMAL in BADJA's annotations: legs from elbow or stifle to foot, base of the neck, tail, nose.
BADJA = {
    8: "front_right_elbow", 9: "front_right_wrist", 10: "front_right_paw",
    12: "front_left_elbow", 13: "front_left_wrist", 14: "front_left_paw", 15: "withers",
    18: "hind_right_knee", 19: "hind_right_hock", 20: "hind_right_paw",
    22: "hind_left_knee", 23: "hind_left_hock", 24: "hind_left_paw",
    25: "tail_base", 28: "tail_mid", 31: "tail_tip", 33: "nose",
}  # fmt: skip


def read_masks(path: Path, frames: np.ndarray) -> np.ndarray:
    """(T, H, W) bool, in the size of the decoded frames (T, H, W, 3)."""
    with np.load(path) as z:
        masks = unpack(z).astype(np.uint8)
    assert len(masks) == len(frames), f"{path}: {len(masks)} masks of {len(frames)} frames"
    size = frames.shape[2], frames.shape[1]
    return np.stack([cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in masks]).astype(bool)


def badja(known: Labels, path: Path, scale: float) -> Truth:
    """The camel's annotations in pixels of the decoded frames, of which the clip's has `scale`; nothing is known about
    its view."""
    with np.load(path) as z:
        frames, xy, visible = z["frame"], z["xy"], z["visible"]
    place = (xy + 0.5) * scale - 0.5
    keypoints = np.full((len(frames), len(known.keypoints), 2), np.nan)
    for joint, name in BADJA.items():
        known_there = visible[:, joint] & (xy[:, joint] > 0).all(-1)
        keypoints[:, known.keypoints.index(name)] = np.where(known_there[:, None], place[:, joint], np.nan)
    return Truth(frames, keypoints, np.full((len(frames), 3, 3), np.nan))


def evidence(project: Path, clip: Path, kind: str, weights: Path) -> tuple[Path, Path]:
    """The folder of the artifact `evidence` of a clip, made with a network, and that of the masks it is made with."""
    session = Session(project_option=project)
    project.mkdir(parents=True, exist_ok=True)
    files = {"clip": session.user_path(clip, "clip"), "prior": session.user_path(weights, "prior")}
    if (u2net := SHARED / "weights" / "u2netp.onnx").is_file():
        files["weights"] = session.user_path(u2net, "weights")
    made = session.configure({"inputs": files, "reconstruct": {"skeleton": kind}})
    runner = session.runner(made)
    said, masks = (session.root / runner.make(stage)["directory"] for stage in ("evidence", "masks"))
    return said, masks


def judge_clip(known: Labels, artifact: Path, masks: np.ndarray, truth: Truth) -> dict[str, float]:
    """Shares that are right of what was decided over the clip, at the judged frames that were looked at."""
    with np.load(artifact / "evidence.npz") as z:
        said = dict(z)
    index = [int(np.abs(said["frame"] - f).argmin()) for f in truth.frames]
    near = np.abs(said["frame"][index] - truth.frames) <= 1
    index, frames = np.array(index)[near], np.flatnonzero(near)
    size = np.sqrt(masks[truth.frames[frames]].sum((1, 2)))
    names = [str(n) for n in said["keypoint_names"]]
    order = [names.index(n) for n in known.keypoints]
    places = said["keypoints"][index][:, order]
    error = metrics.keypoint_errors(places, truth.keypoints[frames], size)
    azimuth = metrics.azimuth_error(said["view_path"][index], view_of(truth.R_view_body[frames])[0])
    sides = metrics.share(metrics.sides_right(places, truth.keypoints[frames], size, known.keypoints))
    return {
        "frames": len(frames), "azimuth": metrics.within(azimuth, metrics.VIEW),
        "azimuth_deg": float(np.degrees(np.nanmedian(azimuth))) if np.isfinite(azimuth).any() else np.nan,
        "pck": metrics.within(error, metrics.PCK),
        "pck_feet": metrics.within(error[:, metrics.feet(known.keypoints)], metrics.PCK), "sides": sides,
    }  # fmt: skip


def picture(crop: np.ndarray, parts: np.ndarray, places: np.ndarray, truth: np.ndarray, view: np.ndarray, text: str):
    """One column: colour, motion, parts with key points (predicted: dots, true: circles), view."""
    size = 2 * crop.shape[-1]
    colour = (
        np.clip((crop[:3].transpose(1, 2, 0) / 6 + 0.5) * 255, 0, 255).astype(np.uint8) * (crop[3] > 0.02)[..., None]
    )
    motion = np.clip(np.stack([crop[4], crop[5], 0 * crop[4]], -1) / 4 + 0.5, 0, 1) * 255
    palette = np.random.default_rng(1).integers(70, 255, (len(parts), 3)).astype(np.uint8)
    palette[0] = 0
    rows = [colour, motion.astype(np.uint8), palette[parts.argmax(0)]]
    rows = [cv2.resize(np.ascontiguousarray(r), (size, size), interpolation=cv2.INTER_NEAREST) for r in rows]
    for (u, v), (a, b) in zip(places, truth, strict=True):
        cv2.circle(rows[2], (int(2 * u + 1), int(2 * v + 1)), 2, (255, 255, 255), -1)
        if np.isfinite(a):
            cv2.circle(rows[2], (int(2 * a + 1), int(2 * b + 1)), 4, (255, 255, 0), 1)
            cv2.line(rows[2], (int(2 * u), int(2 * v)), (int(2 * a), int(2 * b)), (160, 160, 0), 1)
    cv2.putText(rows[0], text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 0), 1)
    plot = np.zeros((60, size, 3), np.uint8)
    for k, p in enumerate(view):
        x = size * k // len(view)
        cv2.rectangle(plot, (x, 59), (x + 5, int(59 - 58 * p / view.max())), (90, 200, 255), -1)
    return np.concatenate([*rows, plot])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="Folder of <kind>.onnx; default: those of the package.")
    parser.add_argument(
        "--truth", type=Path, nargs="*", default=sorted(p.parent for p in SHARED.glob("truth/*/truth.npz"))
    )
    parser.add_argument("--projects", type=Path, default=Path("bench/prior"), help="Where estimates are made.")
    parser.add_argument("--camel", type=Path, default=SHARED / "clips" / "camel")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--every", type=int, default=2, help="Frames.")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(
        f"{'clip':<16}{'masks':<6}{'frames':>6}{'azim':>6}{'rot':>6}{'azim°':>7}{'rot°':>7}{'pck':>6}{'feet':>6}{'sides':>7}{'clip':>6}"
    )
    worst: dict[str, list[float]] = {}
    for folder in [*options.truth, *([options.camel] if options.camel.is_dir() else [])]:
        kind = "quadruped"
        if (folder / "truth.npz").is_file():
            with np.load(folder / "truth.npz") as z:
                arrays = dict(z)
            kind = str(arrays["kind"])
        path = options.weights / f"{kind}.onnx" if options.weights else packaged(kind)
        if path is None or not path.is_file():
            print(f"{folder.name:<16}no network for {kind}")
            continue
        known, prior = labels(load_skeleton(kind)), Prior(path)
        clip = decode(
            folder / "clip.mp4", enlarge=decode_stage.Config().enlarge
        )  # as the stage does, so that its pixels are the bench's
        frames = clip.frames
        decided, estimated = evidence(options.projects / folder.name, folder / "clip.mp4", kind, path)
        sources = {"true": folder / "masks.npz", "est": estimated / "masks.npz"}
        for source, file in sources.items():
            masks = read_masks(file, frames)
            if (folder / "truth.npz").is_file():
                at = np.arange(0, len(frames), options.every)
                truth = truth_of(known, arrays, at[masks[at].any((1, 2))])
            else:
                truth = badja(known, folder / "badja.npz", frames.shape[2] / clip.info["source_width"])
            said, boxes, crops = predict(prior, frames, masks, truth.frames)
            got = judge(known, said, boxes, masks[truth.frames], truth)
            print(
                f"{folder.name:<16}{source:<6}{got['frames']:>6}{got['azimuth']:>6.2f}{got['rotation']:>6.2f}"
                f"{got['azimuth_deg']:>7.1f}{got['rotation_deg']:>7.1f}{got['pck']:>6.2f}{got['pck_feet']:>6.2f}"
                f"{got['sides']:>7.2f}{got['sides_clip']:>6.0f}"
            )
            for name, x in got["pck_each"].items():
                worst.setdefault(f"{kind} {name}", []).append(x)
            if options.pictures:
                from slomo.prior.crop import to_crop

                options.pictures.mkdir(parents=True, exist_ok=True)
                places, _ = peaks(said.heat, said.size)
                true = to_crop(truth.keypoints, np.array(boxes)[:, None], said.size)
                shown = np.linspace(0, len(crops) - 1, 6).astype(int)
                columns = [
                    picture(
                        crops[i], said.parts[i], places[i], true[i], said.view[i], f"{folder.name} {truth.frames[i]}"
                    )
                    for i in shown
                ]
                image = np.concatenate(columns, 1)
                cv2.imwrite(str(options.pictures / f"{folder.name}-{source}.png"), image[..., ::-1])
        got = judge_clip(known, decided, read_masks(folder / "masks.npz", frames), truth)
        print(
            f"{folder.name:<16}{'clip':<6}{got['frames']:>6}{got['azimuth']:>6.2f}{'':>6}{got['azimuth_deg']:>7.1f}{'':>7}"
            f"{got['pck']:>6.2f}{got['pck_feet']:>6.2f}{got['sides']:>7.2f}"
        )
    print("\nPCK of each key point, mean over clips and masks")
    for name, x in sorted(worst.items(), key=lambda item: np.mean(item[1])):
        print(f"  {name:<32}{np.mean(x):.2f}")
    for kind in ("quadruped", "human"):
        path = options.weights / f"{kind}.onnx" if options.weights else packaged(kind)
        if path and path.is_file():
            prior = Prior(path)
            for size in (128, 192):
                crop = np.random.default_rng(0).normal(size=(1, 6, size, size)).astype(np.float32)
                prior(crop)
                start = time.perf_counter()
                for _ in range(10):
                    prior(crop)
                print(f"{kind}: {100 * (time.perf_counter() - start):.1f} ms a frame of {size} x {size}")


if __name__ == "__main__":
    main()
