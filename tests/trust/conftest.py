"""One tiny training whose every step is a checkpoint."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings
from lerobot.scripts import lerobot_eval, lerobot_train  # noqa: F401  (in memory before patches are installed anew)
from tests.builders import SMALL_POLICIES, write_dataset

from lerobot_uca.lerobot_patches.install import install

install()  # what lerobot_eval has brought

N_STEPS = 12
"""The steps of the training, 5 an epoch: 39 frames in batches of 8."""

TIMES = int(os.environ.get("UCA_GENERATED_CASES", "1"))
"""How many times as many cases to generate as in a run of all tests."""


def generated(n_cases: int) -> Callable[[Callable], Callable]:
    """Generate the same cases in each run; with UCA_GENERATED_CASES more, and others."""
    return settings(
        max_examples=n_cases * TIMES,
        derandomize=TIMES == 1,
        database=None,
        deadline=None,
        phases=[Phase.generate],  # shrinking takes minutes
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


def train(*arguments: object) -> None:
    """Run `lerobot-train` in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *map(str, arguments)])
        patch.setattr(lerobot_train, "init_logging", lambda **_: None)  # it would take pytest's handlers away
        lerobot_train.train()


def training_options(data: Path, output: Path) -> list[str]:
    """The options of a training of `N_STEPS` steps."""
    sizes = {name: list(v) if isinstance(v, tuple) else v for name, v in SMALL_POLICIES["uca_flow"].items()}
    return [
        *("--policy.type=uca_flow", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.inference=eager"),
        *(f"--policy.{name}={value}" for name, value in sizes.items()),
        *("--dataset.repo_id=test/random", f"--dataset.root={data}", f"--output_dir={output}"),
        *("--batch_size=8", f"--steps={N_STEPS}", "--save_freq=1", "--log_freq=1"),
    ]


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its output folder; the dataset lies beside it."""
    folder = tmp_path_factory.mktemp("trained")
    write_dataset(folder / "data")
    train(*training_options(folder / "data", folder / "run"))
    return folder / "run"
