"""Where the fields are computed: on the CPU, or on a GPU that PyTorch finds.

Only what the fields look at goes there: a rendering and its networks are all but a percent of the arithmetic of the
published sizes. Kinematics, silhouette and physics stay on the CPU, where their small arrays and compiled loops are.
"""

import copy
import dataclasses
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import torch

from slomo.errors import UsageError
from slomo.reconstruct.kinematics import Kinematics

T = TypeVar("T")

AUTO = "auto"
CPU = torch.device("cpu")
VALID = (AUTO, "cpu", "cuda", "cuda:N")


def check(name: str) -> None:
    """Raise UsageError unless `name` is one of `VALID`."""
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise UsageError(f"no device {name!r}", where="device", valid=VALID)


def find(name: str) -> torch.device:
    """The device of that name; "auto" is a GPU where there is one.

    Raises:
        UsageError: PyTorch finds no such GPU.
    """
    found = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == AUTO:
        return torch.device("cuda" if found else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= found:
        seen = f"finds {found} GPU{'s' if found > 1 else ''}" if found else "finds no GPU"
        built = "" if torch.version.cuda else ", and is built without CUDA: docs/fields.md says which build has it"
        raise UsageError(f"{name}: PyTorch {seen}{built}", where="device", todo="take auto or cpu")
    return device


def on(x: T, device: torch.device) -> T:
    """`x` with all tensors in it on the device: tensors, dataclasses, mappings, sequences, and a skeleton's tables."""
    return _on(x, device)


def _on(x: Any, device: torch.device) -> Any:
    if isinstance(x, torch.Tensor):
        return x.to(device)
    if isinstance(x, Mapping):
        return {k: _on(v, device) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return type(x)(_on(v, device) for v in x)
    if isinstance(x, Kinematics):
        moved = copy.copy(x)
        vars(moved).update({k: _on(v, device) for k, v in vars(x).items() if k != "skeleton"})
        return moved
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return dataclasses.replace(x, **{f.name: _on(getattr(x, f.name), device) for f in dataclasses.fields(x)})
    return x
