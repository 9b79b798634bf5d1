"""Networks as OpenVINO or ONNX Runtime compute them on a CPU: the fast path of inference.

A step of a small network is mostly Python, small operations and reading weights. These runtimes have none of the first,
merge the second, compute once what does not depend on the inputs (the tokens of t = h = 1), and come as wheels, so
that no compiler is needed. Both read the ONNX model that PyTorch's tracing makes, which is also what
`lerobot-uca-export` writes.
"""

import io
import logging
import threading
import warnings
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Sequence
from textwrap import shorten
from typing import ClassVar

import torch
from torch import Tensor, nn

from lerobot_uca.inference.backends import Function

logger = logging.getLogger(__name__)

OPSET = 17  # the first with LayerNormalization
WEIGHTS_PER_THREAD = 900_000
"""A second thread pays from about twice so many weights, those of all samples of a batch counted together."""
MAX_TRACES = 4
"""Traces of a function, for the shapes used last: each one holds 10 to 20 MB and threads of its own."""

_exporter = threading.Lock()
"""PyTorch's exporter keeps its state in globals."""

Run = Callable[[Sequence[Tensor]], tuple[Tensor, ...]]
"""A trace, opened by a runtime: float32 inputs to results."""


class TracedFunction(ABC):
    """A function of a network and of tensors, computed by a runtime instead of PyTorch.

    The network is traced, which takes about a second, when it is first called with inputs of new shapes, and again
    when a weight was changed in place or replaced (`_Weights`). The trace holds for all values of the inputs: the
    function must not branch on them. The runtime's results are compared with PyTorch's once; where they differ or the
    runtime fails, PyTorch goes on. Each thread needs a function of its own.

    Args:
        eager: function(network, *inputs) in PyTorch: what is traced, and the reference. Returns a tuple.
    """

    runtime: ClassVar[str]
    tolerance: ClassVar[float] = 1e-4
    """Largest difference from PyTorch's results, as a share of the largest, or of 1 where all are smaller: normalised
    actions reach 1, also those of a policy that holds still in the test's random scene. float32 rounds far below."""

    def __init__(self, eager: Function) -> None:
        self.eager = eager
        self._network: nn.Module | None = None
        self._weights: _Weights | None = None
        self._traces: OrderedDict[tuple[torch.Size, ...], Run] = OrderedDict()  # the latest used one is the last
        self._has_said = False

    def __reduce__(self) -> tuple[type["TracedFunction"], tuple[Function]]:
        return type(self), (self.eager,)  # traces can be neither copied nor sent to another process

    @abstractmethod
    def open(self, model: bytes, input_shapes: Sequence[torch.Size], n_threads: int) -> Run:
        """Open an ONNX model, whose inputs are in order."""

    def __call__(self, network: nn.Module, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The same as `eager(network, *inputs)` up to rounding. Inputs are float32, the first dimension is the batch.

        PyTorch computes on other devices than the CPU, while the network is trained, and an empty batch, for which
        the runtimes end the process.
        """
        if network.training or inputs[0].device.type != "cpu" or not len(inputs[0]):
            return self.eager(network, *inputs)
        if network is not self._network or self._weights is None or self._weights.have_changed():
            self._network, self._weights = network, _Weights(network)
            self._traces.clear()
        shapes = tuple([tensor.shape for tensor in inputs])
        run = self._traces.get(shapes)
        if run is None:
            if len(self._traces) == MAX_TRACES:
                self._traces.popitem(last=False)
                self._say_that_shapes_change(shapes)
            run = self._traces[shapes] = self._trace(network, shapes)
        elif len(self._traces) > 1:
            self._traces.move_to_end(shapes)
        return run(inputs)

    def _say_that_shapes_change(self, shapes: Sequence[torch.Size]) -> None:
        if not self._has_said:
            self._has_said = True
            logger.warning(
                "%s prepares itself anew, which takes about half a second, for each new shape of the inputs, and keeps "
                "%d; the last: %s. policy.n_points makes clouds uniform, policy.inference=eager takes any shape.",
                *(self.runtime, MAX_TRACES, [tuple(shape) for shape in shapes]),
            )

    def _trace(self, network: nn.Module, shapes: Sequence[torch.Size]) -> Run:
        model = to_onnx(self.eager, network, shapes, [f"input_{index}" for index in range(len(shapes))])
        n_weights = sum(weight.numel() for weight in network.parameters())
        n_threads = max(1, min(torch.get_num_threads(), n_weights * shapes[0][0] // WEIGHTS_PER_THREAD))

        def in_pytorch(inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            with torch.no_grad(), torch.autocast("cpu", enabled=False):  # as exact as a runtime
                return self.eager(network, *inputs)

        generator = torch.Generator().manual_seed(0)
        inputs = [torch.rand(shape, generator=generator) for shape in shapes]
        expected = in_pytorch(inputs)
        if not all(bool(values.isfinite().all()) for values in expected):  # weights that diverged; no runtime's fault
            return in_pytorch
        try:
            run = self.open(model, shapes, n_threads)
            results = run(inputs)
        except Exception as error:  # noqa: BLE001  (each runtime has errors of its own, for a missing instruction say)
            problem = f"failed ({shorten(str(error), 200)})"
        else:
            if all(map(self._is_close, results, expected)):
                return run
            problem = "computes something else than PyTorch on this machine"
        logger.warning("%s %s; PyTorch is used.", self.runtime, problem)
        return in_pytorch

    def _is_close(self, result: Tensor, expected: Tensor) -> bool:
        return bool((result - expected).abs().max() <= self.tolerance * max(1.0, float(expected.abs().max())))


class _Weights:
    """A network's weights, to notice when one is changed in place or replaced, by `weight.data = ...` for example.

    All are looked at, in every call, but not their values, which would take as long as the network. So what changes
    weights in place without a trace stays unnoticed: `weight.data.copy_(...)` and others by way of `.data` or
    `.numpy()`, and PyTorch's fused optimisers (so the policies compute with averaged weights); and a whole submodule
    that is replaced.
    """

    def __init__(self, network: nn.Module) -> None:
        self._owners = [module._parameters for module in network.modules() if module._parameters]
        self._seen = self._look()
        # While a storage is kept, no other one has its address.
        self._kept = [weight.detach() for weight in network.parameters()]

    def have_changed(self) -> bool:
        """Whether any weight is not what it was."""
        return self._look() != self._seen

    def _look(self) -> list[tuple[int, int]]:
        """Address and changes in place of each weight; in one pass, since the cache holds none of them by now."""
        weights = [weight for owner in self._owners for weight in owner.values() if weight is not None]
        try:
            return [(weight.data_ptr(), weight._version) for weight in weights]
        except RuntimeError:  # weights made in inference mode count no changes: nothing trains them
            return [(weight.data_ptr(), 0 if weight.is_inference() else weight._version) for weight in weights]


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
    with (
        _exporter,
        torch.inference_mode(False),
        torch.no_grad(),
        torch.autocast("cpu", enabled=False),
        warnings.catch_warnings(),
    ):
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
    """A function as the module that the exporter needs."""

    def __init__(self, function: Callable[..., Tensor | tuple[Tensor, ...]], network: nn.Module) -> None:
        super().__init__()
        self.function = function
        self.network = network
        self.training = network.training  # the exporter sets both to what this one was

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        return self.function(self.network, *inputs)
