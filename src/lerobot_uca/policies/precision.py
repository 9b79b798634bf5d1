"""Whether a device computes in bfloat16, or only imitates it."""

import logging
import platform

import torch

logger = logging.getLogger(__name__)


def dtype_of_training(dtype: str, device: str) -> str:
    """The precision to train in: float32 where bfloat16 is only imitated (2.8 instead of 0.32 s a step on AVX2 alone).

    Args:
        dtype: the one that is wanted, float32 or bfloat16.
        device: PyTorch's name of it.
    """
    if dtype == "bfloat16" and not has_bfloat16(device):
        logger.warning("This processor has no instructions for policy.dtype=bfloat16: training is in float32.")
        return "float32"
    return dtype


def amp_of_evaluation(use_amp: bool, device: str) -> bool:
    """Whether to evaluate with LeRobot's use_amp: not on a CPU that only imitates bfloat16, which autocast computes in.

    Args:
        use_amp: whether that is wanted.
        device: PyTorch's name of it.
    """
    if use_amp and torch.device(device).type == "cpu" and not has_bfloat16(device):
        logger.warning("This processor has no instructions for policy.use_amp=true: the evaluation is in float32.")
        return False
    return use_amp


def has_bfloat16(device: str) -> bool:
    """Whether a device has instructions for bfloat16. Without them PyTorch imitates it.

    Args:
        device: PyTorch's name of it, as cpu; of GPUs the current one is asked.
    """
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind != "cpu":
        return True  # Apple's have it; of others it is not known
    if platform.machine() in ("x86_64", "AMD64"):
        return torch.cpu._is_avx512_bf16_supported()  # oneDNN asks for less: AVX-512 alone, by which it imitates
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
