"""Where the fields are computed: on the CPU, or on a GPU that PyTorch finds.

Only what the fields look at goes there: a rendering and its networks are all but a percent of the arithmetic of the
published sizes. Kinematics, silhouette and physics stay on the CPU, where their small arrays and compiled loops are.
"""

import copy
import dataclasses
import os
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import torch

from slomo.errors import UsageError
from slomo.reconstruct.kinematics import Kinematics

T = TypeVar("T")

CPU = torch.device("cpu")
VARIABLE = "SLOMO_DEVICE"  # of the environment: where it runs changes no more than rounding, so no parameter says it
VALID = ("auto", "cpu", "cuda", "cuda:N")


def find(large: bool) -> torch.device:
    """The device that `SLOMO_DEVICE` names; by default a GPU where there is one and the networks are large.

    Raises:
        UsageError: no such name, or PyTorch finds no such GPU.
    """
    name = os.environ.get(VARIABLE) or "auto"
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise UsageError(f"no device {name!r}", where=VARIABLE, valid=VALID)
    found = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda" if found and large else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= found:
        seen = f"finds {found} GPU{'s' if found > 1 else ''}" if found else "finds no GPU"
        built = "" if torch.version.cuda else ", and is built without CUDA: docs/fields.md says which build has it"
        raise UsageError(f"{name}: PyTorch {seen}{built}", where=VARIABLE, todo="take auto or cpu")
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
