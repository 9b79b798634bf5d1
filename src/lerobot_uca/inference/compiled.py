"""Networks compiled by `torch.compile`, on a GPU with CUDA graphs."""

import logging
import threading
from textwrap import shorten
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch._dynamo.exc import FailOnRecompileLimitHit, ShortenTraceback

from lerobot_uca.errors import UserError
from lerobot_uca.inference.backends import Function

logger = logging.getLogger(__name__)


class CompiledFunction:
    """A function of a network and of tensors, compiled by `torch.compile` when it is first called.

    On a GPU its kernels are recorded once as a CUDA graph, and a call is a single launch. That is where the time of a
    small network goes: a hundred kernels take longer to launch than to run. PyTorch keeps these graphs for one thread
    of a process, the first that asks for them (pytorch issue 123177); in others a GPU computes operation by operation.

    Args:
        eager: function(network, *inputs) in PyTorch: what is compiled, and the reference. Returns a tuple.
    """

    _are_graphs_taken: ClassVar[bool] = False
    _of_thread: ClassVar[threading.local] = threading.local()

    def __init__(self, eager: Function) -> None:
        self.eager = eager
        self._has_said = False
        self._compiled = torch.compile(eager, mode="reduce-overhead", dynamic=False, fullgraph=True)

    def __reduce__(self) -> tuple[type["CompiledFunction"], tuple[Function]]:
        return CompiledFunction, (self.eager,)  # what is compiled can be neither copied nor sent to another process

    def __call__(self, network: nn.Module, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The same as `eager(network, *inputs)` up to rounding.

        PyTorch computes it operation by operation while the network is trained, and after eight shapes of inputs.

        Raises:
            UserError: if it cannot be compiled, for lack of a compiler for example.
        """
        if network.training or (inputs[0].is_cuda and not self._has_graphs()):
            return self.eager(network, *inputs)
        try:
            # A graph that was recorded in inference mode cannot be replayed outside it (pytorch issue 135892).
            with torch.inference_mode(mode=False), torch.no_grad():
                results = self._compiled(network, *inputs)
                return tuple(result.clone() for result in results)  # a graph writes its next results to the same place
        except FailOnRecompileLimitHit:
            return self.eager(network, *inputs)
        except ShortenTraceback as error:  # what compilers raise that fail or are not there
            reason = " ".join(str(error).split()).partition(" Set TORCHDYNAMO_VERBOSE")[0]
            raise UserError(
                "policy.inference=compile failed. It needs a C++ compiler on a CPU and Triton on a GPU, eager and "
                f"openvino need none: {shorten(reason, 300)}"
            ) from error

    def _has_graphs(self) -> bool:
        """Whether this thread may use CUDA graphs, of which a step begins; a warning, once, if it may not."""
        if not CompiledFunction._are_graphs_taken:
            CompiledFunction._are_graphs_taken = self._of_thread.has_graphs = True
        if getattr(self._of_thread, "has_graphs", False):
            torch.compiler.cudagraph_mark_step_begin()
            return True
        if not self._has_said:
            self._has_said = True
            logger.warning(
                "policy.inference=compile: PyTorch keeps CUDA graphs for the thread that has used them first. In this "
                "one it computes operation by operation; let one thread warm up and act."
            )
        return False
