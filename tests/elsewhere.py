"""A second device for tests on machines without a GPU: tensors that compute on the CPU and say that they are on "meta".

As on a GPU, nothing that is there mixes with what is not: an operation of both raises, but for numbers (tensors without
axes) and for CPU indices into what is there. Values are real, so results can be compared.
"""

from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
_INDEXED = {torch.ops.aten.index.Tensor, torch.ops.aten.index_put.default, torch.ops.aten.index_put_.default,
            torch.ops.aten._index_put_impl_.default}  # fmt: skip


class _There(torch.Tensor):
    """`held` is the CPU tensor with the values."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, real: torch.Tensor):
        out = torch.Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls, real.shape, strides=real.stride(), storage_offset=real.storage_offset(), dtype=real.dtype,
            device=DEVICE, requires_grad=False,
        )  # fmt: skip
        out.held = real
        return out

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise AssertionError(f"{func} outside of `Elsewhere`")


class _Numbers(TorchFunctionMode):
    """Tensors that are made of Python's numbers there, whose values the dispatcher never sees."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None):
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.new_tensor and args[0].device == DEVICE:
            kwargs = dict(dtype=args[0].dtype, device=DEVICE) | kwargs
            func, args = torch.tensor, args[1:]
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu") == DEVICE:
            return func(*args, **kwargs | dict(device="cpu")).to(DEVICE)
        if func is torch.Tensor.tolist and isinstance(args[0], _There):
            args = (args[0].held,)
        return func(*args, **kwargs)


class Elsewhere(TorchDispatchMode):
    """Within it the device "meta" holds values. Counts operations there in `count`."""

    count = 0

    def __enter__(self):
        self._numbers = _Numbers()
        self._numbers.__enter__()
        return super().__enter__()

    def __exit__(self, *reason: Any):
        super().__exit__(*reason)
        self._numbers.__exit__(*reason)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None):
        kwargs = dict(kwargs or {})
        asked = kwargs.get("device")
        flat = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
        there = [x for x in flat if isinstance(x, _There)]
        if func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default):
            pass  # moves
        elif func in _INDEXED:
            assert not there or isinstance(args[0], _There), f"{func}: indices on the device, values on the CPU"
            values = [x for x in args[2:] if isinstance(x, torch.Tensor) and x.dim()]
            assert all(isinstance(x, _There) == isinstance(args[0], _There) for x in values), f"{func}: of both devices"
        elif there:
            gathers = any(k in str(func) for k in ("cat", "stack", "gather", "index", "scatter", "where"))
            here = [tuple(x.shape) for x in flat if not isinstance(x, _There) and (x.dim() or gathers)]
            assert not here, f"{func}: of both devices, CPU {here}"
        if asked is not None:
            kwargs["device"] = torch.device("cpu")
        real = lambda x: x.held if isinstance(x, _There) else x  # noqa: E731
        out = func(*tree_map(real, args), **tree_map(real, kwargs))
        if func is torch.ops.aten.copy_.default:
            return args[0]
        stays = bool(there) if asked is None else torch.device(asked) == DEVICE
        self.count += stays
        if not stays:
            return out
        same = {id(real(x)): x for x in there}  # in place
        return tree_map(lambda x: (same[id(x)] if id(x) in same else _There(x)) if _is_tensor(x) else x, out)


def _is_tensor(x: Any) -> bool:
    return isinstance(x, torch.Tensor)
