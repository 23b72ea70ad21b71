"""The annotated camel of BADJA (Biggs et al., ACCV 2018) reconstructed, and its joints seen in the picture:

    python tests/bench_badja.py OUT

Prints how many of the annotated joints the projected ones come within a fifth of the subject's size (root of its mask's
area) of, all together and by joint. The project is in OUT; a second call takes it from there.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from bench_prior import BADJA, SHARED
from slomo.cli.session import Session
from slomo.packed import unpack

NEAR = 0.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    folder = SHARED / "clips" / "camel"
    session = Session(project_option=args.out)
    args.out.mkdir(parents=True, exist_ok=True)
    files = {"clip": session.user_path(folder / "clip.mp4", "clip")}
    if (u2net := SHARED / "weights" / "u2netp.onnx").is_file():
        files["weights"] = session.user_path(u2net, "weights")
    runner = session.runner(session.configure({"inputs": files}))
    made = session.root / runner.make("reconstruct")["directory"]
    video = runner.project.store.load(runner.make("decode")).json["video.json"]
    with np.load(made / "keypoints.npz") as z:
        names, X, K, T = [str(n) for n in z["keypoint_names"]], z["keypoints"], z["K"], z["T_world_cam"]
    with np.load(folder / "masks.npz") as z:
        area = unpack(z).sum((1, 2))
    seen = np.einsum("tij,tki->tkj", T[:, :3, :3], X - T[:, None, :3, 3]) @ K.T
    scale = video["width"] / video["source_width"]
    uv = (seen[..., :2] / seen[..., 2:] + 0.5) / scale - 0.5
    hits: dict[str, list[bool]] = defaultdict(list)
    with np.load(folder / "badja.npz") as z:
        for frame, xy, visible in zip(z["frame"], z["xy"], z["visible"], strict=True):
            for joint, name in BADJA.items():
                if name in names and visible[joint] and (xy[joint] > 0).all():
                    away = np.linalg.norm(uv[frame, names.index(name)] - xy[joint])
                    hits[name].append(bool(away < NEAR * np.sqrt(area[frame])))
    for name, h in hits.items():
        print(f"{name:<20} {np.mean(h):.2f} of {len(h)}")
    every = [one for h in hits.values() for one in h]
    print(f"{'all':<20} {np.mean(every):.3f} of {len(every)}")


if __name__ == "__main__":
    main()
