"""Optimise: key points to a motion that the robot's point-foot model can perform, checked by a verifier of its own."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from slomo.errors import UsageError
from slomo.motion import KeypointMotion, Reference
from slomo.optimize import problem
from slomo.optimize.solve import Settings, Solution, solve
from slomo.optimize.verify import Check, joint_torque_ratio, verify
from slomo.pointfoot import PointFootModel
from slomo.stage import Artifact, Inputs, Progress
from slomo.terrain import Terrain

VERSION = 1
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
    checks = verify(model, reference, terrain=terrain, robot=robot)
    report = make_report(checks, solution, reference, want)
    report["joint_miss"] = float(joint_torque_ratio(robot, reference)[1].max())
    failed = [f"{n} {c.value:.3g} > {c.limit:g} {c.unit}".strip() for n, c in checks.items() if not c.holds]
    failure = None
    if failed:
        worst = next(c for c in checks.values() if not c.holds)
        failure = f"the reference does not verify: {', '.join(failed)} (at t = {worst.t:.2f} s, {worst.point})"
        if solution.status != "converged":
            failure += f"; the solver ended with: {solution.status}"
    progress.note(
        f"{METHOD}: {solution.status} after {solution.iterations} steps, {solution.seconds:.1f} s for "
        f"{report['motion_seconds']:.1f} s of motion; {'verified' if not failed else 'not verified'}"
    )
    return Artifact(
        npz={"reference.npz": reference.to_arrays()},
        json={"report.json": report, "terrain.json": terrain.to_json()},
        failure=failure,
    )


def make_report(
    checks: dict[str, Check], solution: Solution, reference: Reference, want: problem.Targets
) -> dict[str, Any]:
    """The content of `report.json`."""
    r, c = reference, want.foot_confidence
    foot = np.linalg.norm(r.points - want.points, axis=2)
    tightest = max(checks, key=lambda n: checks[n].value / checks[n].limit)
    return {
        "verified": all(c.holds for c in checks.values()),
        **{name: check.value for name, check in checks.items()},
        "body_error": float(np.linalg.norm(r.q[:, :3] - want.q[:, :3], axis=1).mean()),
        "foot_error": float(np.sum(c * foot) / np.sum(c)),
        "solve_seconds": solution.seconds,
        "compile_seconds": solution.compile_seconds,
        "motion_seconds": float(r.t[-1] - r.t[0]),
        "method": METHOD,
        "status": solution.status,
        "iterations": solution.iterations,
        "limits": {name: check.limit for name, check in checks.items()},
        "worst": {"check": tightest, **vars(checks[tightest])},
    }
