"""From targets to a reference that verifies: the solver asked for, and what is tried when the verifier objects.

What the point-foot model cannot know of the whole robot comes back from the verifier (`feedback`): joints' torques and
speeds become limits on forces and velocities, places that joints do not reach half-spaces for a limb's points, and feet
that creep too far are made to stick. Nothing else is changed, each attempt is told, and the last word is the
verifier's.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slomo.motion import Reference
from slomo.optimize import feedback, problem
from slomo.optimize.check import Check
from slomo.optimize.cost import Task
from slomo.optimize.cycle import close, end_shift, find_cycle
from slomo.optimize.inverse import joint_motion
from slomo.optimize.iterate import Iterate
from slomo.optimize.problem import Steps, Targets, Weights
from slomo.optimize.scale import best_scale
from slomo.optimize.solve import Report, Settings, Solution
from slomo.optimize.verify import verify
from slomo.pointfoot import PointFootModel
from slomo.robot import Robot
from slomo.terrain import Terrain

Array = np.ndarray

# Name -> module, its function, and what report.json calls it.
SOLVERS = {
    "ddp": ("slomo.optimize.solve", "solve", "multiple-shooting DDP, smooth contact"),
    "fatrop": ("slomo.optimize.fatrop", "solve_fatrop", "Fatrop, smooth contact"),
    "ipopt": ("slomo.optimize.ipopt", "solve_ipopt", "IPOPT, complementarity constraints"),
}
ATTEMPTS = 10
_WEAKER, _SLOWER = 4, 1.15  # attempts with limited forces before the motion is slowed down, and by what each time
_PATIENCE = 4  # rounds without progress after which a solve that started from a solution gives up
_CALMER = 4.0  # on the weight of the trunk's angular acceleration


@dataclass(frozen=True)
class Wish:
    """What was asked for beside the targets.

    Attributes:
        solver: name in `SOLVERS`.  settings: of the solve.  weights: of the cost.
        steps: limits of the step lengths, or None where they are fixed.
        cyclic: one cycle that closes.  free_scale: whether the size of the motion is a variable.
    """

    solver: str
    settings: Settings
    weights: Weights
    steps: Steps | None = None
    cyclic: bool = False
    free_scale: bool = False


@dataclass(frozen=True)
class Plan:
    """A reference and what it came from.

    Attributes:
        reference, checks: the motion and the verifier's judgement.  want: its targets.
        solution: of the last attempt.  attempts: what each one was about, and how the solver ended.
        scale: factor on the targets.  cycle: (first, last) time of the cycle in the motion, s, or None.
        seconds: of solving, all attempts together.
    """

    reference: Reference
    checks: dict[str, Check]
    want: Targets
    solution: Solution
    attempts: tuple[str, ...]
    scale: float
    cycle: tuple[float, float] | None
    seconds: float


def make_plan(
    robot: Robot, model: PointFootModel, want: Targets, *, terrain: Terrain, wish: Wish, report: Report
) -> Plan:
    """Solve, verify, and try again where that may help.

    Raises:
        InvalidData: a cycle was asked for and there is none.
        StageFailed: numbers that are not finite.
    """
    cycle = None
    if wish.cyclic:
        first, last = find_cycle(want, terrain)
        cycle = (float(want.t[first]), float(want.t[last]))
        want = close(want, first, last)
    scale, seconds, attempts = 1.0, 0.0, []

    def make_task(want: Targets, steps: Steps | None = None) -> Task:
        task = problem.make_task(model, want, terrain, wish.weights, steps=steps)
        return task._replace(cyclic=True, shift=end_shift(want)) if wish.cyclic else task

    run = _solver(wish.solver)

    def solve(task: Task, start: Iterate | None, settings: Settings = wish.settings) -> Solution:
        nonlocal seconds
        if start is None:
            start = problem.make_start(model, want, task)
        else:
            # From a solution: other starts, which come from it too, have nothing to add.
            settings = replace(settings, kappas=settings.kappas[-2:], starts=1, patience=_PATIENCE)
        solution = run(model, task, start, terrain=terrain, settings=settings, report=report)
        seconds += solution.seconds
        return solution

    task = make_task(want)
    if wish.free_scale:
        scale, want, task, solution = best_scale(want, terrain, make_task=make_task, solve=solve)
    else:
        solution = solve(task, None)
    if wish.steps is not None:
        # From the solution with fixed steps: it is a point of this problem, so that freedom cannot make it worse.
        task, it = make_task(want, wish.steps), solution.iterate
        solution = solve(task, it._replace(us=np.column_stack([it.us, task.u_ref[:, -1]])))
    settings, why, best, overloaded = wish.settings, "targets", None, 0
    slower, good = 1.0, None  # factor on times; the last solution that converged, its task and its factor
    while True:
        if solution.converged:
            good = solution.iterate, task, slower
        attempts.append(f"{why}: {solution.status}, start {solution.start!r}, {solution.iterations} steps")
        reference = _reference(robot, model, task, solution)
        joints = joint_motion(robot, reference)
        checks = verify(model, reference, terrain=terrain, robot=robot, joints=joints, want=want)
        wrong = {name for name, c in checks.items() if not c.holds}
        # Of attempts that all fail, the one that is least wrong is kept.
        badness = sum(min(c.value / c.limit, 1e3) for c in checks.values() if not c.holds)
        if best is None or badness < best[0]:
            best = badness, reference, checks, solution
        if wish.solver != "ddp" or len(attempts) >= ATTEMPTS or not wrong:
            break
        remedies, calmer = [], False
        if not (solution.converged or good is None or wish.cyclic):
            # What it ended with says little. The new limits leave no motion nearby; those of a slower one may.
            task, calmer = good[1], True
            remedies.append("back to the last motion that converged")
        else:
            if "slip_per_second" in wrong and not settings.strict:
                settings = replace(settings, strict=True)
                remedies.append("loaded feet made to stick")
            if "joint_miss" in wrong:
                task = task._replace(reach=task.reach.joined(feedback.reach(robot, joints, reference)))
                remedies.append("less room where joint limits kept a point back")
            if wrong & {"torque_ratio", "speed_ratio"}:
                overloaded += 1
                task = task._replace(load=feedback.torques(robot, joints, reference))
                remedies.append("forces limited where joints were overloaded")
                if "speed_ratio" in wrong or task.speed.most.size:
                    task = task._replace(speed=feedback.speeds(robot, joints, reference))
                    remedies.append("velocities where they were too fast")
                if feedback.trunk_overloaded(robot, joints):
                    task = task._replace(w_spin=_CALMER * task.w_spin)
                    remedies.append("a calmer trunk")
                # Forces alone do not help: it is the motion that asks too much.
                calmer = overloaded > _WEAKER
        if calmer and not wish.cyclic:
            slower *= _SLOWER
            slow = make_task(replace(want, t=slower * want.t, v=want.v / slower), wish.steps)
            known = {name: getattr(task, name) for name in ("ground", "w_spin", "load", "speed", "reach")}
            task = slow._replace(**known)
            remedies.append(f"the motion slowed down to {100 / slower:.0f} %")
        if not remedies:
            break
        why = " and ".join(remedies)
        report(0.0, why)
        it, _, pace = (solution.iterate, task, slower) if good is None else good
        solution = solve(task, it._replace(vs=it.vs * pace / slower), settings)
    _, reference, checks, solution = best
    return Plan(reference, checks, want, solution, tuple(attempts), scale, cycle, seconds)


def _solver(name: str) -> Callable[..., Solution]:
    module, function, _ = SOLVERS[name]
    return getattr(importlib.import_module(module), function)


def _reference(robot: Robot, model: PointFootModel, task: Task, solution: Solution) -> Reference:
    it, nf = solution.iterate, 3 * model.C
    h = task.h[:-1] if it.us.shape[1] == nf else it.us[:, nf]
    return Reference(
        t=np.concatenate([[0.0], np.cumsum(h)]), h=h.copy(), q=it.qs, v=it.vs, u=it.us[:, :nf].copy(), lam=it.lam,
        point_names=robot.foot_names, robot_digest=robot.digest, cycle=task.shift if task.cyclic else np.zeros(0),
    )  # fmt: skip
