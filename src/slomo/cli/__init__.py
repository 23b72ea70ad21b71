"""The command line: parse, call the pipeline, print the artifact's path."""

import sys
from typing import Annotated

import typer

from slomo import __version__
from slomo.cli import deploy, export, project, stages, tools, track

app = typer.Typer(
    name="slomo",
    help="From a casual video of an animal or a person to a motion that a legged robot performs.\n\n"
    "\b\nslomo run cat.mp4 --robot go1\nslomo status --why\n\n"
    "Exit codes: 0 done or cached; 1 failed; 2 usage; 3 a stage's input is missing or stale; 4 the given data is "
    "invalid; 75 locked and --no-wait; 129/130/143 ended by SIGHUP, SIGINT or SIGTERM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"slomo {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show slomo's version and exit.")
    ] = False,
) -> None: ...


stages.add_commands(app)
track.add_commands(app)
project.add_commands(app)
deploy.add_commands(app)
export.add_commands(app)
tools.add_commands(app)


def main() -> None:
    """Entry point of `slomo`. Options that all commands share may also stand before the command."""
    app(args=_common_last(sys.argv[1:]), prog_name="slomo")


def _common_last(args: list[str]) -> list[str]:
    """Move the common options from before the command to the end."""
    moved = []
    while args and args[0].split("=")[0] in ("--project", "--json", "--quiet", "-q", "--no-wait", "--fresh", "--set"):
        count = 2 if args[0] in ("--project", "--set") else 1
        moved += args[:count]
        args = args[count:]
    return args + moved
