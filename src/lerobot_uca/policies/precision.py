"""Whether a device computes in bfloat16, or only imitates it."""

import platform

import torch


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
