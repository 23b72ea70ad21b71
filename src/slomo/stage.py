"""What every stage takes and returns.

A stage is a pure function `run(inputs, config, progress) -> Artifact` in `<stage>/stage.py`, beside its `Config` (a
frozen dataclass of every parameter that can change the result) and its integer `VERSION` (raise it when the same
inputs give another result). It never touches the store, the terminal, the network or a global.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from slomo.robot import Robot

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Artifact:
    """What a stage produced, in memory; the store writes each entry as one file.

    Attributes:
        npz: file name -> arrays (`{"keypoints.npz": {...}}`).
        json: file name -> JSON object (`{"report.json": {...}}`).
        blobs: file name -> bytes (pictures, videos).
        failure: None, or why the result is not usable: it is published for inspection, and the exit code is 1.
    """

    npz: Mapping[str, Arrays] = field(default_factory=dict)
    json: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    blobs: Mapping[str, bytes] = field(default_factory=dict)
    failure: str | None = None


@dataclass(frozen=True)
class Inputs:
    """What a stage reads, all of it digested by content into the artifact's key.

    Attributes:
        artifacts: upstream stage name -> its artifact.
        files: role -> path of a user's file or folder ("clip", "masks", "weights", "skeleton", "keypoints").
        robot: the robot, for the stages that need one.
    """

    artifacts: Mapping[str, Artifact] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    robot: "Robot | None" = None


class Progress(Protocol):
    """How a stage reports and survives interruption. `Silent` is the one for tests and library use."""

    def update(self, fraction: float, message: str = "") -> None:
        """Say that `fraction` in [0, 1] is done. Raises `Interrupted` when a signal has come in."""
        ...

    def note(self, message: str) -> None:
        """Say something that the user must see once: the method that really runs, a decision taken."""
        ...

    def checkpoint_due(self) -> bool:
        """True every 30 s at the latest, and when a signal has come in."""
        ...

    def save(self, state: Arrays) -> None:
        """Write a checkpoint atomically. Raises `Interrupted` afterwards when a signal has come in."""
        ...

    def load(self) -> Arrays | None:
        """The newest whole checkpoint of this very key, or None."""
        ...


class Silent:
    """Progress that goes nowhere."""

    def update(self, fraction: float, message: str = "") -> None: ...

    def note(self, message: str) -> None: ...

    def checkpoint_due(self) -> bool:
        return False

    def save(self, state: Arrays) -> None: ...

    def load(self) -> Arrays | None:
        return None
