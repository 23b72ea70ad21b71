"""How accurate reconstructions are over clips that slomo renders, of other animals, motions, cameras and views each:
`make bench-clips`.

    python tests/bench_clips.py OUT [--jobs 2] [--only gallop,person] [--quality normal] [--refined]

Prints the table of docs/accuracy.md, in Markdown. Every row is `slomo synth` and `slomo reconstruct` in a project below
OUT, so a bench that was stopped goes on. What `--only` names are words of a row's options.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from bench_terms import SHARED, slomo
from slomo.formats import load_keypoints
from slomo.motion import KeypointMotion
from slomo.synth.score import score

SIZE = "--width 640 --height 360"
CLIPS = (
    "dog --gait trot --camera pan --view -40 --seed 72",
    "dog --camera orbit --view 85 --seed 74",
    "dog --gait pace --camera static --view -30 --seed 506",
    "dog --gait walk --camera orbit --view -77 --seed 2012 --turn -30",
    "dog --gait walk --view 25 --seed 521 --tempo faster",
    "dog --gait gallop --camera follow --view 20 --seed 706 --seconds 4",
    "dog --gait rotary --camera follow --view -26 --seed 2009 --shake .5 --clutter",
    "dog --gait sit --camera static --view 30 --seed 701 --seconds 4",
    "dog --gait reach --camera static --view 45 --seed 703 --seconds 4",
    "dog --gait rear --camera follow --view -38 --seed 3005 --shake .5 --seconds 4",
    "cat --gait trot --camera follow --view 120 --seed 77",
    "cat --gait walk --camera static --view -10 --seed 542 --tempo slower",
    "cat --gait walk --fps 12 --view 20 --seconds 4 --seed 602",
    "cat --gait gallop --camera orbit --view -30 --seed 707 --seconds 4",
    "cat --gait reach --camera orbit --view 80 --seed 710 --seconds 4",
    "horse --gait trot --camera follow --view 30 --seed 504",
    "horse --gait pace --camera static --view 2 --seed 2000 --turn 20",
    "horse --camera orbit --view 70 --seed 85",
    "horse --gait gallop --camera pan --view 20 --seed 708 --seconds 4",
    "horse --gait graze --camera static --view 40 --seed 705 --seconds 4",
    "person --gait walk --camera static --view 30 --seed 302",
    "person --gait walk --camera follow --view 60 --turn -25 --seed 310",
    "person --gait run --camera orbit --view 60 --seed 543 --tempo slower",
    "person --gait jack --camera static --view -110 --seed 532",
    "person --gait wave --camera orbit --view 169 --seed 2101 --shake .5 --seconds 4",
    "person --gait squat --camera pan --view 143 --seed 2005 --clutter --seconds 4",
    "person --gait stretch --camera orbit --view -110 --seed 3000 --seconds 4",
    "person --gait bend --camera pan --view 79 --seed 3001 --shake 2 --clutter --seconds 4",
)
HEAD = ("options", "PA", "W", "feet", "F1", "slide", "path", "gravity", "sides", "verdict")


def run(out: Path, options: str, quality: str, refined: bool) -> list[str]:
    """The cells of one row."""
    name = options.replace("--", "").replace(" ", "_")
    clip, project = out / "clips" / name, out / "runs" / name
    if not (clip / "truth.npz").exists():
        slomo("synth", str(clip), "--animal", *options.split(), *SIZE.split())
    project.mkdir(parents=True, exist_ok=True)
    weights = SHARED / "weights" / "u2netp.onnx"
    args = ["--weights", str(weights)] if weights.exists() else []
    args += [f"--set=reconstruct.{part}={str(refined).lower()}" for part in ("fields", "physics")]
    folder = Path(slomo("--project", str(project), "reconstruct", str(clip / "clip.mp4"), "--quality", quality, *args))
    with np.load(clip / "truth.npz") as truth:
        motion = load_keypoints(folder / "keypoints.npz")
        s, f1 = score(motion, truth), contacts(motion, truth)
    verdict = json.loads((folder / "report.json").read_text())["verdict"]["trust"]
    bars = (("pa_mpjpe", 8, 1), ("w_mpjpe", 10, 1), ("foot_mpjpe", None, 1))
    errors = [marked(s[f"{k}_percent"], bar, digits) for k, bar, digits in bars]
    rest = [marked(-f1, -0.8, 2), marked(s["foot_slide_mps"], 0.15, 2), marked(s["root_path_error_percent"], 8, 1)]
    sides = "**" + ", ".join(s["swapped"]) + "**" if s["swapped"] else "right"
    return [f"`{options}`", *errors, *rest, marked(s["gravity_error_degrees"], 3, 1), sides, verdict]


def marked(value: float | None, bar: float | None, digits: int) -> str:
    """A figure, bold where it misses the bar."""
    if value is None:
        return ""
    text = f"{abs(value):.{digits}f}"
    return f"**{text}**" if bar is not None and value > bar else text


def contacts(motion: KeypointMotion, truth: Mapping[str, Any]) -> float:
    """F1 of the feet that stand, as `contact` of the key points says, against those that truly do."""
    assert motion.contact is not None
    names = [str(n) for n in truth["foot_names"]]
    own = motion.contact > 0.5
    true = np.asarray(truth["foot_contact"], bool)[: len(own), [names.index(n) for n in motion.contact_names]]
    return float(2 * (own & true).sum() / max(own.sum() + true.sum(), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--jobs", type=int, default=2, help="rows at a time, a core each")
    parser.add_argument("--only", default="", help="rows with one of these words")
    parser.add_argument("--quality", default="normal")
    parser.add_argument("--refined", action="store_true", help="with fields and physics, not the fit alone")
    args = parser.parse_args()
    words = args.only.split(",") if args.only else []
    rows = [row for row in CLIPS if not words or set(words) & set(row.split())]
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    with ThreadPoolExecutor(args.jobs) as pool:
        for cells in pool.map(lambda row: run(args.out, row, args.quality, args.refined), rows):
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
