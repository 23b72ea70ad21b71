"""The commands beside the line: robots, doctor, synth, weights."""

import typer

from slomo.cli.session import Session, command
from slomo.errors import SlomoError


def add_commands(app: typer.Typer) -> None:
    """Register the commands with `app`."""

    @command(app, "robots")
    def robots(session: Session) -> None:
        """The robots that --robot knows by name.

        \b
        slomo robots
        """
        from slomo.robot_file import robot_folders

        found = {name: str(path) for name, path in sorted(robot_folders().items())}
        session.emit("\n".join(found), found)

    @command(app, "doctor")
    def doctor(session: Session) -> None:
        """Check the installation: versions, devices, robots, weights, video codecs, caches, disk.

        \b
        slomo doctor
        """
        from slomo.doctor import examine

        checks = examine(session.root)
        lines = [f"{'ok  ' if c.ok else 'FAIL' if c.needed else 'note'}  {c.name:<14} {c.detail}" for c in checks]
        healthy = all(c.ok or not c.needed for c in checks)
        session.emit("\n".join(lines), {"healthy": healthy, "checks": [vars(c) for c in checks]})
        if not healthy:
            bad = [c.name for c in checks if c.needed and not c.ok]
            raise SlomoError(f"not usable: {', '.join(bad)}", where="doctor", todo="see the lines marked FAIL")

    weights = typer.Typer(help="Weights of the segmentation network.", no_args_is_help=True, rich_markup_mode=None)
    app.add_typer(weights, name="weights")

    @command(weights, "fetch")
    def fetch(session: Session) -> None:
        """Download the U2-Net-p weights (5 MB, checksummed) into your cache, for --segmenter u2netp.

        \b
        slomo weights fetch
        """
        from slomo.reconstruct.u2net import download_weights

        path = download_weights()
        session.emit(str(path), {"path": str(path)})
