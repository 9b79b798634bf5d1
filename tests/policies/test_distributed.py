"""Several processes that train one policy: for real, on this machine's CPU."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import distributed, multiprocessing

from lerobot_uca.policies.distributed import independent_draws

BIN = Path(sys.executable).parent


def draw(rank: int, folder: str) -> None:
    """Write (2 runs, inside and outside twice, 4 numbers)."""
    distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    draws = []
    for _ in range(2):
        torch.manual_seed(1000)
        for _ in range(2):
            with independent_draws(torch.device("cpu")):
                draws.append(torch.randn(4))
            draws.append(torch.randn(4))
    np.save(f"{folder}/{rank}.npy", torch.stack(draws).view(2, 4, 4).numpy())
    distributed.destroy_process_group()


def test_two_processes_draw_independently_and_reproducibly(tmp_path):
    multiprocessing.spawn(draw, (str(tmp_path),), nprocs=2)
    first, second = (np.load(tmp_path / f"{rank}.npy") for rank in range(2))
    for runs in (first, second):
        np.testing.assert_array_equal(*runs)  # the seed reproduces them
    inside, outside = [0, 2], [1, 3]
    np.testing.assert_array_equal(first[0, outside], second[0, outside])  # LeRobot's own draws still agree
    assert len(np.unique([first[0, inside], second[0, inside], first[0, outside]])) == 24


def test_one_process_draws_as_without():
    torch.manual_seed(1000)
    expected = torch.randn(4)
    torch.manual_seed(1000)
    with independent_draws(torch.device("cpu")):
        assert torch.equal(torch.randn(4), expected)


# `lerobot-train`, whose processes also write their averaged weights.
TRAIN = """
import os
import torch
from lerobot.scripts import lerobot_train
from safetensors.torch import save_file
import lerobot_policy_uca_flow
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
update = PointCloudPolicy.update
def update_and_write(policy):
    update(policy)
    save_file(policy.ema_model.state_dict(), f"{os.environ['FOLDER']}/{os.environ['RANK']}.safetensors")
PointCloudPolicy.update = update_and_write
loss = UCAFlowPolicy.compute_loss
def loss_and_write(policy, *inputs):
    with open(f"{os.environ['FOLDER']}/draws_{os.environ['RANK']}.txt", "a") as file:
        print(torch.get_rng_state().sum().item(), file=file)
    return loss(policy, *inputs)
UCAFlowPolicy.compute_loss = loss_and_write
lerobot_train.main()
"""


@pytest.mark.skipif(not distributed.is_available(), reason="PyTorch was built without torch.distributed")
def test_accelerate_trains_one_policy_in_two_processes(dataset_root, tmp_path):
    """The command of docs/distributed.md."""
    from safetensors.torch import load_file

    (tmp_path / "train.py").write_text(TRAIN)
    launch = [BIN / "accelerate", "launch", "--multi_gpu", "--num_processes=2", "--main_process_port=0"]
    policy = ["type=uca_flow", "device=cpu", "push_to_hub=false", "dim=16", "n_layers=1", "n_heads=2"]
    recipe = ["optimizer_lr=0.005", "scheduler_warmup_steps=1", "point_widths=[16,32]"]
    command = [
        *(*launch, tmp_path / "train.py", *(f"--policy.{setting}" for setting in policy + recipe)),
        *("--batch_size=8", "--steps=30", "--log_freq=1", "--save_freq=30", "--dataset.repo_id=test/random"),
        *(f"--dataset.root={dataset_root}", f"--output_dir={tmp_path}/training"),
    ]
    environment = {**os.environ, "FOLDER": str(tmp_path)}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=300)
    assert result.returncode == 0, result.stderr[-3000:]
    assert "Effective batch size: 8 x 2 = 16" in result.stderr
    assert "Batched reading needs no workers" in result.stderr
    losses = [float(loss) for loss in re.findall(r" loss:(\S+)", result.stderr)]
    assert len(losses) == 30
    assert np.isfinite(losses).all()
    assert np.mean(losses[-5:]) < np.mean(losses[:5])
    first, second = (load_file(tmp_path / f"{rank}.safetensors") for rank in range(2))
    saved = load_file(tmp_path / "training" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    for name, weight in first.items():
        assert torch.equal(weight, second[name]), name
        assert torch.equal(weight, saved[f"ema_model.{name}"]), name
    states = [(tmp_path / f"draws_{rank}.txt").read_text().split() for rank in range(2)]
    assert len({*states[0], *states[1]}) == 60  # each draws noise and times of its own in every step
