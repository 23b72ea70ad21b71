"""The stages, what each one takes, and what makes its artifact the one it is: one table and the keys."""

import dataclasses
import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slomo import settings
from slomo.errors import MissingInput, UsageError
from slomo.stage import Artifact, Inputs, Progress
from slomo.store import SCHEMA, Manifest, Store, digest_input, digest_json, plain

if TYPE_CHECKING:
    from slomo.robot import Robot

ALL = ("*",)


@dataclass(frozen=True)
class StageSpec:
    """One row of the table.

    Attributes:
        module, run, config, version: where the stage's function, its record of parameters and its version are.
        upstream: stages whose artifacts it takes.
        files: roles of the user's files that it takes (see `settings.INPUTS`); `optional` ones where they are given.
        robot: whether it takes the robot.  inspects: whether it also takes an artifact that failed, to show it.
        shares: parameters that are those of the stage `lender` unless its own section sets them; `ALL` that both have.
        command: what the user types to make its artifact; {name}: the value of one of its parameters.
    """

    name: str
    module: str
    command: str
    run: str = "run"
    config: str = "Config"
    version: str = "VERSION"
    upstream: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    robot: bool = False
    inspects: bool = False
    shares: tuple[str, ...] = ()
    lender: str = "reconstruct"

    def of_module(self, name: str) -> Any:
        """An attribute of the stage's module, which is imported only now: some take seconds."""
        return getattr(importlib.import_module(self.module), name)


@dataclass(frozen=True)
class ImportConfig:
    """Key points are imported as they are."""


IMPORT_VERSION = 1


def run_import(inputs: Inputs, config: ImportConfig, progress: Progress) -> Artifact:
    """`keypoints.npz` from a key-point file of any known format. Raises `InvalidData`."""
    from slomo.formats import load_keypoints

    motion = load_keypoints(inputs.files["keypoints"], note=progress.note)
    report = {"frames": len(motion.t), "duration": float(motion.t[-1] - motion.t[0]), "names": list(motion.names)}
    return Artifact(npz={"keypoints.npz": motion.to_arrays()}, json={"report.json": report})


_RECONSTRUCT = "slomo.reconstruct.stage"
STAGES: dict[str, StageSpec] = {
    s.name: s
    for s in (
        StageSpec("decode", "slomo.reconstruct.decode_stage", "reconstruct", files=("clip",)),
        StageSpec(
            "masks", _RECONSTRUCT, "reconstruct", "run_masks", "MasksConfig", "MASKS_VERSION", ("decode",),
            optional=("masks", "weights"), shares=("quality",),
        ),
        StageSpec(
            "camera", _RECONSTRUCT, "reconstruct", "run_camera", "CameraConfig", "CAMERA_VERSION", ("decode", "masks"),
            shares=("quality",),
        ),
        StageSpec(
            "evidence", "slomo.prior.stage", "reconstruct", upstream=("decode", "masks", "camera"),
            shares=("skeleton", "fps"), optional=("skeleton", "prior", "keypoints2d", "keypoint_model", "keypoint_map"),
        ),
        StageSpec(
            "fit", "slomo.reconstruct.fit_stage", "reconstruct", "run_fit", "FitConfig", "FIT_VERSION",
            ("decode", "masks", "camera", "evidence"), optional=("skeleton",), shares=ALL,
        ),
        StageSpec(
            "reconstruct", "slomo.reconstruct.refine_stage", "reconstruct", "run_refine", "ReconstructConfig",
            "REFINE_VERSION", ("decode", "masks", "camera", "evidence", "fit"), optional=("skeleton",),
        ),
        StageSpec(
            "import", "slomo.pipeline", "import", "run_import", "ImportConfig", "IMPORT_VERSION", (), ("keypoints",)
        ),
        StageSpec(
            "retarget", "slomo.retarget.stage", "retarget", upstream=("reconstruct",), optional=("terrain",), robot=True
        ),
        StageSpec("optimize", "slomo.optimize.stage", "optimize", upstream=("retarget",), robot=True),
        StageSpec(
            "track", "slomo.track.stage", "track --sim", upstream=("optimize",), optional=("world",), robot=True
        ),
        StageSpec(
            "deploy", "slomo.deploy.stage", "deploy", upstream=("optimize", "track"), files=("deploy_log",), robot=True
        ),
        StageSpec(
            "trials", "slomo.track.trials", "track --trials {trials}", upstream=("optimize",), robot=True, shares=ALL,
            lender="track",
        ),
        StageSpec(
            "replay", "slomo.report.replay", "track --replay {trial}", upstream=("optimize",), robot=True, shares=ALL,
            lender="trials",
        ),
        StageSpec(
            "report", "slomo.report.stage", "report", robot=True, inspects=True, optional=("truth",),
            upstream=("decode", "masks", "camera", "evidence", "reconstruct", "retarget", "optimize", "track"),
        ),
    )
}  # fmt: skip
_FROM_CLIP = ("decode", "masks", "camera", "evidence", "fit", "reconstruct")


