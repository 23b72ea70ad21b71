"""The command that lets a robot follow its reference, in a world that may differ from the planned one."""

from pathlib import Path
from typing import Annotated, Any

import typer

from slomo.cli.session import RobotOption, Session, command
from slomo.errors import UsageError

TrialsOption = Annotated[
    int | None, typer.Option("--trials", metavar="N", help="Success rates of N random trials for each disturbance.")
]
CompareOption = Annotated[
    bool, typer.Option("--compare", help="The same trials with convex MPC and with open-loop replay, in one table.")
]
RowsOption = Annotated[
    str | None, typer.Option("--rows", metavar="ROW,ROW", help="Only these disturbances, see docs/trials.md.")
]
ReplayOption = Annotated[
    str | None, typer.Option("--replay", metavar="ROW/N", help="One of the trials again, with its video.")
]
StateOption = Annotated[
    str | None, typer.Option("--state", metavar="estimated|truth", help="What the controller knows of the robot.")
]
SecondsOption = Annotated[
    float | None, typer.Option("--seconds", help="How long a cyclic motion goes on; 0: one cycle.")
]
WorldOption = Annotated[
    str | None,
    typer.Option("--terrain", metavar="FILE|none", help="The ground as it really is (.json), if not as planned."),
]
FrictionOption = Annotated[float | None, typer.Option("--friction", help="Of the ground.")]
PayloadOption = Annotated[float | None, typer.Option("--payload", metavar="KG", help="On the trunk.")]
PushOption = Annotated[
    list[str] | None,
    typer.Option("--push", metavar="NS@S,DEG|none", help="N s, when, and whither from the x axis. Repeatable."),
]
LatencyOption = Annotated[
    float | None, typer.Option("--latency", metavar="S", help="More delay from commands to motors.")
]


def _trials(trials: int | None, compare: bool, rows: str | None) -> dict[str, Any]:
    """The options of `track --trials` and `--compare` as entries of slomo.toml."""
    return {
        "trials": trials if trials is not None else 10,
        "controllers": ["ci-mpc", "convex-mpc", "open-loop"] if compare else None,
        "rows": rows.split(",") if rows else None,
    }


def _world(session: Session, terrain: str | None, track: dict[str, Any], push: list[str] | None) -> dict[str, Any]:
    """The options of `track --sim` as entries of slomo.toml."""
    changes = {"track": {name: value for name, value in track.items() if value is not None}, "inputs": {}}
    if push:
        changes["track"]["push"] = None if push == ["none"] else push
    if terrain is not None:
        changes["inputs"]["world"] = None if terrain == "none" else session.user_path(Path(terrain), "terrain")
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
        compare: CompareOption = False,
        rows: RowsOption = None,
        replay: ReplayOption = None,
    ) -> None:
        """The robot follows the reference; then the report with the side-by-side video.

        \b
        slomo track --sim --robot go1
        slomo track --sim --robot go1 --push 12@1.5,90 --payload 2
        slomo track --sim --robot go1 --terrain higher_step.json --friction 0.5
        slomo track --sim --robot go1 --seconds 60
        slomo track --robot go1 --trials 200
        slomo track --robot go1 --compare
        slomo track --robot go1 --replay push-18/7
        """
        if replay is not None:
            runner = session.runner(session.configure({"replay": {"trial": replay}}, robot))
            session.emit_artifact(runner.make_only("replay"))
        elif trials is not None or compare:
            runner = session.runner(session.configure({"trials": _trials(trials, compare, rows)}, robot))
            session.emit_artifact(runner.make_only("trials"))
        elif sim:
            given = dict(state=state, seconds=seconds, friction=friction, payload=payload, latency=latency)
            project = session.configure(_world(session, terrain, given, push), robot)
            session.emit_artifact(session.runner(project).make_only("track", show=not no_video))
        else:
            raise UsageError("what is to be done?", where="track", valid=("--sim", "--trials", "--compare", "--replay"))
