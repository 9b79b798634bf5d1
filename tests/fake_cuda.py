"""Tensors that say they are on a GPU and are computed on the CPU, as mixing devices shows without one.

As on a GPU, an operation on tensors of both devices is an error, and NumPy cannot read what is on the GPU.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

aten = torch.ops.aten
COPIES = (aten.copy_.default, aten._to_copy.default)
INDEXED = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default)
CUDA = torch.device("cuda:0")


class OnGpu(Tensor):
    """A tensor of the device cuda:0 whose values are a CPU tensor."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> Self:
        same = {"strides": values.stride(), "storage_offset": values.storage_offset(), "dtype": values.dtype}
        self = torch.Tensor._make_wrapper_subclass(cls, values.size(), device=CUDA, **same)
        self.values = values
        return self

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(function, args, kwargs or {})

    # What PyTorch does for a tensor of the GPU before it asks what it is.

    def tolist(self) -> Any:
        return self.values.tolist()

    def new_tensor(self, data: Any, **kwargs: Any) -> "OnGpu":  # type: ignore[override]
        return OnGpu(self.values.new_tensor(data, **kwargs))

    def __getitem__(self, index: Any) -> Any:
        return super().__getitem__(_indices(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_indices(index), value)

    def __repr__(self, **_: Any) -> str:
        return f"OnGpu({self.values})"


class _MadeThere(TorchDispatchMode):
    """Lets `torch.zeros(3, device="cuda")` and its like make such tensors."""

    _mode_key = torch._C._TorchDispatchModeKey.FAKE

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(function, args, kwargs or {})


@contextmanager
def fake_cuda() -> Iterator[None]:
    """Within it devices named cuda are such tensors."""

    def made(make: Any) -> Any:
        def on_device(data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Tensor:
            if isinstance(data, OnGpu):
                return data
            return moved(make(data, *args, **kwargs)) if _is_gpu(device) else make(data, *args, device=device, **kwargs)

        return on_device

    torch._C._ensureCUDADeviceGuardSet()
    with (
        patch.object(torch, "tensor", made(torch.tensor)),
        patch.object(torch, "as_tensor", made(torch.as_tensor)),
        _MadeThere(),
    ):
        yield


def moved(tensor: Tensor) -> Tensor:
    """A copy on the GPU."""
    return OnGpu(tensor.detach().clone())


def move(network: nn.Module) -> None:
    """Put a network's parameters and buffers on the GPU."""
    for module in network.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                module._parameters[name] = nn.Parameter(moved(parameter), requires_grad=parameter.requires_grad)
        for name, buffer in module._buffers.items():
            module._buffers[name] = None if buffer is None else moved(buffer)


def _indices(index: Any) -> Any:
    if isinstance(index, tuple):
        return tuple(map(_indices, index))
    return moved(torch.tensor(index)) if isinstance(index, list) else index


def _is_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _compute(function: Any, args: Any, kwargs: Any) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    here = [leaf for leaf in tensors if not isinstance(leaf, OnGpu) and leaf.ndim]  # a number may be on the CPU
    to_gpu, is_there = _is_gpu(kwargs.get("device")), any(isinstance(leaf, OnGpu) for leaf in tensors)
    if not (is_there or to_gpu):
        return function(*args, **kwargs)
    if function in INDEXED and isinstance(args[0], OnGpu):
        here = [leaf for leaf in here if not any(leaf is index for index in args[1])]  # those are copied
    if is_there and here and function not in COPIES:
        raise RuntimeError(f"{function}: expected all tensors to be on the same device, cuda:0 and cpu")
    if function is aten._efficientzerotensor.default:
        function = aten.zeros.default
    values = lambda leaf: leaf.values if isinstance(leaf, OnGpu) else leaf  # noqa: E731
    plain = {**kwargs, **({"device": "cpu"} if to_gpu else {})}
    result = function(*tree_map(values, args), **tree_map(values, plain))
    leaves_gpu = "device" in kwargs and kwargs["device"] is not None and not to_gpu
    if function is aten.copy_.default:
        return args[0]
    if leaves_gpu or function is aten._local_scalar_dense.default:
        return result
    if function is aten._to_copy.default and not is_there:
        result = result.clone()
    wrapped = tree_map(lambda leaf: OnGpu(leaf) if isinstance(leaf, Tensor) else leaf, result)
    return return_and_correct_aliasing(function, args, kwargs, wrapped) if is_there else wrapped
