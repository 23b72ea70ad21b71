"""The point-foot motion made one of the whole robot: sequential quadratic programming on knots and contact forces.

Direct transcription in inverse-dynamics form: the unknowns are configurations and contact forces, and rnea gives the
joint torques and what the base lacks (contact as in Posa, Cantu and Tedrake, "A direct method for trajectory
optimization of rigid bodies through contact", 2014). Contact timing stays free through the relaxed complementarity
gap x force <= kappa; points do not slide under load. An l1 merit function and a damping that adapts make every step
that is taken one of descent (Fletcher 1987, section 14.3; Levenberg 1944); in the end, steps without a cost make the
equations exact.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference, WholeBody
from slomo.optimize.inverse import joint_motion
from slomo.optimize.whole_body_model import WholeBodyModel, carried, plus
from slomo.optimize.whole_body_problem import Point, Problem, Weights
from slomo.optimize.whole_body_qp import Limits, Penalties, Program
from slomo.robot import Robot
from slomo.terrain import Terrain

Array = np.ndarray


@dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        weights: of the cost.
        kappa: N m, gap times normal force, and way along the ground in a step times normal force.
        iterations: most quadratic programs.
        tolerance: relative decrease still expected that counts as converged.
        closing: most programs that make the equations exact in the end.
        margin: part of the limits (torque, speed, friction) that is left to rounding.
    """

    weights: Weights = field(default_factory=Weights)
    kappa: float = 5e-5
    iterations: int = 60
    tolerance: float = 1e-3
    closing: int = 8
    margin: float = 1e-3


@dataclass(frozen=True)
class Refined:
    """A whole-body motion, whether it converged or not.

    Attributes:
        motion: the last iterate.  status: "converged", or why not.  iterations: programs solved.  cost: of `Weights`.
        seconds: of solving.
    """

    motion: WholeBody
    status: str
    iterations: int
    cost: float
    seconds: float


# What counts as satisfied, in the units of `Violations`: N and N m, parts of a limit (within the margin), m, N m.
_SATISFIED = Penalties(base=5e-7, torque=5e-4, speed=5e-4, depth=1e-5, contact=2e-5, slide=5e-5, cycle=1e-8)
# Share of the cost below which the price of what is violated is left to closing.
_NEARLY = 0.03
# Of the cost, in relative tolerances: a millimetre off for two seconds.
_FLOOR = 1e-3
_MOST_RAISES = 3
_CLOSING = 1e2


def refine(
    robot: Robot,
    reference: Reference,
    *,
    terrain: Terrain,
    mu: float,
    settings: Settings | None = None,
    report: Callable[[float, str], None] = lambda fraction, message: None,
) -> Refined:
    """The motion of the whole robot nearest to a point-foot motion, under its dynamics, joint limits and contact.

    The motion is returned whatever the status: `whole_body_verify` judges it. `mu` is the friction coefficient to plan
    with; `report(fraction, message)` is called between the programs.
    """
    s = settings or Settings()
    began = time.perf_counter()
    report(0.0, "inverse kinematics")
    q = start(robot, reference)
    within = 1 - s.margin
    limits = Limits(
        lower=robot.lower, upper=robot.upper, effort=within * robot.effort, velocity=within * robot.velocity,
        mu=within * mu, kappa=s.kappa, kappa_slide=s.kappa,
    )  # fmt: skip
    problem = Problem(WholeBodyModel(robot), terrain, limits, s.weights, reference, start=q)
    program = Program(problem.layout, limits)
    x, status, iterations = _descend(problem, program, s, problem.evaluate(q, reference.lam), report)
    x, more = _close(problem, program, s, x)
    lacking = x.violations.beyond(_SATISFIED)
    if status == "converged" and lacking:
        status = f"not all equations can be closed: {', '.join(lacking)}"
    motion = WholeBody(
        t=reference.t, h=reference.h, q=x.q[1:], v=x.steps.v, tau=x.tau, lam=x.lam, point_names=robot.foot_names,
        joint_names=robot.joint_names, robot_digest=robot.digest, cycle=reference.cycle,
    )  # fmt: skip
    return Refined(motion, status, iterations + more, x.cost, time.perf_counter() - began)


def start(robot: Robot, reference: Reference) -> Array:
    """Knots (T + 1, nq) by inverse kinematics; the first is the one before the motion, for its first velocity."""
    motion = joint_motion(robot, reference)
    q = motion.q
    if len(reference.cycle):
        turn = reference.cycle[3]
        back = Rotation.from_euler("z", -turn).apply(-reference.cycle[:3])
        return np.concatenate([carried(q[-2:-1], np.append(back, -turn)), q])
    v = motion.v[0].copy()
    v[:3] = Rotation.from_quat(q[0, 3:7]).apply(v[:3])
    return np.concatenate([plus(q[0], -reference.h[0] * v)[None], q])


def _descend(
    problem: Problem, program: Program, s: Settings, x: Point, report: Callable[[float, str], None]
) -> tuple[Point, str, int]:
    """Newton steps from x; the last motion, how it ended, and the number of programs."""
    penalties, damping, raises = Penalties(), 1.0, 0
    for n in range(1, s.iterations + 1):
        report(n / (n + 10), f"whole body, step {n}")
        step = program.solve(problem.linearize(x), penalties, damping=damping * problem.scale, tolerance=1e-5)
        if not step.solved:
            damping *= 10.0
        else:
            price = x.violations.price(penalties)
            trial = problem.evaluate(plus(x.q, step.dq), step.lam)
            actual = x.cost + price - trial.cost - trial.violations.price(penalties)
            if price < _NEARLY * (x.cost + _FLOOR) and step.decrease - price < s.tolerance * (x.cost + _FLOOR):
                return trial if actual > 0 else x, "converged", n
            if step.decrease < s.tolerance * (x.cost + price + _FLOOR):
                # What is violated cannot be mended at this price.
                lacking = x.violations.beyond(_SATISFIED)
                if raises == _MOST_RAISES:
                    return x, f"not all limits can be kept: {', '.join(lacking)}", n
                raises += 1
                penalties = penalties._replace(**{name: 10 * getattr(penalties, name) for name in lacking})
            if actual > 0.1 * step.decrease:
                x = trial
                damping *= 0.2 if actual > 0.5 * step.decrease else 1.0
            else:
                damping *= 5.0
        if damping > 1e8:
            return x, "no descent", n
    return x, "iteration limit", s.iterations


def _close(problem: Problem, program: Program, s: Settings, x: Point) -> tuple[Point, int]:
    """The nearest motion that satisfies everything to rounding, by Newton steps without a cost while they help."""
    # So much of both that the program's own tolerance, of its objective, is no motion that matters.
    penalties, damping = Penalties(*(_CLOSING * price for price in Penalties())), _CLOSING * problem.scale
    for n in range(s.closing):
        if not x.violations.beyond(_SATISFIED):
            return x, n
        step = program.solve(problem.linearize(x, follow=False), penalties, damping=damping, tolerance=1e-9)
        trial = problem.evaluate(plus(x.q, step.dq), step.lam)
        if not (step.solved and trial.violations.price(penalties) < x.violations.price(penalties)):
            return x, n + 1
        x = trial
    return x, s.closing
