"""What each term of the prior, or each part of the method, does to the reconstruction: one table over rendered clips,
`make bench-terms` and `make bench-parts`.

    python tests/bench_terms.py OUT [--seeds 2] [--terms some|all|parts] [--clips a,b]

Every cell is `slomo reconstruct` in a project below OUT, so a bench that was stopped goes on; the figures are ratios to
the fit without the prior. Clips: those in ../shared/truth where there are any, and some that slomo renders.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from slomo.formats import load_keypoints
from slomo.synth.score import score

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
TERMS = ("view", "keypoints", "parts", "surface")
CHANGED = (
    *(f"weight_{t}" for t in (*TERMS, "background", "flow", "field_flow")), "fields", "physics", "candidates",
)  # fmt: skip
SYNTH = {
    "synth_trot_cat": ["--animal", "cat", "--gait", "trot", "--view", "40", "--camera", "orbit", "--seed", "21"],
    "synth_turn_horse": ["--animal", "horse", "--gait", "walk", "--turn", "35", "--view", "-20", "--seed", "22"],
}

FIGURES = ("pa_mpjpe_percent", "w_mpjpe_percent", "foot_mpjpe_percent", "foot_slide_mps", "cpu_seconds")


def variants(which: str) -> dict[str, list[str]]:
    """Name -> options: without the prior, with each term alone, with all but one, with all; or without each part."""
    if which == "parts":
        return {
            "all": [],
            "no refinement": ["--set=reconstruct.fields=false", "--set=reconstruct.physics=false"],
            "no fields": ["--set=reconstruct.fields=false"],
            "no physics": ["--set=reconstruct.physics=false"],
            "no background": ["--set=reconstruct.weight_background=0"],
            "no flow": ["--set=reconstruct.weight_flow=0", "--set=reconstruct.weight_field_flow=0"],
            "no gait hypotheses": ["--set=reconstruct.candidates=1"],
            "no prior": ["--prior", "none"],
        }
    off = {t: f"--set=reconstruct.weight_{t}=0" for t in TERMS}
    out = {"none": ["--prior", "none"], "all": []}
    if which == "all":
        out |= {f"only {t}": [off[o] for o in TERMS if o != t] for t in TERMS}
        out |= {f"all but {t}": [off[t]] for t in TERMS}
    # The terms are the fit's: what refines it afterwards would only take time.
    alone = ["--set=reconstruct.fields=false", "--set=reconstruct.physics=false"]
    return {name: options + alone for name, options in out.items()}


def slomo(*args: str) -> str:
    command = [str(Path(sys.executable).with_name("slomo")), *args]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    if not done.stdout.strip():
        raise SystemExit(done.stderr)
    return done.stdout.strip()


def clips(out: Path) -> dict[str, Path]:
    found = {p.parent.name: p.parent for p in sorted((SHARED / "truth").glob("*/truth.npz"))}
    for name, options in SYNTH.items():
        folder = out / "clips" / name
        if not (folder / "truth.npz").exists():
            slomo("synth", str(folder), *options)
        found[name] = folder
    return found


def run(out: Path, name: str, clip: Path, options: list[str], seed: int) -> dict:
    truth = np.load(clip / "truth.npz")
    project = out / "runs" / name
    project.mkdir(parents=True, exist_ok=True)
    weights = SHARED / "weights" / "u2netp.onnx"
    args = ["--skeleton", "human"] if str(truth["kind"]) == "human" else []
    args += ["--weights", str(weights)] if weights.exists() else []
    # Every parameter that a variant may have changed goes back to its default.
    given = {o.split("=")[1] for o in options if o.startswith("--set")}
    reset = [f"--set=reconstruct.{name}=" for name in CHANGED if f"reconstruct.{name}" not in given]
    prior = [] if "--prior" in options else ["--prior", "auto"]
    path = slomo(
        "--project", str(project), "reconstruct", str(clip / "clip.mp4"), *args, *prior, *options, *reset,
        f"--set=reconstruct.seed={seed}",
    )  # fmt: skip
    folder = Path(path)
    motion = load_keypoints(folder / "keypoints.npz")
    report = json.loads((folder / "report.json").read_text())
    return score(motion, truth) | {"cpu_seconds": report["cpu_seconds"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--terms", choices=("some", "all", "parts"), default="all")
    parser.add_argument("--clips", default="")
    args = parser.parse_args()
    chosen = {n: p for n, p in clips(args.out).items() if not args.clips or n in args.clips.split(",")}
    heads = ("PA %", "W %", "feet %", "slide m/s", "PA ratio", "swaps", "CPU ratio")
    print(f"{'clip':<18} {'variant':<20} " + " ".join(f"{h:>9}" for h in heads))
    for name, clip in chosen.items():
        base: dict[str, float] = {}
        for variant, options in variants(args.terms).items():
            rows = [run(args.out, name, clip, options, seed) for seed in range(args.seeds)]
            mean = {k: float(np.mean([np.nan if r[k] is None else r[k] for r in rows])) for k in FIGURES}
            base = base or mean
            swaps = sum(bool(r["swapped"]) for r in rows)
            cells = [f"{mean[k]:9.1f}" for k in ("pa_mpjpe_percent", "w_mpjpe_percent", "foot_mpjpe_percent")]
            cells += [f"{mean['foot_slide_mps']:9.3f}"]
            cells += [f"{mean['pa_mpjpe_percent'] / base['pa_mpjpe_percent']:9.2f}", f"{swaps:>5}/{len(rows):<3}"]
            cells += [f"{mean['cpu_seconds'] / base['cpu_seconds']:9.2f}"]
            print(f"{name:<18} {variant:<20} " + " ".join(cells), flush=True)


if __name__ == "__main__":
    main()
