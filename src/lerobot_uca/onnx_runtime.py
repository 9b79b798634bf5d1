"""Networks as ONNX Runtime computes them on a CPU: the fast path of inference, and what `lerobot-uca-export` writes.

A step of a small network is mostly Python, small operations and reading weights. ONNX Runtime has none of the first,
merges the second, computes once what does not depend on the inputs (the tokens of t = h = 1), and comes as a wheel, so
that no compiler is needed.
"""

import io
import warnings
from collections.abc import Callable, Sequence

import onnxruntime
import torch
from torch import Tensor, nn

OPSET = 17  # the first with LayerNormalization

Function = Callable[..., tuple[Tensor, ...]]
"""function(network, *inputs)."""


class OnnxFunction:
    """A function of a network and of tensors, computed by ONNX Runtime instead of PyTorch.

    The network is traced, which takes about a second, when it is first called with inputs of new shapes, and again
    when its first or last weight was changed in place. The trace holds for all values of the inputs: the function must
    not branch on them.

    One thread computes a sample: two make a network of the default size a fifth faster and a small one slower, and
    where others use the cores, one waits for the other.

    Args:
        eager: function(network, *inputs) in PyTorch: what is traced, and the reference. Returns a tuple.
    """

    def __init__(self, eager: Function) -> None:
        self.eager = eager
        self._network: nn.Module | None = None
        self._watched: list[Tensor] = []
        self._versions: list[int] = []
        self._sessions: dict[tuple[torch.Size, ...], onnxruntime.InferenceSession] = {}

    def __reduce__(self) -> tuple[type["OnnxFunction"], tuple[Function]]:
        return OnnxFunction, (self.eager,)  # sessions can be neither copied nor sent to another process

    def __call__(self, network: nn.Module, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The same as `eager(network, *inputs)` up to rounding. Inputs are float32, the first dimension is the batch.

        PyTorch computes on other devices than the CPU and while the network is trained.
        """
        if network.training or inputs[0].device.type != "cpu":
            return self.eager(network, *inputs)
        if network is not self._network or self._versions != [weight._version for weight in self._watched]:
            self._network = network
            # Two weights stand for all: averaging and loading change them together, and to look at a hundred takes 5 %
            # of a small network's time. Those made in inference mode have no version: nothing trains them.
            weights = [weight for weight in network.parameters() if not weight.is_inference()]
            self._watched = [*weights[:1], *weights[-1:]]
            self._versions = [weight._version for weight in self._watched]
            self._sessions.clear()
        shapes = tuple(tensor.shape for tensor in inputs)
        if shapes not in self._sessions:
            names = [f"input_{index}" for index in range(len(inputs))]
            model = to_onnx(self.eager, network, shapes, names)
            self._sessions[shapes] = _open(model, n_threads=min(len(inputs[0]), torch.get_num_threads()))
        feeds = {f"input_{index}": tensor.numpy() for index, tensor in enumerate(inputs)}
        return tuple(map(torch.from_numpy, self._sessions[shapes].run(None, feeds)))


def to_onnx(
    function: Callable[..., Tensor | tuple[Tensor, ...]],
    network: nn.Module,
    input_shapes: Sequence[Sequence[int]],
    input_names: Sequence[str],
    output_names: Sequence[str] = (),
) -> bytes:
    """function(network, *inputs) of float32 inputs of the given shapes as an ONNX model."""
    file = io.BytesIO()
    # LeRobot calls policies in inference mode and under autocast; a trace must know neither.
    with torch.inference_mode(False), torch.no_grad(), torch.autocast("cpu", enabled=False), warnings.catch_warnings():
        # PyTorch's newer exporter takes ten times as long and needs one more package; the older one warns of its age
        # and of sizes becoming constants, which they are.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Function(function, network),
            tuple(torch.zeros(*shape) for shape in input_shapes),
            file,  # type: ignore[arg-type]  # a file in memory will do
            dynamo=False,
            opset_version=OPSET,
            input_names=list(input_names),
            output_names=list(output_names),
        )
    return file.getvalue()


class _Function(nn.Module):
    """What the exporter takes: a module."""

    def __init__(self, function: Callable[..., Tensor | tuple[Tensor, ...]], network: nn.Module) -> None:
        super().__init__()
        self.function = function
        self.network = network
        self.training = network.training  # the exporter sets both to what this one was

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        return self.function(self.network, *inputs)


def _open(model: bytes, n_threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    # Between calls the cores belong to others, to the simulator for example.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
