"""A device that is not the CPU, for machines that have no other: tensors that say they are elsewhere, with their numbers here.

Every operation is computed on the CPU, so results are the CPU's to the bit. But an operation on tensors of both places
raises, as it would between a CPU and a GPU, and so does handing a tensor that is elsewhere to numpy. The name that such
a tensor gives for its device is "meta", the one kind of device that PyTorch's autograd knows without any hardware.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

ELSEWHERE = torch.device("meta")
MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}  # the operations that may know both places


class Away(torch.Tensor):
    """A tensor that is elsewhere."""

    here: torch.Tensor  # its numbers

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> Away:
        return torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined, no-any-return]
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype, device=ELSEWHERE
        )

    def __init__(self, here: torch.Tensor) -> None:
        self.here = here

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Away({self.here!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


@contextmanager
def elsewhere() -> Iterator[None]:
    """Within this, what is asked to be made on or moved to ELSEWHERE is there."""
    with _Operations(), _Literals():
        yield


class _Operations(TorchDispatchMode):
    """Sees every operation of ATen, those that make tensors from nothing among them."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


class _Literals(TorchFunctionMode):
    """Sees `torch.tensor`, which makes tensors below ATen."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is torch.tensor and kwargs.get("device") is not None:
            return func(*args, **{**kwargs, "device": None}).to(kwargs["device"])
        return func(*args, **kwargs)


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation of ATen, in the place where its tensors are."""
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    away = any(isinstance(x, Away) for x in tensors)
    # A tensor of one number may be on the CPU, as everywhere in PyTorch.
    strays = [x for x in tensors if not isinstance(x, Away) and x.dim() > 0]
    if away and strays and func not in MOVES:
        raise RuntimeError(
            f"{func}: got tensors of shapes {[tuple(x.shape) for x in strays]} on the CPU among others elsewhere"
        )
    if (device := kwargs.get("device")) is not None:
        away = torch.device(device) == ELSEWHERE
        kwargs = {**kwargs, "device": torch.device("cpu")}
    elif func is torch.ops.aten.copy_.default:
        away = isinstance(args[0], Away)
    bare = tree_map(lambda x: x.here if isinstance(x, Away) else x, (args, kwargs))
    out = func(*bare[0], **bare[1])
    if not away:
        return out
    inplace = [x for x in tensors if isinstance(x, Away)]
    return tree_map(lambda x: wrapped(x, inplace) if isinstance(x, torch.Tensor) else x, out)


def wrapped(result: torch.Tensor, given: list[Away]) -> Away:
    """A result as a tensor elsewhere; the given one itself where the operation changed it in place."""
    return next((x for x in given if x.here is result), Away(result))
