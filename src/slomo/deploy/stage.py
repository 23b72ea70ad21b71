"""Deploy, as a stage: what a run on the robot was, from its log. A pure function; the run itself is `drive`."""

from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from slomo.deploy.approach import motion_of, with_approach
from slomo.deploy.config import HZ, Config
from slomo.deploy.log import read
from slomo.deploy.mcap_file import to_mcap
from slomo.deploy.sequence import ORDER, Phase
from slomo.deploy.supervisor import CAUSES, Cause
from slomo.errors import MissingInput
from slomo.motion import Reference, Rollout
from slomo.robot import Robot
from slomo.stage import Artifact, Inputs, Progress
from slomo.store import plain
from slomo.store.digest import digest_arrays
from slomo.terrain import Terrain
from slomo.track import metrics
from slomo.track import stage as tracking
from slomo.track.joint_space import JointSpace
from slomo.track.recording import reference_at

Array = np.ndarray

VERSION = 1
FELL = (Cause.TILT, Cause.HEIGHT)
__all__ = ["VERSION", "Config", "run"]


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`rollout.npz`, `metrics.json` and `run.mcap` from the log of a run.

    On a twin the roll-out is what the twin truly did, on a robot what the estimator thought.

    Raises:
        InvalidData: no log.
        MissingInput: the log is of another reference, robot or set of parameters.
    """
    robot = inputs.robot
    assert robot is not None
    upstream, tracked = inputs.artifacts["optimize"], inputs.artifacts["track"].json["metrics.json"]
    header, records = read(inputs.files["deploy_log"])
    want = identity(upstream.npz["reference.npz"], robot, config)
    changed = [name for name, value in want.items() if header.get(name) != value]
    if changed:
        raise MissingInput(
            f"the last run was with another {', '.join(changed)}", where=inputs.files["deploy_log"],
            todo=f"run: slomo deploy --robot {robot.name}",
        )  # fmt: skip
    reference = Reference.from_arrays(upstream.npz["reference.npz"])
    digest = str(inputs.artifacts["track"].npz["rollout.npz"]["reference_digest"])
    track = tracking.Config(**header["track"])
    terrain = Terrain.from_json(upstream.json["terrain.json"])
    end = float(motion_of(reference, track).t[-1])
    reference = with_approach(reference, robot, terrain=terrain, track=track, rest=config.rest)

    controlled = records[records["phase"] == ORDER.index(Phase.PLAY)]
    why = str(records["why"][-1].decode(errors="replace")) if records["trip"][-1] else None
    if why is None and ORDER[records["phase"][-1]] != Phase.DAMP:
        why = f"the program was cut off during {ORDER[records['phase'][-1]]!s}"
    report: dict[str, Any] = {
        "transport": header["transport"],
        "address": header["address"],
        "dry_run": header["dry_run"],
        "priority": header["priority"],
        "trip": why,
        "cause": str(CAUSES[records["trip"][-1] - 1]) if records["trip"][-1] else None,
        "fell": bool(records["trip"][-1]) and CAUSES[records["trip"][-1] - 1] in FELL,
        **_timing(records),
    }
    files: dict[str, Any] = {}
    if len(controlled) > 1:
        on_twin = bool(np.isfinite(controlled["truth"]).all())
        estimated = _rollout(controlled, controlled["q_est"], robot, reference, digest)
        rollout = estimated
        if on_twin:
            first = JointSpace(robot).pose(reference.q[0])
            roots = _aligned(controlled["truth"], first)
            poses = np.hstack([roots, controlled["q"]]).astype(float)
            rollout = _rollout(controlled, poses, robot, reference, digest)
            report["estimated"] = metrics.errors(_motion_only(estimated, end))
        errors = metrics.errors(_motion_only(rollout, end))
        ratio = {k: None if x is None or not tracked.get(k) else x / tracked[k] for k, x in errors.items()}
        report |= errors | metrics.solver(rollout, period=1 / track.mpc_hz)
        report |= {"state": "truth of the twin" if on_twin else "estimated", "over_track": ratio}
        files = {"rollout.npz": rollout.to_arrays()}
    return Artifact(
        npz=files,
        json={"metrics.json": report},
        blobs={"run.mcap": to_mcap(records, robot, started=header["started"])},
        failure=why,
    )


def identity(reference: Any, robot: Robot, config: Config) -> dict[str, Any]:
    """What a run is a run of, as it stands in the log's header and is compared with what is there now."""
    return {"reference": digest_arrays(reference), "robot": robot.digest, "deploy": plain(config)}