def load_robot(name_or_path: str) -> "Robot":
    """The robot; Pinocchio is imported only now."""
    from slomo.robot import load_robot

    return load_robot(name_or_path)


def _find_weights() -> Path | None:
    from slomo.reconstruct.u2net import find_weights

    return find_weights()


def _find_prior(skeleton: str | Path) -> Path | None:
    """The weights that come with slomo for the kind of this skeleton, all of them where the clip is to tell it. Raises
    `UsageError`, `InvalidData`."""
    from slomo.prior.inference import packaged, packaged_folder
    from slomo.skeleton import AUTO, load_skeleton

    return packaged_folder() if skeleton == AUTO else packaged(load_skeleton(skeleton).kind)


@dataclass(frozen=True)
class Identity:
    """Everything that an artifact is made from. Its digest is the artifact's key."""

    stage: str
    version: int
    config: Mapping[str, Any]
    inputs: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    robot: str | None = None

    @property
    def key(self) -> str:
        """SHA-256 (hex) of the canonical JSON of the schema and all the fields."""
        return digest_json({"schema": SCHEMA, **dataclasses.asdict(self)})


class Project:
    """A project folder with its parameters, for at most one robot.

    Args:
        root: folder with slomo.toml (or where it will be).
        robot: name or robot.toml, or None.
    """

    def __init__(self, root: Path, robot: str | None = None):
        self.root, self.robot_name = root, robot
        self.store = Store(root)
        self.tables = settings.read(root, list(STAGES))

    @cached_property
    def robot(self) -> "Robot":
        """Raises `UsageError` without --robot, or for an unknown one."""
        if self.robot_name is None:
            raise UsageError("no robot given", where="--robot", todo="`slomo robots` lists them")
        return load_robot(self.robot_name)

    @cached_property
    def motion(self) -> str:
        """Where the key points come from: "reconstruct" or "import".

        Raises:
            MissingInput: neither a clip nor key points are given.
            UsageError: both are, and `inputs.motion` does not choose.
        """
        chosen = self.tables.get("inputs", {}).get("motion")
        if chosen is not None:
            if chosen not in ("reconstruct", "import"):
                raise UsageError(
                    f"inputs.motion = {chosen!r}", where=self.root / settings.FILE, valid=("reconstruct", "import")
                )
            return chosen
        given = [s for s, role in (("reconstruct", "clip"), ("import", "keypoints")) if self.given(role)]
        if not given:
            raise MissingInput(
                "no motion yet", where=self.root, todo="run `slomo reconstruct CLIP` or `slomo import KEYPOINTS` first"
            )
        if len(given) == 2:
            raise UsageError(
                "the project has both a clip and imported key points",
                where=self.root,
                todo=f"choose: `slomo retarget --robot {self.robot_name or 'R'} --from reconstruct` or `--from import`",
            )
        return given[0]

    def given(self, role: str) -> Path | None:
        """The user's file for `role` in slomo.toml, relative to the project folder."""
        name = self.tables.get("inputs", {}).get(role)
        return self.root / name if name else None

    def upstream(self, stage: str) -> tuple[str, ...]:
        """The stages that `stage` takes here: with imported key points there is no clip and what comes from it."""
        names = STAGES[stage].upstream
        if stage in _FROM_CLIP or "reconstruct" not in names or self.motion == "reconstruct":
            return names
        return ("import", *(n for n in names if n not in _FROM_CLIP))

    def chain(self, stage: str) -> list[str]:
        """`stage` and everything before it, in order."""
        seen: dict[str, None] = {}
        for name in self.upstream(stage):
            seen |= dict.fromkeys(self.chain(name))
        return [*seen, stage]

    def label(self, stage: str) -> str:
        """Name of the stage's pointer: `optimize-go1`, `decode`."""
        return f"{stage}-{self.robot.name}" if STAGES[stage].robot else stage

    def command(self, stage: str) -> str:
        """What the user types to make the stage's artifact."""
        spec = STAGES[stage]
        values = vars(spec.of_module(spec.config)()) | self.tables.get(stage, {}) if "{" in spec.command else {}
        text = re.sub(r"{(\w+)}", lambda m: str(values.get(m[1]) or m[1].upper()), spec.command)
        return f"slomo {text}" + (f" --robot {self.robot_name}" if spec.robot else "")

    def config(self, stage: str) -> Any:
        """The stage's parameters: its defaults and slomo.toml over them. Raises `UsageError`."""
        where = f"{self.root / settings.FILE} [{stage}]"
        table = self.tables.get(stage, {})
        record = STAGES[stage].of_module(STAGES[stage].config)
        if shares := STAGES[stage].shares:
            lent = self.config(STAGES[stage].lender)
            names = [f.name for f in dataclasses.fields(record) if hasattr(lent, f.name)] if shares == ALL else shares
            table = {name: getattr(lent, name) for name in names} | table
        return settings.make(record, table, where=where)

    def files(self, stage: str) -> dict[str, Path]:
        """Role -> the user's file that the stage takes. Raises `MissingInput` for one that is needed."""
        spec = STAGES[stage]
        found = {role: path for role in (*spec.files, *spec.optional) if (path := self.given(role))}
        for role in spec.files:
            if role not in found:
                command = self.command(stage) if spec.robot else f"slomo {spec.command} {role.upper()}"
                raise MissingInput(f"no {role} given", where=self.root, todo=f"run `{command}`")
        if "weights" in spec.optional:
            self._choose_masks(found, self.tables.get(stage, {}).get("segmenter", "auto"))
        if "prior" in spec.optional:
            self._choose_prior(found, self.config(stage))
        return found

    @staticmethod
    def _choose_masks(found: dict[str, Path], segmenter: str) -> None:
        """Leave only what the segmenter reads, so that nothing else is in the key."""
        if segmenter not in ("auto", "user"):
            found.pop("masks", None)
        if segmenter in ("still", "motion", "user") or "masks" in found:
            found.pop("weights", None)
        elif "weights" not in found and (weights := _find_weights()):
            found["weights"] = weights

    @staticmethod
    def _choose_prior(found: dict[str, Path], config: Any) -> None:
        """Slomo's own network where the user gave none; none at all where it is switched off."""
        if config.prior == "none":
            found.pop("prior", None)
        elif "prior" not in found and (weights := _find_prior(found.get("skeleton") or config.skeleton)):
            found["prior"] = weights

    def identity(self, stage: str, upstream: Mapping[str, Manifest]) -> Identity:
        """What the stage's artifact is made from, given the artifacts before it."""
        spec = STAGES[stage]
        return Identity(
            stage=stage,
            version=spec.of_module(spec.version),
            config=plain(self.config(stage)),
            inputs={name: m["content"] for name, m in upstream.items()},
            files={
                role: digest_input(path, role if role in spec.files else f"{role}, or do without: --set inputs.{role}=")
                for role, path in self.files(stage).items()
            },
            robot=self.robot.digest if spec.robot else None,
        )
