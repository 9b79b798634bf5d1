"""Traced networks, computed by ONNX Runtime."""

from collections.abc import Sequence
from typing import override

import onnxruntime
import torch
from torch import Tensor

from lerobot_uca.inference.traced import Run, TracedFunction


class OnnxFunction(TracedFunction):
    """Computed by ONNX Runtime."""

    runtime = f"ONNX Runtime {onnxruntime.__version__}"

    @override
    def open(self, model: bytes, input_shapes: Sequence[torch.Size], n_threads: int) -> Run:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = n_threads
        # Between calls the cores belong to others, to the simulator for example.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        options.log_severity_level = 3
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        names = [tensor.name for tensor in session.get_inputs()]

        def run(inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            feeds = {name: tensor.numpy() for name, tensor in zip(names, inputs, strict=True)}
            return tuple(map(torch.from_numpy, session.run(None, feeds)))

        return run
