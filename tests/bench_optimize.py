"""The solvers of `slomo optimize` side by side, and how the compiled one grows with the motion: `make bench`.

    python tests/bench_optimize.py [--cap 20] [--problems trot,cat00] [--solvers ddp,fatrop] [--lengths 4,8,60] [--json]

One run, one core, compiled code warm. Every solver gets the same task and the same start (`check` starts Fatrop from
the compiled solver's result, to see whether that is an optimum); `verified` is the verifier's word on the point-foot
model (the robot's joints are looked at by the stage, which plans again where they are overloaded). Times are of the
processor, with setting up, for a second of motion: others at work on the machine do not count. The ratio is to the
compiled solver in this run. Problems are gaits made of sines and, where they are there, the
key points in ../shared/keypoints.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from gaits import gait, reference
from slomo.errors import SlomoError
from slomo.formats import load_keypoints
from slomo.motion import KeypointMotion
from slomo.optimize import problem
from slomo.optimize.cost import Task
from slomo.optimize.fatrop import solve_fatrop
from slomo.optimize.ipopt import solve_ipopt
from slomo.optimize.iterate import Iterate
from slomo.optimize.solve import Settings, Solution, solve, warm_up
from slomo.optimize.verify import verify
from slomo.pointfoot import PointFootModel
from slomo.retarget import stage as retarget
from slomo.robot import load_robot
from slomo.stage import Artifact, Inputs, Silent
from slomo.terrain import Terrain

SHARED = Path(__file__).parents[2] / "shared" / "keypoints"
SETTINGS = Settings(kappas=(1e-1, 1e-2, 1e-3, 1e-4, 5e-5))
BAR = {4: 0.2, 6: 0.4}  # s of solving per second of motion, by number of points
DT = 0.05


@dataclass(frozen=True)
class Problem:
    """What the solvers are asked for."""

    name: str
    model: PointFootModel
    want: problem.Targets
    terrain: Terrain

    @property
    def seconds(self) -> float:
        return float(self.want.t[-1])


@dataclass(frozen=True)
class Row:
    """One solver on one problem.

    Attributes:
        seconds: of solving, by the clock.  cpu_seconds: of the processor, with setting up.
        rate: cpu_seconds per second of motion.  ratio: that over the first solver's.
        capped: whether it was stopped for its time.  wrong: the checks that do not hold.
    """

    problem: str
    motion_seconds: float
    solver: str
    status: str
    iterations: int
    starts: int
    cost: float
    seconds: float
    cpu_seconds: float
    rate: float
    ratio: float
    capped: bool
    verified: bool
    wrong: tuple[str, ...]


def synthetic(name: str, robot: str, duration: float, **motion: float) -> Problem:
    model = PointFootModel.from_robot(load_robot(robot))
    return Problem(name, model, gait(model, duration, dt=DT, **motion), Terrain())


def published(name: str, robot_name: str, **options: Any) -> Problem:
    """A file of key points, retargeted."""
    robot = load_robot(robot_name)
    motion = load_keypoints(SHARED / f"{name}.json")
    raw = Artifact(npz={"keypoints.npz": motion.to_arrays()})
    out = retarget.run(Inputs(artifacts={"import": raw}, robot=robot), retarget.Config(**options), Silent())
    terrain = Terrain.from_json(out.json["terrain.json"])
    model = PointFootModel.from_robot(robot)
    points = KeypointMotion.from_arrays(out.npz["keypoints.npz"])
    return Problem(name, model, problem.targets(points, model, terrain, dt=DT), terrain)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "trot": partial(synthetic, "trot", "go1", 2.0),
    "turn": partial(synthetic, "turn", "go1", 2.0, turn=1.0),
    "walk": partial(synthetic, "walk", "g1", 2.0),
    "cat00": partial(published, "cat00", "go1"),
    "dog_cpr": partial(published, "dog_cpr", "go1", start=26 / 30, end=108 / 30, step_height=0.1),
    "human_jumping_jack": partial(published, "human_jumping_jack", "g1"),
}


def run(
    p: Problem, name: str, solver: Callable[..., Solution], start: Iterate | None, first: float
) -> tuple[Row, Iterate]:
    """The row of one solver, and where it ended. first: rate of the solver that others are compared with, or 0."""
    task = problem.make_task(p.model, p.want, p.terrain, problem.Weights())
    start = problem.make_start(p.model, p.want, task) if start is None else start
    began = time.process_time()
    s = solver(p.model, task, start, terrain=p.terrain, settings=SETTINGS)
    cpu = time.process_time() - began
    checks = verify(p.model, reference(p.model, task, s), terrain=p.terrain)
    wrong = tuple(n for n, c in checks.items() if not c.holds)
    rate = cpu / p.seconds
    row = Row(
        p.name, p.seconds, name, s.status, s.iterations, s.starts, s.cost, s.seconds, cpu, rate, rate / (first or rate),
        s.status == "time limit", not wrong, wrong,
    )  # fmt: skip
    return row, s.iterate


def side_by_side(names: list[str], solvers: dict[str, Callable[..., Solution]]) -> Iterator[Row | str]:
    """A row for each problem and solver, or a line that says why a problem is left out."""
    for name in names:
        try:
            p = PROBLEMS[name]()
        except (SlomoError, OSError) as e:
            yield f"{name}: left out, {e}"
            continue
        first, best = 0.0, None
        for which, solver in solvers.items():
            try:
                row, end = run(p, which, solver, best if which == "check" else None, first)
            except SlomoError as e:
                yield f"{name}, {which}: {e}"
                continue
            best, first = (end, row.rate) if best is None else (best, first)
            yield row


def growth(lengths: list[float]) -> Iterator[Row]:
    """The compiled solver on longer and longer gaits; the ratio is to the shortest."""
    for name, robot in (("trot", "go1"), ("walk", "g1")):
        first = 0.0
        for length in lengths:
            row, _ = run(synthetic(name, robot, length), "ddp", solve, None, first)
            first = first or row.rate
            yield row


def check(model: PointFootModel, task: Task, start: Iterate, *, settings: Settings, **options: Any) -> Solution:
    """Fatrop from another solver's result."""
    return solve_fatrop(model, task, start, settings=replace(settings, kappas=settings.kappas[-1:]), **options)


