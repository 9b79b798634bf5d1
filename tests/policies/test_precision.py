import platform
from pathlib import Path

import pytest

from lerobot_uca.policies.precision import has_bfloat16


@pytest.mark.skipif(platform.machine() != "x86_64", reason="knows what Linux says of x86 processors")
def test_a_processor_has_bfloat16_if_linux_says_so():
    assert has_bfloat16("cpu") == ("avx512_bf16" in Path("/proc/cpuinfo").read_text().split())
