"""The commands for a robot and its twin: deploy, twin."""

import sys
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from slomo.cli.session import RobotOption, Session, command
from slomo.errors import Interrupted, MissingInput, UsageError

PortOption = Annotated[int, typer.Option(min=0, max=65535, help="UDP port of the robot or the twin.")]
ScrambledOption = Annotated[bool, typer.Option("--scrambled", help="The check sum is scrambled, see docs/deploy.md.")]

RealtimeOption = Annotated[bool, typer.Option(help="Ask the system for priority.")]


def add_commands(app: typer.Typer) -> None:
    """Register the commands with `app`."""

    @command(app, "deploy", runs=True)
    def deploy(
        session: Session,
        robot: RobotOption,
        transport: Annotated[str, typer.Option(metavar="twin|go1-udp", help="What is to be moved.")] = "twin",
        robot_address: Annotated[
            str | None,
            typer.Option("--robot-address", help="Of a real robot; asks before anything is sent, not with --dry-run."),
        ] = None,
        robot_port: PortOption = 8007,
        local_port: Annotated[int, typer.Option(min=0, max=65535, help="UDP port to send from.")] = 8080,
        yes: Annotated[bool, typer.Option("--yes", help="The address is right; do not ask.")] = False,
        dry_run: Annotated[
            bool, typer.Option("--dry-run", help="Compute and log everything, send nothing; from a robot only listen.")
        ] = False,
        scrambled: ScrambledOption = False,
        realtime: RealtimeOption = True,
        from_log: Annotated[
            Path | None, typer.Option("--from-log", help="Run nothing; make the artifact from this log.")
        ] = None,
    ) -> None:
        """Stand up, perform the motion, lie down: on a twin in this computer, or on a robot.

        Any key, Ctrl-C, or button B of the remote stops it.

        \b
        slomo deploy --robot go1
        slomo deploy --robot go1 --dry-run
        slomo deploy --robot go1 --transport go1-udp --robot-address 192.168.123.10
        """
        from slomo.deploy.go1 import Go1
        from slomo.deploy.run import check_way, perform
        from slomo.deploy.stops import Stops

        project = session.project(robot)
        stops = Stops()
        if from_log is None:
            Go1(project.robot)  # no other robot has this wire format: told before anything is asked or compiled
            way = check_way(
                transport, robot_address, confirm=lambda address: yes or _asked(address), port=robot_port,
                local_port=local_port, scrambled=scrambled, dry=dry_run, realtime=realtime,
            )  # fmt: skip
            plan = _plan(session, robot, wanted_by="deploy")
            from_log = session.root / "runs" / f"{project.robot.name}-{datetime.now():%Y%m%d-%H%M%S}.log"
            session.console.start("deploy")
            if dry_run:
                session.console.note("deploy: dry run")
            with stops:
                if stops.terminal:
                    session.console.note("deploy: any key stops it")
                perform(plan, way, from_log, stops=stops, say=lambda text: session.console.note(f"deploy: {text}"))
            session.console.note(f"deploy: log: {from_log}")
        session.configure({"inputs": {"deploy_log": session.user_path(from_log, "log")}}, robot)
        session.fresh = False
        m = session.runner(session.project(robot)).make_only("deploy")
        if stops.number is not None:
            raise Interrupted(stops.number, f"stopped; the robot is in damping; {session.root / m['directory']}")
        session.emit_artifact(m)

    @command(app, "twin")
    def twin(
        session: Session,
        robot: RobotOption,
        host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
        port: PortOption = 8007,
        noise: Annotated[bool, typer.Option(help="Sensors with biases, noise and delay.")] = True,
        seed: Annotated[int, typer.Option(help="Of biases and noise.")] = 0,
        friction: Annotated[float, typer.Option(min=0.01, help="Of the ground.")] = 0.8,
        battery: Annotated[int, typer.Option(min=0, max=100, help="%, that it reports.")] = 90,
        temperature: Annotated[float, typer.Option(min=-100, max=127, help="Degrees C of the motors.")] = 35.0,
        scrambled: ScrambledOption = False,
        realtime: RealtimeOption = True,
        seconds: Annotated[float | None, typer.Option(help="End by itself after so long.")] = None,
    ) -> None:
        """A simulated robot that speaks the robot's own UDP protocol, in real time.

        It stands on the ground of the project's motion, where that begins, or on a plane.

        \b
        slomo twin --robot go1
        """
        import time

        from slomo.deploy.link import is_loopback, resolve
        from slomo.deploy.run import lying, priority_of
        from slomo.deploy.twin import Twin, TwinConfig, serve
        from slomo.robot import load_robot
        from slomo.terrain import Terrain

        address = resolve(host)
        if not is_loopback(address):
            raise UsageError("a twin listens in this computer only", where="--host", valid=("127.0.0.1",))
        try:
            plan = _plan(session, robot, wanted_by="twin")
        except MissingInput:
            plan = None
        model = load_robot(robot)
        config = TwinConfig(noise=noise, friction=friction, battery=battery, temperature=temperature, seed=seed)
        simulated = Twin(
            model, plan.world if plan else Terrain(), lying(plan, model), config=config, scrambled=scrambled
        )
        end = time.monotonic() + seconds if seconds is not None else float("inf")
        with priority_of(realtime):
            serve(
                simulated, address, port, until=lambda: time.monotonic() > end,
                say=lambda text: session.console.note(f"twin: {text}"),
            )  # fmt: skip
        session.emit("", dict(simulated.counts))


def _plan(session: Session, robot: str, *, wanted_by: str):
    """What the project would have the robot do. Raises `MissingInput` unless it has been tracked in simulation."""
    from slomo.deploy.config import check
    from slomo.deploy.run import Plan
    from slomo.deploy.stage import identity
    from slomo.motion import Reference
    from slomo.terrain import Terrain

    project = session.project(robot)
    config = project.config("deploy")
    check(config)
    runner = session.runner(project)
    runner.current("track", wanted_by=wanted_by)
    optimized = runner.current("optimize", wanted_by=wanted_by)
    terrain = Terrain.from_json(optimized.json["terrain.json"])
    return Plan(
        robot=robot,
        reference=Reference.from_arrays(optimized.npz["reference.npz"]),
        terrain=terrain,
        world=Terrain.load(world) if (world := project.given("world")) else terrain,
        track=project.config("track"),
        deploy=config,
        identity=identity(optimized.npz["reference.npz"], project.robot, config),
    )


def _asked(address: str) -> bool:
    """Whether the user types the address once more."""
    if not sys.stdin.isatty():
        raise UsageError(f"commands to {address} need a confirmation", where="deploy", todo="give --yes")
    answer = typer.prompt(f"Commands will be sent to {address}. Type the address to confirm", err=True, default="")
    return answer.strip() == address
