"""Inference backends, selected by `policy.inference`. Configurations know names; an engine loads when it is chosen."""

import importlib
import logging
from collections.abc import Callable

from torch import Tensor

logger = logging.getLogger(__name__)

Function = Callable[..., tuple[Tensor, ...]]
"""function(network, *inputs)."""

EAGER = "eager"
ENGINES = {
    "openvino": ("openvino_function", "OpenVinoFunction"),
    "openvino_bfloat16": ("openvino_function", "BFloat16Function"),
    "onnxruntime": ("onnxruntime_function", "OnnxFunction"),
    "compile": ("compiled", "CompiledFunction"),
}
"""Module and class of each backend; they compute a function of a network and of tensors, as PyTorch does."""
BACKENDS = (EAGER, *ENGINES)
OF_ANY_DEVICE = (EAGER, "compile")
"""The others compute on a CPU; elsewhere PyTorch does it for them."""

_warned: set[str] = set()


def make_backend(name: str) -> Callable[[Function], Function]:
    """The class that computes a PyTorch function; PyTorch itself, with one warning, without the engine's package.

    Args:
        name: one of `BACKENDS`.
    """
    if name == EAGER:
        return lambda function: function
    module, engine = ENGINES[name]
    try:
        return getattr(importlib.import_module(f"{__package__}.{module}"), engine)
    except ImportError as error:
        if name not in _warned:
            _warned.add(name)
            package = (error.name or "openvino").partition(".")[0]
            extra = "'lerobot_policy_uca_flow[openvino]'"  # with the versions that this package works with
            logger.warning(
                "policy.inference=%s needs the package %s, which is not installed; PyTorch is used, which is slower. "
                "To install it: pip install %s",
                name,
                error.name or error,
                extra if package == "openvino" else package,
            )
        return make_backend(EAGER)
