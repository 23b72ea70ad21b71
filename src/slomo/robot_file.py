"""What a robots/<name>/robot.toml may say, and where robots and their URDFs are found."""

import importlib.metadata
import tomllib
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slomo.errors import InvalidData, UsageError

QUADRUPED_LIMBS = ("front_left", "front_right", "hind_left", "hind_right")
HUMANOID_LIMBS = ("left_toe", "left_heel", "right_toe", "right_heel", "left_hand", "right_hand")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class UrdfSection(_Strict):
    """`path` is inside the data of the installed `package`, or without one relative to the robot.toml."""

    path: str
    package: str | None = None


class FramesSection(_Strict):
    base: str


class LimbSection(_Strict):
    """One limb: link of its hip, link of its foot, and where in it the contact point is (`offset`, m, link frame).

    `foot_radius` (m) only where the URDF has no collision sphere about that point; with an offset it is 0 then, a point
    on the sole. `foot_mass` (kg) only to overrule [point_foot].
    """

    name: str
    hip: str
    foot: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    foot_radius: float | None = Field(default=None, ge=0)
    foot_mass: float | None = Field(default=None, gt=0)


class PointFootSection(_Strict):
    """`foot_mass` (kg) of every limb; without it, what the limb weighs at its end when it swings about its hip."""

    foot_mass: float | None = Field(default=None, gt=0)


class RobotFile(_Strict):
    """The whole file. Keys of joint tables and entries of `locked` are joint names, `*` matches any part of one.

    `locked` joints stay at zero. `limits`, `effort` (N m) and `velocity` (rad/s) tighten what the URDF says. For the
    motors' model: `rotor_inertia` (kg m2, as seen at the joint), `knee_speed` (rad/s, up to which all of the effort is
    there).
    """

    name: str
    kind: Literal["quadruped", "humanoid"]
    urdf: UrdfSection
    frames: FramesSection
    limbs: list[LimbSection] = Field(min_length=1)
    nominal: dict[str, float]
    limits: dict[str, tuple[float, float]] = {}
    effort: dict[str, float] = {}
    velocity: dict[str, float] = {}
    rotor_inertia: dict[str, float] = {}
    knee_speed: dict[str, float] = {}
    locked: list[str] = []
    point_foot: PointFootSection = PointFootSection()


def robot_folders() -> dict[str, Path]:
    """Name -> robot.toml, from the checkout's robots/ or from the installed package."""
    here = Path(__file__).parent
    roots = (here / "robots", here.parents[1] / "robots")
    return {f.parent.name: f for root in roots for f in sorted(root.glob("*/robot.toml"))}


def find_robot_file(name_or_path: str) -> Path:
    """Path of the robot.toml that is meant. Raises `UsageError` listing the known names."""
    known = robot_folders()
    if name_or_path in known:
        return known[name_or_path]
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.suffix == ".toml":
        raise UsageError("no such file", where=name_or_path, todo="give a robot.toml or a known name")
    raise UsageError(
        f"no robot named {name_or_path!r}", where="--robot", valid=sorted(known), todo="or give a path to a robot.toml"
    )


def read_robot_file(path: Path) -> RobotFile:
    """Parse and check. Raises `InvalidData` naming the first wrong entry."""
    try:
        data = tomllib.loads(path.read_text())
        parsed = RobotFile.model_validate(data)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InvalidData(f"is not TOML: {e}", where=path) from None
    except ValidationError as e:
        first = e.errors()[0]
        raise InvalidData(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", where=path) from None
    names = tuple(limb.name for limb in parsed.limbs)
    if len(set(names)) != len(names):
        raise InvalidData("limb names repeat", where=path)
    valid = QUADRUPED_LIMBS if parsed.kind == "quadruped" else HUMANOID_LIMBS
    if names != valid:
        raise InvalidData(f"limbs of a {parsed.kind} are {names}", where=path, valid=valid)
    return parsed


def find_urdf(section: UrdfSection, robot_file: Path) -> tuple[Path, tuple[Path, ...]]:
    """The URDF's path and the folders in which its package:// addresses are looked up."""
    if section.package is None:
        urdf = (robot_file.parent / section.path).resolve()
        if not urdf.is_file():
            raise InvalidData(f"urdf.path {section.path!r} is not a file", where=robot_file)
        return urdf, (urdf.parent, *urdf.parents[1:4])
    try:
        files = importlib.metadata.files(section.package) or []
    except importlib.metadata.PackageNotFoundError:
        raise InvalidData(
            f"the package {section.package!r} is not installed", where=robot_file, todo=f"pip install {section.package}"
        ) from None
    for f in files:
        if str(f).endswith(f"share/{section.package}/package.xml"):
            root = Path(str(f.locate())).resolve().parent
            if (root / section.path).is_file():
                return root / section.path, (root.parent,)
    raise InvalidData(f"{section.path!r} is not in the package {section.package!r}", where=robot_file)


def key_point_names(limbs: tuple[str, ...]) -> tuple[str, ...]:
    """`<limb>_foot` of a quadruped's limbs; a humanoid's (left_toe, ...) are named after the point itself."""
    return limbs if limbs == HUMANOID_LIMBS else tuple(f"{limb}_foot" for limb in limbs)


def find_mesh(address: str, urdf: Path, package_dirs: tuple[Path, ...]) -> Path:
    """File behind a mesh address of the URDF. Raises `InvalidData` when there is none."""
    relative = address.removeprefix("package://").lstrip("/")
    for folder in (*package_dirs, urdf.parent):
        if (folder / relative).is_file():
            return folder / relative
    raise InvalidData(f"mesh {address!r} not found", where=urdf, valid=package_dirs)
