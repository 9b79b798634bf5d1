"""Checkpoints are whole, and training goes on from them as if it had never stopped."""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.common.train_utils import load_training_step, save_checkpoint, update_last_checkpoint
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import pretrained
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from tests.builders import make_config
from tests.trust.conftest import N_STEPS, train, training_options

from lerobot_uca.checkpoints.resuming import without_trace
from lerobot_uca.errors import UserError
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

STATE = (
    "pretrained_model/model.safetensors",
    "training_state/optimizer_state.safetensors",
    "training_state/rng_state.safetensors",
)
"""Weights and their averages, AdamW's moments, and the random numbers that would come next."""


def resume(run: Path, step: str, *options: str) -> None:
    config = run / "checkpoints" / step / "pretrained_model" / "train_config.json"
    train(f"--config_path={config}", "--resume=true", f"--output_dir={run}", *options)


@pytest.mark.parametrize("step", [3, 5, 8, 10])
def test_a_resumed_training_equals_the_unbroken_one_bit_for_bit(trained, tmp_path, step):
    """The step lies in the middle of the first or the second epoch, or at the end of one."""
    checkpoint = Path("checkpoints", f"{step:06d}")
    shutil.copytree(trained / checkpoint, tmp_path / checkpoint)
    resume(tmp_path, checkpoint.name)
    last = Path("checkpoints", f"{N_STEPS:06d}")
    for file in STATE:
        unbroken, resumed = (load_file(run / last / file) for run in (trained, tmp_path))
        assert unbroken.keys() == resumed.keys()
        assert all(torch.equal(unbroken[key], resumed[key]) for key in unbroken), file


def test_nothing_but_whole_checkpoints_is_left(trained):
    steps = [f"{step:06d}" for step in range(1, N_STEPS + 1)]
    assert sorted(path.name for path in (trained / "checkpoints").iterdir()) == [*steps, "last"]
    assert (trained / "checkpoints" / "last").readlink() == Path(steps[-1])


@pytest.mark.parametrize("others", [False, True])
def test_a_checkpoint_is_replaced_alone_and_saved_into_a_programs_own_folder_as_ever(tmp_path, others):
    """Which holds other things, to which LeRobot adds its files."""

    def save(*, steps: int) -> None:
        policy = UCAFlowPolicy(make_config(push_to_hub=False))
        dataset = DatasetConfig(repo_id="test/random")
        config = TrainPipelineConfig(dataset=dataset, policy=policy.config, output_dir=tmp_path, steps=steps)
        save_checkpoint(tmp_path / "run", steps, config, policy, torch.optim.SGD(policy.parameters()))

    save(steps=1)
    (tmp_path / "run" / "pretrained_model" / "left").touch()
    if others:
        os.mkfifo(tmp_path / "run" / "log.pipe")
    save(steps=2)
    assert (tmp_path / "run" / "log.pipe").is_fifo() == others
    assert (tmp_path / "run" / "pretrained_model" / "left").exists() == others
    assert load_training_step(tmp_path / "run" / "training_state") == 2


def test_last_is_never_absent(tmp_path, monkeypatch):
    """Whatever removes or replaces a file, `last` is there before and after."""
    for step in ("1", "2"):
        (tmp_path / step).mkdir()
    update_last_checkpoint(tmp_path / "1")
    seen = []
    for name in ("unlink", "rename", "replace", "symlink"):
        original = getattr(os, name)

        def watched(*args, original=original, **kwargs):
            result = original(*args, **kwargs)
            seen.append((tmp_path / "last").exists())
            return result

        monkeypatch.setattr(os, name, watched)
    update_last_checkpoint(tmp_path / "2")
    assert seen
    assert all(seen)
    assert (tmp_path / "last").readlink() == Path("2")


def test_a_copy_that_followed_links_goes_on(tmp_path, caplog):
    (tmp_path / "last").mkdir()
    (tmp_path / "last" / "weights").touch()
    for step in ("2", "3"):
        (tmp_path / step).mkdir()
        update_last_checkpoint(tmp_path / step)
        assert (tmp_path / "last").readlink() == Path(step)
    assert (tmp_path / "last.copied-1" / "weights").exists()
    assert (
        len([text for text in caplog.messages if "was a folder, not a link to one: it is 'last.copied-1'" in text]) == 1
    )


def test_a_full_disk_leaves_the_checkpoint_before_and_says_how_to_go_on(trained, tmp_path, monkeypatch):
    shutil.copytree(trained.parent / "data", tmp_path / "data")
    save, n_saved = pretrained.save_model_as_safetensor, 0

    def save_until_full(model, file):
        nonlocal n_saved
        n_saved += 1
        if n_saved == 3:
            Path(file).write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        save(model, file)

    monkeypatch.setattr(pretrained, "save_model_as_safetensor", save_until_full)
    with pytest.raises(UserError, match="No space left on device") as error:
        train(*training_options(tmp_path / "data", tmp_path / "run"))
    assert "The one before, 000002, is whole." in str(error.value)
    (command,) = [part for part in str(error.value).split(": ") if part.startswith("lerobot-train")]
    checkpoints = tmp_path / "run" / "checkpoints"
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000001", "000002", "last"]
    monkeypatch.undo()
    train(*command.split()[1:])
    assert (checkpoints / "last").resolve().name == f"{N_STEPS:06d}"


def test_a_second_training_into_the_folder_is_refused_until_the_first_has_ended(trained, tmp_path):
    """Also before the first checkpoint, from which on LeRobot refuses it."""
    code = (
        "import lerobot_policy_uca_flow\n"
        "from pathlib import Path\n"
        "from lerobot_uca.checkpoints.only_run import keep_others_out\n"
        f"keep_others_out(Path({str(tmp_path / 'run')!r}))\n"
        "print('held', flush=True)\n"
        "input()"
    )
    first = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout.readline() == "held\n"
    second = training_options(trained.parent / "data", tmp_path / "run")
    with pytest.raises(UserError, match=r"Another run is writing '.*run'\. Wait until it has ended"):
        train(*second)
    first.kill()
    first.wait()
    train(*second, "--steps=1")
    assert (tmp_path / "run" / "checkpoints" / "last").exists()


def test_an_evaluation_does_not_change_the_training_that_follows():
    """A resumed training does not repeat the evaluation that came after its checkpoint."""
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    without_trace(torch.rand)(5)
    assert torch.equal(torch.rand(3), expected)
    assert lerobot_train.eval_policy_all.__wrapped__.__name__ == "eval_policy_all"
