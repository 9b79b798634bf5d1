"""`lerobot-uca-edit-dataset`: LeRobot's `lerobot-edit-dataset` for datasets with point clouds.

LeRobot edits datasets as pandas tables, and Hugging Face's `datasets` (4.8) gives pandas arrays of two and more
dimensions that can neither be compared nor written. LeRobot's own command loads no plugin that could mend it.
"""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from datasets.features import features as hf_features
from datasets.features.features import PandasArrayExtensionArray, PandasArrayExtensionDtype
from lerobot.datasets import aggregate
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_uca.errors import reported
from lerobot_uca.features import find_point_cloud
from lerobot_uca.point_clouds.recipe import RECIPE_INFO, CloudRecipe

logger = logging.getLogger(__name__)


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


def merge_whatever_the_recipe() -> None:
    """LeRobot merges datasets of equal features; the recipes of their clouds may differ, if not in their crop.

    A camera was calibrated anew between them, say. The merged clouds' recipe is the first dataset's, and how the others
    differ is said. Where one has none, or another crop or other images, none is left.
    """
    validate = aggregate.validate_all_metadata

    def validate_all_metadata(all_metadata: list[LeRobotDatasetMetadata]) -> Any:
        _unite_recipes(all_metadata)
        return validate(all_metadata)

    aggregate.validate_all_metadata = validate_all_metadata


def _unite_recipes(all_metadata: Sequence[LeRobotDatasetMetadata]) -> None:
    key = find_point_cloud(all_metadata[0].features)
    clouds = [meta.features.get(key) for meta in all_metadata]
    if key is None or None in clouds:
        return  # which LeRobot refuses
    infos = [cloud.get("info") or {} for cloud in clouds]
    others = [_without_recipe(info) for info in infos]
    if any(each != others[0] for each in others):  # which it refuses, too
        return
    recipes = [CloudRecipe.from_dict(info[RECIPE_INFO]) for info in infos if info.get(RECIPE_INFO)]
    united = infos[0]
    if len(recipes) == len(infos) and len({(each.keys, each.crop, each.n_points) for each in recipes}) == 1:
        for meta, recipe in zip(all_metadata, recipes, strict=True):
            if lines := recipes[0].differences(recipe):
                logger.warning("The merged recipe is the first dataset's. In '%s' %s.", meta.root, "; ".join(lines))
    elif recipes:
        united = others[0]
        reason = "the datasets' differ in crop, images or points" if len(recipes) == len(infos) else "not all have one"
        logger.warning("Not kept: the recipe of the clouds, as %s.", reason)
    for cloud in clouds:
        cloud["info"] = united


def _without_recipe(info: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in info.items() if name != RECIPE_INFO}


def run() -> None:
    """LeRobot's command.

    Raises:
        UserError: if it fails, with its own reason.
    """
    from lerobot.scripts.lerobot_edit_dataset import main

    let_pandas_hold_arrays()
    merge_whatever_the_recipe()
    with reported("The dataset could not be edited"):
        main()
