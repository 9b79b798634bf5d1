"""Networks compiled by `torch.compile`, on a GPU with CUDA graphs."""

from textwrap import shorten

import torch
from torch import Tensor, nn
from torch._dynamo.exc import FailOnRecompileLimitHit, ShortenTraceback

from lerobot_uca.errors import UserError
from lerobot_uca.inference.backends import Function


class CompiledFunction:
    """A function of a network and of tensors, compiled by `torch.compile` when it is first called.

    On a GPU its kernels are recorded once as a CUDA graph, and a call is a single launch. That is where the time of a
    small network goes: a hundred kernels take longer to launch than to run.

    Args:
        eager: function(network, *inputs) in PyTorch: what is compiled, and the reference. Returns a tuple.
    """

    def __init__(self, eager: Function) -> None:
        self.eager = eager
        self._compiled = torch.compile(eager, mode="reduce-overhead", dynamic=False, fullgraph=True)

    def __reduce__(self) -> tuple[type["CompiledFunction"], tuple[Function]]:
        return CompiledFunction, (self.eager,)  # what is compiled can be neither copied nor sent to another process

    def __call__(self, network: nn.Module, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The same as `eager(network, *inputs)` up to rounding.

        PyTorch computes it operation by operation while the network is trained, and after eight shapes of inputs.

        Raises:
            UserError: if it cannot be compiled, for lack of a compiler for example.
        """
        if network.training:
            return self.eager(network, *inputs)
        torch.compiler.cudagraph_mark_step_begin()
        try:
            results = self._compiled(network, *inputs)
        except FailOnRecompileLimitHit:
            return self.eager(network, *inputs)
        except ShortenTraceback as error:  # what compilers raise that fail or are not there
            reason = " ".join(str(error).split()).partition(" Set TORCHDYNAMO_VERBOSE")[0]
            raise UserError(
                "policy.inference=compile failed. It needs a C++ compiler on a CPU and Triton on a GPU, eager and "
                f"openvino need none: {shorten(reason, 300)}"
            ) from error
        return tuple(result.clone() for result in results)  # a CUDA graph writes its next results to the same place
