"""Spoiled key points at random through retarget and optimize: verified, refused with a reason, or neither.

    python tests/bench_random.py                       # 200 inputs: 100 animals on go1, 100 people on g1
    python tests/bench_random.py --count 40 --kind quadruped --first 1000 --json

Each input is drawn from its seed (`ugly`): noise, spikes, dropped frames, scale, heading, friction, terrain steps.
A refusal is an error before anything is solved, in one line. What was solved but does not verify is counted apart: it
is an exit 1 with the offender's name for the user, and a miss for this bench.
"""

import argparse
import collections
import json
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from rich.console import Console
from rich.progress import track
from rich.table import Table

import ugly
from slomo.errors import SlomoError
from slomo.optimize import stage as optimize
from slomo.retarget import stage as retarget
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent

ROBOTS = {"quadruped": "go1", "human": "g1"}


def judge(task: tuple[str, int, str]) -> dict[str, Any]:
    """One input through both stages."""
    kind, seed, robot_name = task
    robot = load_robot(robot_name)
    case = getattr(ugly, kind)(seed)
    out: dict[str, Any] = {"kind": kind, "seed": seed, "friction": case.friction, "done": case.done}
    source = Artifact(npz={"keypoints.npz": case.motion.to_arrays()})
    try:
        moved = retarget.run(Inputs({"import": source}, robot=robot), retarget.Config(**case.options), Silent())
        plan = optimize.run(Inputs({"retarget": moved}, robot=robot), optimize.Config(mu=case.friction), Silent())
    except SlomoError as e:
        return out | {"outcome": "refused", "why": str(e)}
    except Exception as e:
        return out | {"outcome": "crashed", "why": f"{type(e).__name__}: {e}"}
    report = plan.json["report.json"]
    figures = {n: report[n] for n in ("solve_seconds", "motion_seconds", "body_error", "foot_error")}
    figures["attempts"] = len(report["attempts"])
    if plan.failure is not None:
        return out | figures | {"outcome": "not verified", "why": plan.failure}
    return out | figures | {"outcome": "verified", "why": ""}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="inputs of each kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--kind", choices=[*ROBOTS, "both"], default="both")
    parser.add_argument("--robot", help="instead of go1 and g1")
    parser.add_argument("--jobs", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--json", action="store_true", help="all outcomes, one JSON object, on stdout")
    given = parser.parse_args()
    console = Console(stderr=True)
    kinds = list(ROBOTS) if given.kind == "both" else [given.kind]
    tasks = [(k, s, given.robot or ROBOTS[k]) for k in kinds for s in range(given.first, given.first + given.count)]
    began = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        results = list(track(pool.imap(judge, tasks), total=len(tasks), console=console, description="inputs"))
    table = Table("kind", "verified", "refused", "not verified", "crashed", "good", "solve s/s median", "s/s worst")
    for kind in kinds:
        mine = [r for r in results if r["kind"] == kind]
        count = collections.Counter(r["outcome"] for r in mine)
        rate = sorted(r["solve_seconds"] / r["motion_seconds"] for r in mine if "solve_seconds" in r)
        good = (count["verified"] + count["refused"]) / len(mine)
        cells = [str(count[n]) for n in ("verified", "refused", "not verified", "crashed")]
        speed = [f"{rate[len(rate) // 2]:.2f}", f"{rate[-1]:.2f}"] if rate else ["", ""]
        table.add_row(kind, *cells, f"{100 * good:.1f} %", *speed)
    for r in results:
        if r["outcome"] != "verified":
            console.print(f"{r['kind']} {r['seed']}: {r['outcome']}: {r['why']}", highlight=False)
    console.print(table)
    console.print(f"{time.perf_counter() - began:.0f} s in all")
    if given.json:
        print(json.dumps(results, default=str))


if __name__ == "__main__":
    main()
