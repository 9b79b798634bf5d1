"""Traced networks, computed by OpenVINO."""

from collections.abc import Sequence
from typing import ClassVar, override

import numpy as np
import openvino
import torch
from torch import Tensor

from lerobot_uca.inference.traced import Run, TracedFunction


class OpenVinoFunction(TracedFunction):
    """Computed by OpenVINO."""

    runtime = f"OpenVINO {openvino.__version__}"
    precision: ClassVar[str] = "f32"

    @override
    def open(self, model: bytes, input_shapes: Sequence[torch.Size], n_threads: int) -> Run:
        core = openvino.Core()
        has_bfloat16 = "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        settings = {
            "INFERENCE_PRECISION_HINT": self.precision if has_bfloat16 else "f32",
            "INFERENCE_NUM_THREADS": n_threads,
            "NUM_STREAMS": 1,
            # Its fused attention gives wrong numbers where fewer tokens ask than answer, as in the last block (2025.4
            # and 2026.4); the operations one by one take as long.
            "SNIPPETS_MODE": "DISABLE",
        }
        request = core.compile_model(core.read_model(model), "CPU", settings).create_infer_request()
        held = [np.empty(shape, np.float32) for shape in input_shapes]
        for index, array in enumerate(held):
            request.set_input_tensor(index, openvino.Tensor(array, shared_memory=True))
        results = [tensor.data for tensor in request.output_tensors]

        def run(inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            # NumPy copies: a thread that PyTorch has just used would spin on the core that OpenVINO's second one needs.
            for array, tensor in zip(held, inputs, strict=True):
                np.copyto(array, tensor.numpy())
            request.infer(share_outputs=True)
            return tuple(torch.from_numpy(result.copy()) for result in results)  # the next call overwrites them

        return run


class BFloat16Function(OpenVinoFunction):
    """Computed by OpenVINO in bfloat16 where the processor has instructions for it: less exact, faster."""

    precision = "bf16"
    tolerance = 0.05