def _timing(records: Array) -> dict[str, Any]:
    """How punctual the loop was, how long the phases were, how hard the motors worked."""
    late = 1e3 * records["late"]
    ticks = round(float(records["t"][-1] - records["t"][0]) * HZ) + 1
    change = np.flatnonzero(np.diff(records["phase"].astype(int), prepend=-1))
    power = np.abs(records["tau"] * records["v"]).sum(axis=1)
    return {
        "late_ms_p50": float(np.percentile(late, 50)),
        "late_ms_p99": float(np.percentile(late, 99)),
        "late_ms_p999": float(np.percentile(late, 99.9)),
        "late_ms_max": float(late.max()),
        "ticks": len(records),
        "missed_deadlines": max(ticks - len(records), 0),
        "held_commands": int(records["held"].sum()),
        "datagrams_accepted": int(records["accepted"][-1]),
        "datagrams_rejected": int(records["rejected"][-1]),
        "power_p99": float(np.percentile(power, 99)),
        "phases": [{"phase": str(ORDER[records["phase"][k]]), "t": float(records["t"][k])} for k in change],
    }


def _motion_only(rollout: Rollout, seconds: float) -> Rollout:
    """The roll-out without what comes after the motion's end at `seconds`; what comes before has negative times."""
    end = int(np.searchsorted(rollout.t, seconds + 1e-9))
    rows = ("t", "q", "v", "q_des", "tau", "body", "points", "lam", "body_ref", "points_ref", "body_est")
    arrays = rollout.to_arrays()
    return Rollout.from_arrays({**arrays, **{name: arrays[name][:end] for name in rows}})


def _rollout(records: Array, q: Array, robot: Robot, reference: Reference, digest: str) -> Rollout:
    joints = JointSpace(robot)
    points = np.array([joints.state(x, v)[0] for x, v in zip(q, records["v_est"], strict=True)])
    estimated = np.array([joints.state(x, v)[0] for x, v in zip(records["q_est"], records["v_est"], strict=True)])
    t = records["reference_t"]
    wanted = reference_at(reference, t)
    plans = np.flatnonzero(np.diff(records["mpc_t"], prepend=-np.inf))
    force = np.zeros((len(t), len(robot.foot_names), 3))
    force[..., 2] = records["foot_force"]
    return Rollout(
        t=t, q=q, v=records["v_est"], q_des=records["q_des"].astype(float), tau=records["tau"].astype(float),
        body=points[:, :7], points=points[:, 7:].reshape(len(t), -1, 3), lam=force,
        body_ref=wanted[:, :7], points_ref=wanted[:, 7:].reshape(len(t), -1, 3),
        mpc_t=records["mpc_t"][plans], mpc_ms=records["mpc_ms"][plans].astype(float),
        mpc_status=records["mpc_status"][plans].astype(int),
        body_est=estimated[:, :7], point_names=robot.foot_names, joint_names=robot.joint_names, reference_digest=digest,
    )  # fmt: skip


def _aligned(truth: Array, first: Array) -> Array:
    """(T, 7) the root's true poses (T, 7), moved in the plane and turned about the vertical so that they begin over the
    pose `first` (nq,): no sensor tells where in the world the robot is when it begins."""
    start, goal = pin.XYZQUATToSE3(truth[0]), pin.XYZQUATToSE3(first[:7])
    turn = pin.rpy.rpyToMatrix(0, 0, pin.rpy.matrixToRpy(goal.rotation)[2] - pin.rpy.matrixToRpy(start.rotation)[2])
    shift = goal.translation - turn @ start.translation
    shift[2] = 0
    move = pin.SE3(turn, shift)
    return np.array([pin.SE3ToXYZQUAT(move * pin.XYZQUATToSE3(x)) for x in truth])