def table(title: str, ratio: str, rows: list[Row]) -> Table:
    out = Table(title=title, title_justify="left")
    for column in ("problem", "motion s", "solver", "steps", "s per s", ratio, "cost", "verified", "ended with"):
        out.add_column(column, justify="left" if column in ("problem", "solver", "ended with") else "right")
    for r in rows:
        more = "> " * r.capped
        verified = "yes" if r.verified else f"no: {', '.join(r.wrong)}"
        out.add_row(
            r.problem, f"{r.motion_seconds:.2f}", r.solver, f"{r.iterations}", f"{more}{r.rate:.3g}",
            f"{more}{r.ratio:.3g}", f"{r.cost:.4g}", verified, r.status + f" ({r.starts} starts)" * (r.starts > 1),
        )  # fmt: skip
    return out


def main() -> None:
    solvers: dict[str, Callable[..., Solution]] = dict(ddp=solve, check=check, fatrop=solve_fatrop, ipopt=solve_ipopt)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cap", type=float, default=20.0, help="s, after which Fatrop and IPOPT are stopped")
    parser.add_argument("--problems", default=",".join(PROBLEMS), help="of " + ", ".join(PROBLEMS))
    parser.add_argument("--solvers", default=",".join(solvers), help="of " + ", ".join(solvers))
    parser.add_argument("--lengths", default="4,8,15,30,60", help="s of motion for the compiled solver; empty: none")
    parser.add_argument("--json", action="store_true", help="figures as JSON instead of tables")
    args = parser.parse_args()
    names, chosen = args.problems.split(","), args.solvers.split(",")
    if unknown := [n for n in names if n not in PROBLEMS] + [s for s in chosen if s not in solvers]:
        parser.error(f"unknown: {', '.join(unknown)}")
    if chosen[0] == "check":
        parser.error("check needs a solver before it")
    solvers |= dict(
        check=partial(check, seconds=args.cap),
        fatrop=partial(solve_fatrop, seconds=args.cap),
        ipopt=partial(solve_ipopt, seconds=args.cap),
    )
    talk = Console(stderr=True)
    talk.print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", style="dim")
    for robot in ("go1", "g1"):
        talk.print(f"compiling or loading the solver for {robot}", style="dim")
        warm_up(PointFootModel.from_robot(load_robot(robot)))

    rows: list[Row] = []
    for row in side_by_side(names, {s: solvers[s] for s in chosen}):
        if isinstance(row, str):
            talk.print(row, style="yellow")
        else:
            talk.print(f"{row.problem}, {row.solver}: {row.status}, {row.seconds:.2f} s", style="dim")
            rows.append(row)
    longer = list(growth([float(x) for x in args.lengths.split(",") if x]))
    if args.json:
        print(json.dumps(dict(cap=args.cap, solvers=[asdict(r) for r in rows], growth=[asdict(r) for r in longer])))
        return
    out = Console(width=140)
    out.print(table("Solvers on the same task", f"x {chosen[0]}", rows))
    out.print(table("The compiled solver on longer motions", "x shortest", longer))
    slowest = {
        n: max((r.rate for r in longer if r.problem == g), default=np.nan) for n, g in ((4, "trot"), (6, "walk"))
    }
    for points, kind in ((4, "quadruped"), (6, "humanoid")):
        out.print(f"{kind}: at most {slowest[points]:.3f} s per second of motion (bar {BAR[points]})")


if __name__ == "__main__":
    main()
