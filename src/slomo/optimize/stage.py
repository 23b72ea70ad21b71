"""Optimise: key points to a motion that the robot's point-foot model can perform, checked by a verifier of its own."""

from dataclasses import dataclass, fields, replace
from typing import Any

from slomo.errors import UsageError
from slomo.motion import KeypointMotion
from slomo.optimize import problem
from slomo.optimize.check import as_report, failure
from slomo.optimize.plan import SOLVERS, Plan, Wish, make_plan
from slomo.optimize.sequence import contact_sequence
from slomo.optimize.solve import Settings
from slomo.optimize.verify import tracking_checks, tracking_table
from slomo.optimize.whole_body import Refined, refine
from slomo.optimize.whole_body_verify import point_foot_reference, verify_whole_body
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.stage import Artifact, Inputs, Progress
from slomo.terrain import Terrain

VERSION = 5
MODELS = ("point-foot", "whole-body")


@dataclass(frozen=True)
class Config(problem.Weights):
    """Parameters of `slomo optimize`; the weights are those of `problem.Weights`.

    Attributes:
        model: "point-foot", or "whole-body": that motion made one of the whole robot under its URDF's dynamics.
        dt: s, length of a step.
        mu: friction coefficient to plan with.
        kappa: N m, gap times normal force at the end of the homotopy.
        iterations: most Newton steps at the last kappa, in each round of the constraints, and 50 at each earlier one;
            with fatrop and ipopt at every kappa.
        tolerance: relative decrease of the cost below which a solve has converged.
        solver: "ddp" (compiled, smooth contact), "fatrop" (the same problem, a check) or "ipopt" (the published form).
        strict: loaded feet do not slide at all.
        cyclic: only one cycle of the gait, closed so that it can be repeated for ever.
        free_scale: the size of the motion is a variable of the problem.
        shortest_step, longest_step: of a step, as factors of dt; where they differ step lengths are variables.
        step_weight: of the squared relative deviation of step lengths from dt, per second of motion.
        starts: most starts that are tried before a solve counts as failed.
    """

    model: str = "point-foot"
    dt: float = 0.05
    mu: float = 0.6
    kappa: float = 5e-5
    iterations: int = 200
    tolerance: float = 1e-6
    solver: str = "ddp"
    strict: bool = False
    cyclic: bool = False
    free_scale: bool = False
    shortest_step: float = 1.0
    longest_step: float = 1.0
    step_weight: float = 10.0
    starts: int = 4

    def __post_init__(self):
        for name in ("dt", "mu", "kappa", "iterations", "tolerance", "shortest_step", "starts"):
            if not getattr(self, name) > 0:
                raise UsageError(f"needs a number above 0, got {getattr(self, name)}", where=f"optimize.{name}")
        for name in (*(f.name for f in fields(problem.Weights)), "step_weight"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"needs a number of at least 0, got {getattr(self, name)}", where=f"optimize.{name}")
        if not self.shortest_step <= 1 <= self.longest_step:
            raise UsageError(
                f"1 does not lie between {self.shortest_step} and {self.longest_step}", where="optimize.shortest_step"
            )
        for name, valid in (("model", MODELS), ("solver", tuple(SOLVERS))):
            if getattr(self, name) not in valid:
                raise UsageError(f"no {name} {getattr(self, name)!r}", where=f"optimize.{name}", valid=valid)


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """The retargeted key points to `reference.npz`, `report.json` and `terrain.json`; `whole_body.npz` with that model.

    The best iterate is kept whatever comes out; `Artifact.failure` says what does not hold.

    Raises:
        UsageError: a parameter outside its range.
        InvalidData: missing key points, a motion of less than two steps, or no cycle where one is asked for.
    """
    robot = inputs.robot
    assert robot is not None
    source = inputs.artifacts["retarget"]
    motion = KeypointMotion.from_arrays(source.npz["keypoints.npz"])
    terrain = Terrain.from_json(source.json["terrain.json"])
    model = PointFootModel.from_robot(robot, mu=config.mu)
    want = problem.targets(motion, model, terrain, dt=config.dt)
    progress.update(0.02, "loading the compiled solver (the first run compiles it, which takes half a minute)")
    wish = Wish(
        solver=config.solver,
        settings=Settings(
            kappas=(*(k for k in Settings().kappas if k > config.kappa), config.kappa),
            iterations=config.iterations,
            tolerance=config.tolerance,
            strict=config.strict,
            starts=config.starts,
        ),
        weights=config,
        steps=_steps(config),
        cyclic=config.cyclic,
        free_scale=config.free_scale,
    )
    plan = make_plan(
        robot, model, want, terrain=terrain, wish=wish, report=lambda f, m: progress.update(0.05 + 0.85 * f, m)
    )
    whole: Refined | None = None
    if config.model == "whole-body":
        whole, plan = _whole_body(robot, model, plan, terrain, config, progress)
    report = make_report(plan, config)
    report["tracking"] = tracking_table(plan.reference, plan.want, model.names)
    report |= contact_sequence(plan.reference, terrain, names=model.names)
    if whole is not None:
        report |= {"method": f"{report['method']}; whole body by sequential quadratic programming"}
        report["whole_body"] = {"status": whole.status, "iterations": whole.iterations, "solve_seconds": whole.seconds}
    wrong = failure(plan.checks)
    status = plan.solution.status if whole is None else whole.status
    if wrong is not None and status != "converged":
        wrong += f"; the solver ended with: {status}"
    for what in plan.attempts[1:]:
        progress.note(what)
    if plan.cycle is not None:
        progress.note(f"one cycle, {plan.cycle[0]:.2f} to {plan.cycle[1]:.2f} s of the motion")
    if config.free_scale:
        progress.note(f"the motion's size became {plan.scale:.3f} of what was retargeted")
    progress.note(
        f"{report['method']}: {plan.solution.status} after {plan.solution.iterations} steps, {plan.seconds:.1f} s for "
        f"{report['motion_seconds']:.1f} s of motion; {'not verified' if wrong else 'verified'}"
    )
    npz = {"reference.npz": plan.reference.to_arrays()}
    if whole is not None:
        npz["whole_body.npz"] = whole.motion.to_arrays()
        progress.note(f"whole body: {whole.status} after {whole.iterations} programs, {whole.seconds:.1f} s")
    return Artifact(
        npz=npz,
        json={"report.json": report, "terrain.json": terrain.to_json()},
        failure=wrong,
    )


