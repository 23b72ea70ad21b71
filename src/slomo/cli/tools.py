"""The commands beside the line: robots, doctor, synth, weights."""

from pathlib import Path
from typing import Annotated, Any

import typer

from slomo.cli.session import Session, command
from slomo.console import Console
from slomo.errors import SlomoError
from slomo.stage import Silent


class _Shown(Silent):
    """Progress on the console alone."""

    def __init__(self, console: Console):
        self.console = console

    def update(self, fraction: float, message: str = "") -> None:
        self.console.update(fraction, message)

    def note(self, message: str) -> None:
        self.console.note(message)


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

    weights = typer.Typer(
        help="Weights of the segmentation network.\n\n\b\nslomo weights fetch",
        no_args_is_help=True,
        rich_markup_mode=None,
    )
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

    @command(app, "dataset")
    def dataset(
        session: Session,
        out_dir: Annotated[Path, typer.Argument(help="Folder; the shards go into one for the kind below it.")],
        kind: Annotated[str | None, typer.Option(metavar="quadruped|human", help="Default: quadruped.")] = None,
        samples: Annotated[
            int | None, typer.Option(help="How many pictures, rounded up to whole shards of 64. Default: 6400.")
        ] = None,
        seed: Annotated[int | None, typer.Option(help="Of everything in it. Default: 0.")] = None,
        workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    ) -> None:
        """Labelled pictures of random animals or people, to train the prior on. Goes on where it was stopped.

        \b
        slomo dataset data --kind human --samples 640 --workers 2
        """
        from slomo import settings
        from slomo.store.files import check_writable, writing
        from slomo.synth.dataset import SHARD, Config, write_dataset

        given: dict[str, Any] = dict(kind=kind, samples=samples, seed=seed)
        config = settings.make(Config, {k: v for k, v in given.items() if v is not None}, where="dataset")
        check_writable(out_dir, named="OUT_DIR")
        session.console.start("dataset")
        if config.samples % SHARD:
            session.console.note(f"dataset: {config.shards * SHARD} pictures, in whole shards of {SHARD}")
        with writing(out_dir, folder="OUT_DIR"):
            path = write_dataset(out_dir, config, _Shown(session.console), workers=workers)
        session.emit(str(path.absolute()), {"path": str(path.absolute()), "config": vars(config)})

    @command(app, "synth")
    def synth(
        session: Session,
        out_dir: Annotated[Path, typer.Argument(help="Folder for clip.mp4, truth.npz and masks.npz.")],
        animal: Annotated[str | None, typer.Option(metavar="dog|cat|horse|person", help="Default: dog.")] = None,
        gait: Annotated[
            str | None,
            typer.Option(
                metavar="NAME",
                help="walk, pace, trot, gallop, rotary, stand, reach, graze, rear, sit, lie; "
                "of a person walk, run, stand, squat, jack, wave, stretch, bend, jump. Default: walk.",
            ),
        ] = None,
        speed: Annotated[float | None, typer.Option(help="m/s; 0: the usual speed of the gait. Default: 0.")] = None,
        turn: Annotated[float | None, typer.Option(help="Degrees a second, positive to the left. Default: 0.")] = None,
        tempo: Annotated[
            str | None,
            typer.Option(
                metavar="steady|faster|slower|stops|starts", help="How fast the motion is played. Default: steady."
            ),
        ] = None,
        camera: Annotated[str | None, typer.Option(metavar="follow|orbit|pan|static", help="Default: follow.")] = None,
        view: Annotated[
            float | None, typer.Option(help="Degrees; 0: the left flank, 90: from the front. Default: 15.")
        ] = None,
        shake: Annotated[float | None, typer.Option(help="Camera shake; 0: none, 1: a hand. Default: 1.")] = None,
        clutter: Annotated[bool | None, typer.Option("--clutter", help="Posts near the animal. Default: none.")] = None,
        seconds: Annotated[float | None, typer.Option(help="Length of the clip. Default: 3.")] = None,
        fps: Annotated[float | None, typer.Option(help="Frames a second. Default: 30.")] = None,
        width: Annotated[int | None, typer.Option(help="Pixels, even. Default: 480.")] = None,
        height: Annotated[int | None, typer.Option(help="Pixels, even. Default: 270.")] = None,
        noise: Annotated[
            float | None, typer.Option(help="Standard deviation of the sensor noise, of 255. Default: 2.")
        ] = None,
        crf: Annotated[int | None, typer.Option(help="H.264 quality; lower is better. Default: 22.")] = None,
        seed: Annotated[int | None, typer.Option(help="Of the animal, the place and the hand. Default: 0.")] = None,
    ) -> None:
        """A rendered clip of an animal or a person, with its truth.

        \b
        slomo synth trot --gait trot --seconds 3 --seed 1
        slomo run trot/clip.mp4 --truth trot/truth.npz --robot go1
        slomo synth jack --animal person --gait jack --camera orbit --view 80
        """
        from slomo import settings
        from slomo.store.files import check_writable, writing
        from slomo.synth.clip import Config, write_clip

        given: dict[str, Any] = dict(
            animal=animal, gait=gait, speed=speed, turn=turn, tempo=tempo, camera=camera, view=view, shake=shake,
            clutter=clutter, seconds=seconds, fps=fps, width=width, height=height, noise=noise, crf=crf, seed=seed,
        )  # fmt: skip
        config = settings.make(Config, {k: v for k, v in given.items() if v is not None}, where="synth")
        check_writable(out_dir, named="OUT_DIR")
        session.console.start("synth")
        with writing(out_dir, folder="OUT_DIR"):
            write_clip(out_dir, config, _Shown(session.console))
        session.emit(str(out_dir.absolute()), {"path": str(out_dir.absolute()), "config": vars(config)})
