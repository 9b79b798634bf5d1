import platform
from pathlib import Path

import pytest
import torch

from lerobot_uca.policies.precision import has_bfloat16


@pytest.mark.skipif((platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="asks Linux of x86")
def test_a_processor_has_bfloat16_if_linux_says_so():
    assert has_bfloat16("cpu") == ("avx512_bf16" in Path("/proc/cpuinfo").read_text().split())


@pytest.mark.parametrize("is_there", [True, False])
def test_a_gpu_that_imitates_bfloat16_has_none(monkeypatch, is_there):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda *, including_emulation: is_there or including_emulation)
    assert has_bfloat16("cuda:1") == is_there


def test_apples_gpus_have_bfloat16():
    assert has_bfloat16("mps")
