"""The command that lets a robot follow its reference, in a world that may differ from the planned one."""

from typing import Annotated, Any

import typer

from slomo.cli.session import RobotOption, Session, command
from slomo.errors import UsageError

TrialsOption = Annotated[
    int | None,
    typer.Option(
        "--trials",
        metavar="N",
        help="Success rates of N random trials for each disturbance, instead of --sim; 200 for narrow intervals.",
    ),
]
CompareOption = Annotated[
    bool | None,
    typer.Option(
        "--compare/--no-compare",
        help="The trials with convex MPC and with open-loop replay too, in one table; without --trials "
        "as many as slomo.toml says, else 10 of each.",
    ),
]
RowsOption = Annotated[
    str | None,
    typer.Option("--rows", metavar="ROW,ROW", help="With --trials or --compare: only these, see docs/trials.md."),
]
ReplayOption = Annotated[
    str | None, typer.Option("--replay", metavar="ROW/N", help="One of the trials again, with its video.")
]
StateOption = Annotated[
    str | None,
    typer.Option(
        "--state", metavar="estimated|truth", help="What the controller knows of the robot. Default: estimated."
    ),
]
SecondsOption = Annotated[
    float | None,
    typer.Option("--seconds", metavar="S", help="How many seconds a cyclic motion goes on. Default: 0, one cycle."),
]
WorldOption = Annotated[
    str | None,
    typer.Option("--terrain", metavar="FILE|none", help="The ground as it really is (.json). Default: as planned."),
]
FrictionOption = Annotated[
    float | None,
    typer.Option(
        "--friction",
        metavar="MU",
        help="The friction coefficient of the ground. Default: 0.8; the controller plans with track.mu, 0.6.",
    ),
]
PayloadOption = Annotated[
    float | None,
    typer.Option(
        "--payload",
        metavar="KG",
        help="A box of so many kg is on the trunk, of which the controller does not know. Default: 0.",
    ),
]
PushOption = Annotated[
    list[str] | None,
    typer.Option(
        "--push",
        metavar="NS@S,DEG|none",
        help="The trunk is pushed by so many N s, within 0.1 s from that second of the motion on, in that direction: "
        "degrees, 0 along the motion's x axis, 90 to its left. Repeatable. Default: none.",
    ),
]
LatencyOption = Annotated[
    float | None,
    typer.Option(
        "--latency",
        metavar="S",
        help="Commands reach the motors so many seconds later than after track.command_delay, 0.002. Default: 0.",
    ),
]
CONTROLLERS = ["ci-mpc", "convex-mpc", "open-loop"]
COMPARED = 10  # trials of each row and controller: three controllers at the default of 200 would take many hours
# What each kind of call makes use of; the world of a trial is drawn at random.
USED = {
    "--sim": (
        "--sim",
        "--no-video",
        "--state",
        "--seconds",
        "--terrain",
        "--friction",
        "--payload",
        "--push",
        "--latency",
    ),
    "--trials": ("--trials", "--compare", "--no-compare", "--rows", "--no-video"),
    "--replay": ("--replay",),
}
IN_TRIALS_TOO = ("--state", "--friction")  # as parameters of [track]


def _kind(given: dict[str, Any]) -> str:
    """Which kind of call it is (a key of `USED`). Raises `UsageError` for none, and for an option without effect."""
    named = [name for name, value in given.items() if value is not None and value is not False and value != []]
    by = next((name for name in ("--replay", "--trials", "--compare", "--sim") if name in named), None)
    if by is None:
        raise UsageError("what is to be done?", where="track", valid=("--sim", "--trials", "--compare", "--replay"))
    kind = "--trials" if by == "--compare" else by
    for name in named:
        if name not in USED[kind]:
            todo = "leave it out"
            if name in IN_TRIALS_TOO:
                todo = f"trials take it from slomo.toml: --set track.{name.removeprefix('--')}={given[name]}"
            raise UsageError(f"has no effect with {by}", where=name, todo=todo)
    return kind


def _trials(session: Session, trials: int | None, compare: bool | None, rows: str | None) -> dict[str, Any]:
    """The options of `track --trials` and `--compare` as entries of slomo.toml; what is not given stays as it is."""
    from slomo.pipeline import Project

    changes: dict[str, Any] = {} if trials is None else {"trials": trials}
    if trials is None and "trials" not in Project(session.root).tables.get("trials", {}):
        changes["trials"] = COMPARED
    if compare is not None:
        changes["controllers"] = CONTROLLERS if compare else None
    return changes | ({"rows": rows.split(",")} if rows else {})


def _world(session: Session, terrain: str | None, track: dict[str, Any], push: list[str] | None) -> dict[str, Any]:
    """The options of `track --sim` as entries of slomo.toml."""
    changes = {"track": {name: value for name, value in track.items() if value is not None}, "inputs": {}}
    if push:
        changes["track"]["push"] = None if push == ["none"] else push
    if terrain is not None:
        changes["inputs"]["world"] = session.path_or_none(terrain, "terrain")
    return changes


def add_commands(app: typer.Typer) -> None:
    """Register the command with `app`."""

    @command(app, "track", runs=True)
    def track(
        session: Session,
        robot: RobotOption,
        sim: Annotated[bool, typer.Option("--sim", help="In simulation (MuJoCo).")] = False,
        no_video: Annotated[bool, typer.Option("--no-video", help="Leave out the report with its video.")] = False,
        state: StateOption = None,
        seconds: SecondsOption = None,
        terrain: WorldOption = None,
        friction: FrictionOption = None,
        payload: PayloadOption = None,
        push: PushOption = None,
        latency: LatencyOption = None,
        trials: TrialsOption = None,
        compare: CompareOption = None,
        rows: RowsOption = None,
        replay: ReplayOption = None,
    ) -> None:
        """The robot follows the reference; then the report with the side-by-side video.

        Options given here are written into slomo.toml, and hold until they are changed there or given anew.

        \b
        slomo track --sim --robot go1
        slomo track --sim --robot go1 --push 12@1.5,90 --payload 2
        slomo track --sim --robot go1 --terrain higher_step.json --friction 0.5
        slomo track --sim --robot go1 --seconds 60
        slomo track --robot go1 --trials 200
        slomo track --robot go1 --compare
        slomo track --robot go1 --replay push-18/7
        """
        kind = _kind(
            {
                "--sim": sim, "--no-video": no_video, "--state": state, "--seconds": seconds, "--terrain": terrain,
                "--friction": friction, "--payload": payload, "--push": push, "--latency": latency, "--trials": trials,
                "--compare": compare is True, "--no-compare": compare is False, "--rows": rows, "--replay": replay,
            }
        )  # fmt: skip
        if kind == "--replay":
            runner = session.runner(session.configure({"replay": {"trial": replay}}, robot))
            session.emit_artifact(runner.make_only("replay"))
        elif kind == "--trials":
            runner = session.runner(session.configure({"trials": _trials(session, trials, compare, rows)}, robot))
            session.emit_artifact(runner.make_only("trials"))
        else:
            given = dict(state=state, seconds=seconds, friction=friction, payload=payload, latency=latency)
            project = session.configure(_world(session, terrain, given, push), robot)
            session.emit_artifact(session.runner(project).make_only("track", show=not no_video))
