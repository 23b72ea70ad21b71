"""How much worse the reconstruction gets when what it starts from is worse: `make bench-robust`.

    python tests/bench_robust.py OUT [--truth FOLDER ...] [--cases a,b] [--seed 0]

Each clip with truth goes through decode, masks and camera once, in a project below OUT that a second call takes from
there. Then one thing is spoiled at a time and the rest of the chain (evidence, fit, without the refinement) runs on it:

- masks: each frame's is eroded or dilated by up to 4 % of the subject's size, with four holes or bites;
- camera: each frame's is turned by 0.5 degrees about a random axis;
- frames: every other one is dropped;
- bones: every length of the skeleton is a quarter too long or too short.

The figures are PA-MPJPE in per cent of the body length, and its ratio to that of the unspoiled clip.
"""

import argparse
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import slomo.skeleton
from slomo.cli.session import Session
from slomo.formats import load_keypoints
from slomo.packed import pack, unpack
from slomo.prior import stage as prior_stage
from slomo.reconstruct import fit_stage, refine_stage
from slomo.reconstruct.subject_flow import closer
from slomo.stage import Artifact, Inputs, Silent
from slomo.synth.score import score

Array = np.ndarray

SHARED = Path(__file__).parents[2] / "shared"
BUILT_IN = Path(slomo.skeleton.__file__).parent / "skeletons"
BONE = 0.25


def begun(out: Path, clip: Path, kind: str, *, fps: float = 30.0) -> Inputs:
    """Decode, masks and camera of a clip, and the network that its evidence comes from, where its kind has one."""
    project = out / (clip.parent.name if fps == 30.0 else f"{clip.parent.name}-{fps:g}")
    project.mkdir(parents=True, exist_ok=True)
    session = Session(project_option=project, quiet=True)
    files = {"clip": session.user_path(clip, "clip")}
    if (u2net := SHARED / "weights" / "u2netp.onnx").is_file():
        files["weights"] = session.user_path(u2net, "weights")
    made = session.configure({"inputs": files, "decode": {"fps": fps}, "reconstruct": {"skeleton": kind}})
    runner = session.runner(made)
    network = {role: path for role, path in made.files("evidence").items() if role == "prior"}
    return Inputs({s: made.store.load(runner.make(s)) for s in ("decode", "masks", "camera")}, network)


def spoiled_masks(inputs: Inputs, rng: np.random.Generator) -> Inputs:
    """Every frame's mask eroded or dilated, with holes or bites."""
    masks = inputs.artifacts["masks"]
    z = masks.npz["masks.npz"]
    full = unpack(z).astype(np.uint8)
    out = []
    for m in full:
        size = np.sqrt(max(int(m.sum()), 1))
        r = rng.uniform(-0.04, 0.04) * size
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(abs(r)) + 1,) * 2)
        m = (cv2.dilate if r > 0 else cv2.erode)(m, kernel)
        v, u = np.nonzero(m)
        for k in rng.integers(len(v), size=4) if len(v) else ():
            cv2.circle(m, (int(u[k]), int(v[k])), round(rng.uniform(0.02, 0.08) * size), 0, -1)
        out.append(m)
    worse = np.array(out)
    both, either = (worse & full).sum((1, 2)), np.maximum((worse | full).sum((1, 2)), 1)
    print(f"  masks: IoU with the estimated ones {np.mean(both / either):.2f}", flush=True)
    packed = dict(z) | pack(worse)
    frames = inputs.artifacts["decode"].npz["frames.npz"]["frames"]
    npz = {"masks.npz": packed, "flow.npz": {**masks.npz["flow.npz"], **closer(frames, worse.astype(bool))}}
    return replace(inputs, artifacts={**inputs.artifacts, "masks": replace(masks, npz=npz)})


def spoiled_camera(inputs: Inputs, rng: np.random.Generator) -> Inputs:
    """Every frame's camera turned by half a degree."""
    camera = inputs.artifacts["camera"]
    z = dict(camera.npz["camera.npz"])
    T = np.array(z["T_world_cam"], float)
    axis = rng.standard_normal((len(T), 3))
    turn = Rotation.from_rotvec(np.radians(0.5) * axis / np.linalg.norm(axis, axis=1, keepdims=True)).as_matrix()
    T[:, :3, :3] = T[:, :3, :3] @ turn
    spoiled = replace(camera, npz={**camera.npz, "camera.npz": z | {"T_world_cam": T}})
    return replace(inputs, artifacts={**inputs.artifacts, "camera": spoiled})


def spoiled_bones(kind: str, out: Path, rng: np.random.Generator) -> Path:
    """The skeleton of a kind with every offset a quarter longer or shorter."""

    def change(found: re.Match) -> str:
        factor = 1 + BONE * rng.choice([-1, 1])
        return f"offset = [{', '.join(f'{factor * float(x):.4f}' for x in found[1].split(','))}]"

    text = re.sub(r"^offset = \[([^]]*)\]", change, (BUILT_IN / f"{kind}.toml").read_text(), flags=re.MULTILINE)
    path = out / f"{kind}-bones.toml"
    path.write_text(text)
    return path


def figure(inputs: Inputs, kind: str, truth: dict[str, Array], seed: int, out: Path) -> float:
    """PA-MPJPE, per cent, of evidence and fit of these inputs; `out` keeps the last key points."""
    config = refine_stage.ReconstructConfig(skeleton=kind, fields=False, physics=False, seed=seed)
    said = prior_stage.run(inputs, prior_stage.Config(skeleton=kind, fps=config.fps), Silent())
    inputs = replace(inputs, artifacts={**inputs.artifacts, "evidence": said})
    fitted = fit_stage.run_fit(inputs, config, Silent())
    inputs = replace(inputs, artifacts={**inputs.artifacts, "fit": fitted})
    result: Artifact = refine_stage.run_refine(inputs, config, Silent())
    arrays: dict[str, Any] = dict(result.npz["keypoints.npz"])
    np.savez(out / "keypoints.npz", **arrays)
    return score(load_keypoints(out / "keypoints.npz"), truth)["pa_mpjpe_percent"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path, nargs="*")
    parser.add_argument("--cases", default="masks,camera,frames,bones")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    folders = args.truth or sorted(p.parent for p in (SHARED / "truth").glob("*/truth.npz"))
    print(f"{'clip':<16} {'case':<8} {'PA %':>6} {'ratio':>6}")
    for folder in folders:
        with np.load(folder / "truth.npz") as z:
            truth = dict(z)
        kind = "human" if str(truth["kind"]) == "human" else "quadruped"
        whole = begun(args.out, folder / "clip.mp4", kind)
        rng = np.random.default_rng(args.seed)
        cases: dict[str, Callable[[], Inputs]] = {
            "masks": lambda whole=whole, rng=rng: spoiled_masks(whole, rng),
            "camera": lambda whole=whole, rng=rng: spoiled_camera(whole, rng),
            "frames": lambda folder=folder, kind=kind: begun(args.out, folder / "clip.mp4", kind, fps=15.0),
            "bones": lambda whole=whole, rng=rng, kind=kind: replace(
                whole, files={**whole.files, "skeleton": spoiled_bones(kind, args.out, rng)}
            ),
        }
        base = figure(whole, kind, truth, args.seed, args.out)
        print(f"{folder.name:<16} {'as it is':<8} {base:6.1f} {1:6.2f}", flush=True)
        for case in args.cases.split(","):
            pa = figure(cases[case](), kind, truth, args.seed, args.out)
            print(f"{folder.name:<16} {case:<8} {pa:6.1f} {pa / base:6.2f}", flush=True)


if __name__ == "__main__":
    main()
