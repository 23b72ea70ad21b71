"""From targets to a reference that verifies: the solver asked for, and what is tried when the verifier objects.

What the point-foot model cannot know of the whole robot comes back from the verifier: where joints would be overloaded
the forces of that limb are limited further, where joint limits keep a foot from its place the leg is made shorter, and
where feet creep too far they are made to stick. Nothing else is changed, each attempt is told, and the last word is the
verifier's.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slomo.motion import Reference
from slomo.optimize import problem
from slomo.optimize.check import Check
from slomo.optimize.cost import Task
from slomo.optimize.cycle import close, end_shift, find_cycle
from slomo.optimize.inverse import JointMotion, joint_motion
from slomo.optimize.iterate import Iterate
from slomo.optimize.load import JointLoad
from slomo.optimize.problem import Steps, Targets, Weights
from slomo.optimize.reach import Reach
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
_MISSED, _MARGIN = 1e-3, 1e-3  # m from which on a miss counts, and by how much less than was reached is asked for
_NEIGHBOURS = 2  # knots to either side of one that missed that are limited with it
_WEAKER, _SLOWER = 4, 1.15  # attempts with limited forces before the motion is slowed down, and by what each time
_CALMER = 4.0  # on the weight of the trunk's angular acceleration
_LOADED = 0.97  # of a joint's torque limit that is planned with once a joint was overloaded


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
            settings = replace(settings, kappas=settings.kappas[-2:], starts=1)
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
    while True:
        attempts.append(f"{why}: {solution.status}, start {solution.start!r}, {solution.iterations} steps")
        reference = _reference(robot, model, task, solution)
        checks = verify(model, reference, terrain=terrain, robot=robot, want=want)
        wrong = {name for name, c in checks.items() if not c.holds}
        # Of attempts that all fail, the one that is least wrong is kept.
        badness = sum(min(c.value / c.limit, 1e3) for c in checks.values() if not c.holds)
        if best is None or badness < best[0]:
            best = badness, reference, checks, solution
        if wish.solver != "ddp" or len(attempts) >= ATTEMPTS or not wrong:
            break
        remedies, joints = [], joint_motion(robot, reference)
        if "slip_per_second" in wrong and not settings.strict:
            settings = replace(settings, strict=True)
            remedies.append("loaded feet made to stick")
        if "joint_miss" in wrong:
            more = _reach(robot, joints, reference)
            old = task.reach if task.reach.most.size else Reach(more.normal[:, :0], more.most[:, :0])
            task = task._replace(reach=Reach(*(np.concatenate(x, axis=1) for x in zip(old, more, strict=True))))
            remedies.append("less room where joint limits kept a point back")
        if wrong & {"torque_ratio", "speed_ratio"}:
            overloaded += 1
            task = task._replace(load=_joint_load(robot, joints, reference))
            remedies.append("forces limited by what joints can bear")
            if _trunk_overloaded(robot, joints):
                task = task._replace(w_spin=_CALMER * task.w_spin)
                remedies.append("a calmer trunk")
            if overloaded > _WEAKER and not wish.cyclic:
                # Forces alone do not help: it is the motion that asks too much.
                slower = _SLOWER ** (overloaded - _WEAKER)
                slow = make_task(replace(want, t=slower * want.t, v=want.v / slower), wish.steps)
                task = slow._replace(ground=task.ground, load=task.load, reach=task.reach, w_spin=task.w_spin)
                remedies.append(f"the motion slowed down to {100 / slower:.0f} %")
        if not remedies:
            break
        why = " and ".join(remedies)
        report(0.0, why)
        solution = solve(task, solution.iterate, settings)
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


def _joint_load(robot: Robot, joints: JointMotion, reference: Reference) -> JointLoad:
    """The torques of all joints along a motion, over their limits, as they follow from the forces nearby."""
    arm = -joints.jacobian.transpose(0, 2, 1) / robot.effort[:, None]
    rest = joints.tau / robot.effort - np.einsum("kjf,kf->kj", arm, reference.u)
    return JointLoad(np.ascontiguousarray(arm), rest, np.full(rest.shape, _LOADED))


def _trunk_overloaded(robot: Robot, joints: JointMotion) -> bool:
    """Whether a joint is overloaded that carries no foot: then it is the trunk's acceleration that asks too much."""
    ratio = (np.abs(joints.tau) / robot.effort).max(axis=0)
    model = robot.model
    legs = {
        model.idx_vs[j] - 6
        for c, name in enumerate(robot.foot_names)
        if np.isfinite(robot.clearance[c])
        for j in model.supports[model.frames[model.getFrameId(name)].parentJoint]
        if j > 1
    }
    return any(ratio[j] > 1.0 for j in range(len(ratio)) if j not in legs)


def _reach(robot: Robot, joints: JointMotion, reference: Reference) -> Reach:
    """Half-spaces, one for each limb, about the places where the joints cannot bring its points."""
    T, C = joints.miss.shape
    feet = {c: p for p, pair in enumerate(robot.pairs) for c in pair}
    limbs: dict[int, list[int]] = {}
    for c in range(C):
        limbs.setdefault(feet.get(c, C + c), []).append(c)
    R = Rotation.from_quat(reference.q[:, 3:7]).as_matrix()
    off, at = (
        np.einsum("kji,kcj->kci", R, x)
        for x in (reference.points - joints.reached, joints.reached - reference.q[:, None, :3])
    )
    normal, most = np.zeros((T, len(limbs), C, 3)), np.full((T, len(limbs)), np.inf)
    for m, points in enumerate(limbs.values()):
        missed = np.flatnonzero(joints.miss[:, points].max(axis=1) > _MISSED)
        for k in range(T):
            # What is taken away from one knot must not come back at the next.
            near = missed[np.abs(missed - k) <= _NEIGHBOURS]
            if len(near):
                n = near[np.argmin(np.abs(near - k))]
                normal[k, m, points] = off[n, points] / np.linalg.norm(off[n, points])
                most[k, m] = np.sum(normal[k, m] * at[n]) - _MARGIN
    return Reach(normal.reshape(T, len(limbs), -1), most)
