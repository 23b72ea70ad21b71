"""Optimise: key points to a motion that the robot's point-foot model can perform, checked by a verifier of its own."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from slomo.errors import UsageError
from slomo.motion import KeypointMotion, Reference
from slomo.optimize import problem
from slomo.optimize.check import Check, as_report, failure
from slomo.optimize.sequence import contact_sequence
from slomo.optimize.solve import Settings, Solution, solve
from slomo.optimize.verify import tracking_table, verify
from slomo.pointfoot import PointFootModel
from slomo.stage import Artifact, Inputs, Progress
from slomo.terrain import Terrain

VERSION = 2
METHOD = "multiple-shooting DDP, smooth contact"


@dataclass(frozen=True)
class Config(problem.Weights):
    """Parameters of `slomo optimize`; the weights are those of `problem.Weights`.

    Attributes:
        dt: s, length of a step.
        mu: friction coefficient to plan with.
        kappa: N m, gap times normal force at the end of the homotopy.
        iterations: most Newton steps for each kappa.
        tolerance: relative decrease of the cost below which a solve has converged.
    """

    dt: float = 0.05
    mu: float = 0.6
    kappa: float = 5e-5
    iterations: int = 200
    tolerance: float = 1e-6


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """The retargeted key points to `reference.npz`, `report.json` and `terrain.json`.

    The best iterate is kept whatever comes out; `Artifact.failure` says what does not hold.

    Raises:
        UsageError: a parameter outside its range.
        InvalidData: missing key points, or a motion of less than two steps.
    """
    robot = inputs.robot
    assert robot is not None
    for name in ("dt", "mu", "kappa", "iterations", "tolerance"):
        if not getattr(config, name) > 0:
            raise UsageError(f"needs a number above 0, got {getattr(config, name)}", where=f"optimize.{name}")
    for f in fields(problem.Weights):
        if not getattr(config, f.name) >= 0:
            raise UsageError(f"needs a number of at least 0, got {getattr(config, f.name)}", where=f"optimize.{f.name}")
    source = inputs.artifacts["retarget"]
    motion = KeypointMotion.from_arrays(source.npz["keypoints.npz"])
    terrain = Terrain.from_json(source.json["terrain.json"])
    model = PointFootModel.from_robot(robot, mu=config.mu)
    want = problem.targets(motion, model, terrain, dt=config.dt)
    task = problem.make_task(model, want, terrain, config)
    start = problem.make_start(model, want, task)
    progress.update(0.02, "loading the compiled solver (the first run compiles it, which takes half a minute)")
    settings = Settings(
        kappas=(*(k for k in Settings().kappas if k > config.kappa), config.kappa),
        iterations=config.iterations,
        tolerance=config.tolerance,
    )
    solution = solve(
        model, task, start, terrain=terrain, settings=settings, report=lambda f, m: progress.update(0.05 + 0.8 * f, m)
    )
    it = solution.iterate
    reference = Reference(
        t=want.t, h=np.diff(want.t), q=it.qs, v=it.vs, u=it.us, lam=it.lam,
        point_names=robot.foot_names, robot_digest=robot.digest,
    )  # fmt: skip
    progress.update(0.9, "verifying")
    checks = verify(model, reference, terrain=terrain, robot=robot, want=want)
    report = make_report(checks, solution, reference)
    report["tracking"] = tracking_table(reference, want, model.names)
    report |= contact_sequence(reference, terrain, names=model.names)
    wrong = failure(checks)
    if wrong is not None and solution.status != "converged":
        wrong += f"; the solver ended with: {solution.status}"
    progress.note(
        f"{METHOD}: {solution.status} after {solution.iterations} steps, {solution.seconds:.1f} s for "
        f"{report['motion_seconds']:.1f} s of motion; {'not verified' if wrong else 'verified'}"
    )
    return Artifact(
        npz={"reference.npz": reference.to_arrays()},
        json={"report.json": report, "terrain.json": terrain.to_json()},
        failure=wrong,
    )


def make_report(checks: dict[str, Check], solution: Solution, reference: Reference) -> dict[str, Any]:
    """The content of `report.json` but for tracking and contacts."""
    return as_report(checks) | {
        "solve_seconds": solution.seconds,
        "compile_seconds": solution.compile_seconds,
        "motion_seconds": float(reference.t[-1] - reference.t[0]),
        "method": METHOD,
        "status": solution.status,
        "iterations": solution.iterations,
    }
