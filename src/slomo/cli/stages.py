"""The commands that make artifacts, from the clip to the reference, the report, and all at once."""

from pathlib import Path
from typing import Annotated, Any

import typer

from slomo.cli.options import (
    DurationOption,
    FovOption,
    Keypoints2dOption,
    LengthOption,
    MapOption,
    MasksOption,
    ModelOption,
    PlanModelOption,
    PriorOption,
    QualityOption,
    SegmenterOption,
    SkeletonOption,
    SlowMotionOption,
    SolverOption,
    StartOption,
    TruthOption,
    WeightsOption,
)
from slomo.cli.session import RobotOption, Session, command, device_there
from slomo.cli.subject import AtOption, BoxOption, chosen_subject
from slomo.errors import UsageError

KEYPOINT_SUFFIXES = (".json", ".npz")
BUILT_IN_SKELETONS = ("auto", "quadruped", "human")


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _skeleton(session: Session, skeleton: str | None) -> dict[str, dict[str, Any]]:
    """A built-in name is a parameter of the fit, a path one of the user's files; the one unsets the other."""
    if skeleton is None:
        return {}
    if skeleton in BUILT_IN_SKELETONS:
        return {"reconstruct": {"skeleton": skeleton}, "inputs": {"skeleton": None}}
    if not Path(skeleton).is_file():
        raise UsageError(
            f"no skeleton {skeleton!r}", where="--skeleton", valid=BUILT_IN_SKELETONS, todo="or give a .toml file"
        )
    return {"inputs": {"skeleton": session.user_path(Path(skeleton), "skeleton")}}


def _evidence(
    session: Session, prior: str | None, keypoints2d: str | None, model: str | None, model_map: Path | None
) -> dict[str, dict[str, Any]]:
    """Who is asked what the clip shows. "none" unsets a file; a file of the user's own stands for --prior auto."""
    evidence: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    if prior in ("auto", "none"):
        evidence["prior"], inputs["prior"] = None if prior == "auto" else prior, None
    elif prior is not None:
        evidence["prior"], inputs["prior"] = None, session.user_path(Path(prior), "prior: auto, none or a file")
    for role, name in (("keypoints2d", keypoints2d), ("keypoint_model", model)):
        if name is not None:
            inputs[role] = session.path_or_none(name, role)
    if model == "none":
        inputs["keypoint_map"] = None
    elif model_map is not None:
        inputs["keypoint_map"] = session.user_path(model_map, "keypoint_map")
    both = [bool(inputs[r]) if r in inputs else session.given(r) for r in ("keypoint_model", "keypoint_map")]
    if both[0] != both[1]:
        raise UsageError(f"needs --keypoint-{'map' if both[0] else 'model'} too", where="--keypoint-model")
    return {"evidence": evidence, "inputs": inputs}


def _from_clip(
    session: Session,
    skeleton: str | None,
    who: dict[str, Any],
    masks: str | None,
    weights: str | None,
    start: float | None,
    duration: float | None,
    slow_motion: float | None,
    length: float | None,
    quality: str | None,
    fov: float | None,
    evidence: dict[str, dict[str, Any]],
) -> dict[str, dict[str, Any]]:
    """The options of `reconstruct` as entries of slomo.toml."""
    changes = _skeleton(session, skeleton)
    files = {"masks": masks, "weights": weights}
    inputs = {role: session.path_or_none(path, role) for role, path in files.items() if path is not None}
    changes["inputs"] = changes.get("inputs", {}) | inputs | evidence["inputs"]
    changes["evidence"] = evidence["evidence"]
    changes["decode"] = _given(start=start, duration=duration, slow_motion=slow_motion)
    changes["masks"] = who
    if masks not in (None, "none"):
        changes["masks"].setdefault("segmenter", None)  # the default takes the masks that are given
    changes["camera"] = _given(fov_deg=fov)
    changes["reconstruct"] = changes.get("reconstruct", {}) | _given(length_m=length, quality=quality)
    return changes


def _truth(session: Session, truth: str | None) -> dict[str, Any]:
    return {} if truth is None else {"truth": session.path_or_none(truth, "truth")}


