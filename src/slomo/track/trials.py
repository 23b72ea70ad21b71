"""Trials: how often the robot stays on its feet when the world is not as planned, as numbers with intervals.

Each trial is simulated by itself (see `trial`), one process a core. Finished ones are kept as they come in: a run that
is killed goes on with the others.
"""

import contextlib
import json
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import wait as wait_for

import numpy as np

from slomo.errors import StageFailed, UsageError
from slomo.motion import Reference
from slomo.robot import Robot
from slomo.stage import Arrays, Artifact, Inputs, Progress, Silent
from slomo.terrain import Terrain
from slomo.threads import cores
from slomo.track import config as track
from slomo.track.planner import PLANNERS
from slomo.track.stage import check_robot
from slomo.track.trial import ROWS, Result, run_trial
from slomo.track.trials_report import as_text, plot, summary

VERSION = 4


@dataclass(frozen=True)
class Config(track.Config):
    """Parameters of `slomo track --trials`, beside those of `slomo track`.

    Attributes:
        trials: of each row.  seed: of all of them.
        rows: which disturbances.  controllers: which controllers are compared.
    """

    trials: int = 200
    seed: int = 0
    rows: tuple[str, ...] = tuple(ROWS)
    controllers: tuple[str, ...] = ("ci-mpc",)


@dataclass(frozen=True)
class Setting:
    """What all trials share."""

    robot: Robot
    reference: Reference
    terrain: Terrain
    config: Config


Key = tuple[str, str, int]  # controller, row, number


def run(inputs: Inputs, config: Config, progress: Progress) -> Artifact:
    """`trials.json` (rates, intervals, falls), `trials.png` and `trials.npz` (a line for each trial).

    Raises:
        UsageError: a parameter out of range.
        MissingInput: the reference was made for another robot.
        StageFailed: a process of a trial died.
    """
    track.check(config)
    _check(config)
    robot, upstream = inputs.robot, inputs.artifacts["optimize"]
    assert robot is not None
    reference = Reference.from_arrays(upstream.npz["reference.npz"])
    check_robot(reference, robot)
    setting = Setting(robot, reference, Terrain.from_json(upstream.json["terrain.json"]), config)

    done = _restore(progress.load())
    left = [
        key
        for n in range(config.trials)
        for row in config.rows
        for c in config.controllers
        if (key := (c, row, n)) not in done
    ]
    total = len(done) + len(left)
    progress.update(len(done) / total, f"{len(done)} of {total} trials")
    for finished in _simulate(setting, left) if left else ():
        done |= finished
        held = sum(r is not None and r.fall is None for r in done.values())
        progress.update(len(done) / total, f"{len(done)} of {total} trials, {held} without a fall")
        if finished:
            progress.save(_state(done))

    found = [r for key in sorted(done) if (r := done[key]) is not None]
    for row in config.rows:
        if not any(r.row == row for r in found):
            progress.note(f"{row}: left out, every foot of this motion stays where it starts")
    rows = summary(found)
    report = {"seed": config.seed, "state": config.state, "rows": rows, "text": as_text(rows)}
    return Artifact(
        npz={"trials.npz": _table(found)},
        json={"trials.json": report},
        blobs={"trials.png": plot(rows, title=f"{robot.name}, {reference.t[-1]:.1f} s of motion")},
    )


def _check(config: Config) -> None:
    if config.trials < 1:
        raise UsageError(f"needs at least 1, got {config.trials}", where="trials.trials")
    for name, valid in (("rows", ROWS), ("controllers", PLANNERS)):
        given = getattr(config, name)
        if not given or (unknown := [x for x in given if x not in valid]):
            raise UsageError(f"{', '.join(unknown) if given else 'nothing'}", where=f"trials.{name}", valid=valid)


def _simulate(setting: Setting, keys: list[Key]) -> Iterator[dict[Key, Result | None]]:
    """The trials of `keys` as they end, from as many processes as there are cores, of one thread each.

    Yields at least twice a second, nothing where none has ended.
    """
    with _one_thread_each():
        pool = ProcessPoolExecutor(
            min(cores(), len(keys)), multiprocessing.get_context("spawn"), initializer=_begin, initargs=(setting,)
        )
        waiting, running = deque(keys), {}
        try:
            while waiting or running:
                while waiting and len(running) < 2 * cores():
                    key = waiting.popleft()
                    running[pool.submit(_work, key)] = key
                ended, _ = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
                yield {running.pop(future): future.result() for future in ended}
        except BrokenProcessPool:
            todo = "it may have run out of memory; run the same command again to go on with the others"
            raise StageFailed("a process that simulated a trial has died", where="trials", todo=todo) from None
        finally:
            for process in multiprocessing.active_children():
                process.terminate()
            pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that are started inside use one thread for their linear algebra."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


_setting: Setting | None = None


def _begin(setting: Setting) -> None:
    """In a process of the pool: keep what all trials share, leave signals to the parent, and end when it does."""
    global _setting
    _setting = setting
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (wait_for([parent.sentinel]), os._exit(1)), daemon=True).start()


def _work(key: Key) -> Result | None:
    assert _setting is not None
    controller, row, number = key
    s = _setting
    found = run_trial(
        row, number, seed=s.config.seed, robot=s.robot, reference=s.reference, terrain=s.terrain,
        config=replace(s.config, controller=controller), progress=Silent(),
    )  # fmt: skip
    return None if found is None else found[0]


def _state(done: dict[Key, Result | None]) -> Arrays:
    """The finished trials as a checkpoint."""
    lines = [[*key, asdict(r) if r else None] for key, r in done.items()]
    return {"results": np.frombuffer(json.dumps(lines).encode(), np.uint8)}


def _restore(state: Arrays | None) -> dict[Key, Result | None]:
    lines = json.loads(state["results"].tobytes()) if state is not None else []
    return {(c, row, n): Result(**r) if r else None for c, row, n, r in lines}


def _table(results: list[Result]) -> dict[str, np.ndarray]:
    """A column for each field; missing errors are NaN, no fall is the empty string."""
    lines = [asdict(r) for r in results]
    out = {}
    for name in lines[0] if lines else ():
        empty = "" if name == "fall" else np.nan
        out[name] = np.array([empty if line[name] is None else line[name] for line in lines])
    return out