def _whole_body(
    robot: Robot, model: PointFootModel, plan: Plan, terrain: Terrain, config: Config, progress: Progress
) -> tuple[Refined, Plan]:
    """The plan for the whole robot: its own checks instead of the point-foot model's, and its motion as a reference."""
    whole = refine(
        robot, plan.reference, terrain=terrain, mu=config.mu, report=lambda f, m: progress.update(0.9 + 0.09 * f, m)
    )
    checks = verify_whole_body(robot, whole.motion, terrain=terrain, mu=config.mu)
    reference = point_foot_reference(robot, model, whole.motion)
    checks |= tracking_checks(reference, plan.want, model.names)
    return whole, replace(plan, reference=reference, checks=checks)


def _steps(config: Config) -> problem.Steps | None:
    if config.shortest_step == config.longest_step:
        return None
    return problem.Steps(config.shortest_step, config.longest_step, config.step_weight)


def make_report(plan: Plan, config: Config) -> dict[str, Any]:
    """The content of `report.json` but for tracking and contacts."""
    return as_report(plan.checks) | {
        "solve_seconds": plan.seconds,
        "compile_seconds": plan.solution.compile_seconds,
        "motion_seconds": float(plan.reference.t[-1] - plan.reference.t[0]),
        "method": SOLVERS[config.solver][2] + (", no slip" if config.strict else ""),
        "status": plan.solution.status,
        "iterations": plan.solution.iterations,
        "cost": plan.solution.cost,
        "start": plan.solution.start,
        "attempts": list(plan.attempts),
        "scale": plan.scale,
        "slowed": float((plan.reference.t[-1] - plan.reference.t[0]) / (plan.want.t[-1] - plan.want.t[0])),
        "cycle": None if plan.cycle is None else list(plan.cycle),
    }