def add_commands(app: typer.Typer) -> None:
    """Register the commands with `app`."""

    @command(app, "reconstruct", runs=True)
    def reconstruct(
        session: Session,
        clip: Annotated[Path | None, typer.Argument(help="Video file. Default: the one of the last call.")] = None,
        skeleton: SkeletonOption = None,
        segmenter: SegmenterOption = None,
        masks: MasksOption = None,
        subject_at: AtOption = None,
        subject_box: BoxOption = None,
        weights: WeightsOption = None,
        start: StartOption = None,
        duration: DurationOption = None,
        slow_motion: SlowMotionOption = None,
        length: LengthOption = None,
        quality: QualityOption = None,
        fov: FovOption = None,
        prior: PriorOption = None,
        keypoints2d: Keypoints2dOption = None,
        keypoint_model: ModelOption = None,
        keypoint_map: MapOption = None,
    ) -> None:
        """Key points in metres from a clip: decode, masks, camera, evidence, fit, refinement.

        Options given here are written into slomo.toml, and hold until they are changed there or given anew.

        \b
        slomo reconstruct cat.mp4
        slomo reconstruct cat.mp4 --duration 4 --length 0.45 --quality draft
        slomo reconstruct man.mp4 --skeleton human
        slomo reconstruct dog.mp4 --slow-motion 8     # taken at 240 frames a second, plays at 30
        slomo reconstruct two.mp4 --subject-at 640,300,1.5
        slomo reconstruct cat.mp4 --prior none --keypoints2d points.json
        """
        evidence = _evidence(session, prior, keypoints2d, keypoint_model, keypoint_map)
        who = chosen_subject(segmenter, subject_at, subject_box)
        changes = _from_clip(
            session, skeleton, who, masks, weights, start, duration, slow_motion, length, quality, fov, evidence
        )
        if clip is not None:
            changes["inputs"] |= {"clip": session.user_path(clip, "clip")} | session.choice_reopened("clip")
        project = session.configure(changes)
        device_there(project, "reconstruct")
        session.emit_artifact(session.runner(project).make("reconstruct"))

    @command(app, "import", runs=True)
    def import_(
        session: Session,
        file: Annotated[
            Path | None,
            typer.Argument(
                help="keypoints.npz (docs/retarget.md), or a key-point JSON of SLoMo's authors. "
                "Default: the one of the last call."
            ),
        ] = None,
    ) -> None:
        """Key points from a file, instead of from a clip.

        \b
        slomo import keypoints.npz
        slomo import cat00.json     # one of the files that SLoMo's authors published; it does not come with slomo
        """
        inputs: dict[str, Any] = {}
        if file is not None:
            inputs = {"keypoints": session.user_path(file, "keypoints")} | session.choice_reopened("keypoints")
        project = session.configure({"inputs": inputs})
        session.emit_artifact(session.runner(project).make("import"))

    @command(app, "retarget", runs=True)
    def retarget(
        session: Session,
        robot: RobotOption,
        source: Annotated[
            str | None,
            typer.Option(
                "--from", metavar="reconstruct|import|FILE", help="Where the key points come from, if in doubt."
            ),
        ] = None,
        terrain: Annotated[
            str | None,
            typer.Option("--terrain", metavar="FILE|none", help="Ground with steps and slopes (.json)."),
        ] = None,
    ) -> None:
        """The motion in the robot's size: its base, hips and feet.

        \b
        slomo retarget --robot go1
        slomo retarget --robot go1 --from keypoints.npz
        slomo retarget --robot go1 --terrain hill.json
        """
        changes: dict[str, Any] = {}
        if source in ("reconstruct", "import"):
            changes["motion"] = source
        elif source is not None:
            changes = {"keypoints": session.user_path(Path(source), "keypoints"), "motion": "import"}
        if terrain is not None:
            changes["terrain"] = session.path_or_none(terrain, "terrain")
        project = session.configure({"inputs": changes}, robot)
        runner = session.runner(project)
        session.emit_artifact(runner.make("retarget") if "keypoints" in changes else runner.make_only("retarget"))

    @command(app, "optimize", runs=True)
    def optimize(
        session: Session,
        robot: RobotOption,
        model: PlanModelOption = None,
        solver: SolverOption = None,
        strict: Annotated[bool | None, typer.Option(help="Loaded feet do not slide at all.")] = None,
        cyclic: Annotated[bool | None, typer.Option(help="One cycle of the gait, closed to repeat for ever.")] = None,
        free_scale: Annotated[bool | None, typer.Option(help="The motion's size is a variable too.")] = None,
        free_steps: Annotated[bool | None, typer.Option(help="Step lengths are variables too, 0.7 to 1.4 dt.")] = None,
    ) -> None:
        """A reference that satisfies dynamics and contact: states, forces, inputs.

        \b
        slomo optimize --robot go1
        slomo optimize --robot go1 --cyclic
        slomo optimize --robot go1 --solver fatrop
        slomo optimize --robot go1 --model whole-body
        slomo optimize --robot go1 --set optimize.mu=0.5
        """
        changes = _given(model=model, solver=solver, strict=strict, cyclic=cyclic, free_scale=free_scale)
        if free_steps is not None:
            changes |= {"shortest_step": 0.7 if free_steps else None, "longest_step": 1.4 if free_steps else None}
        project = session.configure({"optimize": changes}, robot)
        session.emit_artifact(session.runner(project).make_only("optimize"))

    @command(app, "report", runs=True)
    def report(session: Session, robot: RobotOption, truth: TruthOption = None) -> None:
        """Side-by-side video, plots and tables. Every stage through track must be there; a fall is shown too.

        \b
        slomo report --robot go1
        """
        project = session.configure({"inputs": _truth(session, truth)}, robot)
        session.emit_artifact(session.runner(project).make_only("report"))

    @command(app, "run", runs=True)
    def run(
        session: Session,
        robot: RobotOption,
        source: Annotated[
            Path | None, typer.Argument(metavar="CLIP|KEYPOINTS", help="Default: that of the last call.")
        ] = None,
        no_video: Annotated[bool, typer.Option("--no-video", help="Leave out the report with its video.")] = False,
        truth: TruthOption = None,
        skeleton: SkeletonOption = None,
        segmenter: SegmenterOption = None,
        masks: MasksOption = None,
        subject_at: AtOption = None,
        subject_box: BoxOption = None,
        weights: WeightsOption = None,
        start: StartOption = None,
        duration: DurationOption = None,
        slow_motion: SlowMotionOption = None,
        length: LengthOption = None,
        quality: QualityOption = None,
        fov: FovOption = None,
        prior: PriorOption = None,
        keypoints2d: Keypoints2dOption = None,
        keypoint_model: ModelOption = None,
        keypoint_map: MapOption = None,
    ) -> None:
        """Everything, from the clip (or key points) to the robot and the report. What is current is kept.

        \b
        slomo run cat.mp4 --robot go1
        slomo run cat.mp4 --robot go1 --duration 4 --length 0.45
        slomo run two.mp4 --robot go1 --subject-box 500,200,800,420
        slomo run keypoints.npz --robot go1
        """
        evidence = _evidence(session, prior, keypoints2d, keypoint_model, keypoint_map)
        who = chosen_subject(segmenter, subject_at, subject_box)
        changes = _from_clip(
            session, skeleton, who, masks, weights, start, duration, slow_motion, length, quality, fov, evidence
        )
        inputs = changes["inputs"]
        inputs |= _truth(session, truth)
        if source is not None:
            role = "keypoints" if source.suffix in KEYPOINT_SUFFIXES else "clip"
            inputs[role] = session.user_path(source, role)
            both = session.given("clip" if role == "keypoints" else "keypoints")
            inputs["motion"] = None if not both else "import" if role == "keypoints" else "reconstruct"
        project, last = session.configure(changes, robot), "track" if no_video else "report"
        device_there(project, last)
        session.emit_artifact(session.runner(project).make(last))
