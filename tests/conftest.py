"""Shared fixtures: everything tiny, real where it can be. The functions that make things are in builders.py."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

os.environ.setdefault("HF_HUB_OFFLINE", "1")  # no test may need the network
os.environ.setdefault("OMP_NUM_THREADS", "1")  # a process of tests for each core, and the commands they start

import lerobot_policy_uca_flow  # noqa: F401  (registers everything, as LeRobot's commands do)
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from tests.builders import make_config, write_dataset

ADROIT_EXPERTS = Path(__file__).parents[2] / "shared" / "adroit_experts"
"""Weights are data, not code: they lie beside the project."""


@pytest.fixture(scope="session")
def adroit_experts() -> Path:
    """Folder of the trained policies, {task}.npz."""
    if not ADROIT_EXPERTS.is_dir():
        pytest.skip(f"there are no Adroit experts in {ADROIT_EXPERTS}")
    return ADROIT_EXPERTS


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Skipped tests are easily overlooked."""
    if not ADROIT_EXPERTS.is_dir():
        line = f"NOT TESTED: Adroit's demonstrations, because there are no expert weights in {ADROIT_EXPERTS}"
        terminalreporter.write_line(line, red=True, bold=True)


@pytest.fixture(autouse=True)
def _no_accelerator() -> Iterator[None]:
    """Accelerate keeps the first training's settings for the whole process, and refuses others."""
    yield
    if "accelerate.state" in sys.modules:
        sys.modules["accelerate.state"].AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)  # tiny tensors: more threads only wait for each other
    torch.manual_seed(0)


@pytest.fixture
def policy() -> UCAFlowPolicy:
    """An untrained policy in eval mode, whose averaged weights differ from its trained ones."""
    policy = UCAFlowPolicy(make_config())
    with torch.no_grad():
        for parameter in policy.model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return policy.eval()


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small dataset with episodes of different lengths and two tasks."""
    root = tmp_path_factory.mktemp("data") / "random"
    write_dataset(root)
    return root
