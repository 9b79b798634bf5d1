"""`lerobot-uca-edit-dataset`: LeRobot's `lerobot-edit-dataset` for datasets with point clouds.

LeRobot edits datasets as pandas tables, and Hugging Face's `datasets` (4.8) gives pandas arrays of two and more
dimensions that can neither be compared nor written. LeRobot's own command loads no plugin that could mend it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from datasets.features import features as hf_features
from datasets.features.features import PandasArrayExtensionArray, PandasArrayExtensionDtype

from lerobot_uca.errors import reported


def let_pandas_hold_arrays() -> None:
    """Complete the pandas type of `datasets`: it can be compared, made from its name, joined and turned into Arrow."""
    PandasArrayExtensionDtype._metadata = ("value_type",)  # a string there is taken letter by letter
    PandasArrayExtensionDtype.construct_from_string = classmethod(_dtype_from_name)
    PandasArrayExtensionArray._concat_same_type = classmethod(_join)
    PandasArrayExtensionArray.__arrow_array__ = _to_arrow
    pd.api.extensions.register_extension_dtype(PandasArrayExtensionDtype)


def _dtype_from_name(cls: type[PandasArrayExtensionDtype], name: str) -> PandasArrayExtensionDtype:
    """The type whose name is such as 'array[float32]', which Parquet files remember."""
    if not (isinstance(name, str) and name.startswith("array[") and name.endswith("]")):
        raise TypeError(f"A type's name must be 'array[...]', got {name!r}.")  # pandas then asks the next type
    return cls(np.dtype(name.removeprefix("array[").removesuffix("]")))


def _join(
    cls: type[PandasArrayExtensionArray], parts: Sequence[PandasArrayExtensionArray]
) -> PandasArrayExtensionArray:
    """One array of several, also of different lengths."""
    return cls(np.concatenate([part._data for part in parts]))


def _to_arrow(self: PandasArrayExtensionArray, type: pa.DataType | None = None) -> pa.Array:  # noqa: A002, ARG001
    """Arrays (R, ...) as Arrow's lists of lists; called by pyarrow."""
    values: np.ndarray[Any, Any] = np.asarray(self._data)
    storage = pa.array(values.reshape(-1))
    for size in reversed(values.shape[1:]):
        storage = pa.ListArray.from_arrays(np.arange(0, len(storage) + 1, size, dtype=np.int32), storage)
    kind = getattr(hf_features, f"Array{values.ndim - 1}DExtensionType")(values.shape[1:], str(values.dtype))
    return pa.ExtensionArray.from_storage(kind, storage.cast(kind.storage_type))


def run() -> None:
    """LeRobot's command.

    Raises:
        UserError: if it fails, with its own reason.
    """
    from lerobot.scripts.lerobot_edit_dataset import main

    let_pandas_hold_arrays()
    with reported("The dataset could not be edited"):
        main()
