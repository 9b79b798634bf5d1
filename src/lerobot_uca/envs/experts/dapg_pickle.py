"""Reads the original pickles of DAPG's policies, without importing or running anything that they name.

They are instances of mjrl's `MLP` with PyTorch 0.3 or later inside. Stand-ins of our own replace what a pickle asks
for: PyTorch's tensors become NumPy arrays, everything else of mjrl, PyTorch and NumPy an inert record. A name
from elsewhere is refused, and so is a key that is itself made of values: hashing one takes as long as its author likes.
"""

import io
import pickle
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self, override

import numpy as np
from numpy.typing import NDArray

MAX_BYTES = 4 * 2**20
"""A policy has less; reading more would take long."""

TRANSFORMATIONS = ("in_shift", "in_scale", "out_shift", "out_scale")


def read_policy(path: Path) -> list[NDArray[np.float32]]:
    """W0, b0, W1, b1, W2, b2, in_shift, in_scale, out_shift, out_scale.

    Raises:
        pickle.UnpicklingError: if the pickle names what no such policy needs.
        Exception: of almost any kind, if the file is damaged or something else.
    """
    if path.stat().st_size > MAX_BYTES:
        raise pickle.UnpicklingError(f"it has more than {MAX_BYTES} bytes.")
    with path.open("rb") as file:
        policy = _PolicyUnpickler(file, encoding="latin1").load()
    parameters = [_array(parameter) for parameter in policy.trainable_params]
    return parameters[:6] + [_array(getattr(policy.model, name)) for name in TRANSFORMATIONS]


_Unpickler: Any = vars(pickle)["_Unpickler"]
"""The one written in Python: the other one cannot be told to look at keys before it hashes them."""


class _PolicyUnpickler(_Unpickler):
    dispatch: ClassVar[dict[int, Any]] = dict(_Unpickler.dispatch)

    @override
    def find_class(self, module: str, name: str) -> Any:
        stand_in = STAND_INS.get((module, name))
        if stand_in is not None:
            return stand_in
        if module.partition(".")[0] in ("mjrl", "torch", "numpy"):
            return type(name, (_Record,), {})
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no such policy needs, and is not run.")

    @override
    def persistent_load(self, pid: Any) -> Any:
        return _Record(pid)

    def _set_item(self) -> None:
        _check_keys(self.stack[-2:-1])
        self.load_setitem()

    def _set_items(self) -> None:
        _check_keys(self.stack[::2])
        self.load_setitems()

    def _add_items(self) -> None:
        _check_keys(self.stack)
        self.load_additems()

    def _make_dict(self) -> None:
        _check_keys(self.stack[::2])
        self.load_dict()

    def _make_frozenset(self) -> None:
        _check_keys(self.stack)
        self.load_frozenset()


for _code, _method in (
    (pickle.SETITEM, _PolicyUnpickler._set_item),
    (pickle.SETITEMS, _PolicyUnpickler._set_items),
    (pickle.ADDITEMS, _PolicyUnpickler._add_items),
    (pickle.DICT, _PolicyUnpickler._make_dict),
    (pickle.FROZENSET, _PolicyUnpickler._make_frozenset),
):
    _PolicyUnpickler.dispatch[_code[0]] = _method


def _check_keys(keys: Iterable[Any]) -> None:
    for key in keys:
        if not isinstance(key, str | bytes | int | float | None):
            raise pickle.UnpicklingError(f"it has a key of type {type(key).__name__}.")


def _set(values: Iterable[Any] = ()) -> set[Any]:
    values = list(values)
    _check_keys(values)
    return set(values)


def _dict(items: Iterable[Any] = ()) -> dict[Any, Any]:
    pairs = [tuple(item) for item in items]
    _check_keys(key for key, _ in pairs)
    return dict(pairs)


class _Record:
    """Stands for an object that is not needed, or of which only the attributes are."""

    def __new__(cls, *_: Any) -> Self:
        return super().__new__(cls)

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class _Variable(_Record):
    """PyTorch's Variable and Parameter: a tensor with a memory of gradients."""


def _array(tensor: Any) -> NDArray[np.float32]:
    for _ in range(3):  # a variable of a variable; one may also contain itself
        if isinstance(tensor, _Variable):
            tensor = tensor.arguments[0]
    if not isinstance(tensor, np.ndarray):
        raise pickle.UnpicklingError(f"it has {type(tensor).__name__} where a tensor must be.")
    return tensor


def _storage(values: Sequence[float]) -> NDArray[np.float32]:
    return np.array(values, dtype=np.float32)


def _storage_from_bytes(content: bytes) -> NDArray[np.float32]:
    import torch  # slow to import, and not needed where demonstrations run

    header = io.BytesIO(content)
    for _ in range(5):  # magic number, version, system, storage, its key; PyTorch would hash any keys
        _PolicyUnpickler(header).load()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that such storages are outdated
        return _storage(torch.load(io.BytesIO(content), weights_only=True, map_location="cpu").tolist())


def _tensor(
    storage: NDArray[np.float32], offset: int, size: Sequence[int], stride: Sequence[int], *_: Any
) -> NDArray[np.float32]:
    if np.prod(size, dtype=float) > len(storage):
        raise pickle.UnpicklingError(f"it has a tensor of size {tuple(size)} in a storage of {len(storage)} numbers.")
    index = np.full(size, offset)
    for axis, step in enumerate(stride):
        index += step * np.arange(size[axis]).reshape(-1, *[1] * (len(size) - axis - 1))
    return storage[index]


def _parameter(data: NDArray[np.float32], *_: Any) -> NDArray[np.float32]:
    return data


STAND_INS: dict[tuple[str, str], Callable[..., Any]] = {
    ("torch", "FloatStorage"): _storage,
    ("torch.storage", "_load_from_bytes"): _storage_from_bytes,
    ("torch._utils", "_rebuild_tensor"): _tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("torch.autograd.variable", "Variable"): _Variable,
    ("torch.nn.parameter", "Parameter"): _Variable,
    ("collections", "OrderedDict"): _dict,
    ("_codecs", "encode"): lambda text, _: text.encode("latin1"),
    ("builtins", "set"): _set,
    ("builtins", "getattr"): _Record,  # torch.tanh is written as an attribute of torch
}
# Python 2's names of the same.
STAND_INS |= {("__builtin__", name): STAND_INS["builtins", name] for name in ("set", "getattr")}
