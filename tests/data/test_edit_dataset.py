"""LeRobot's editing of datasets, with point clouds."""

import sys
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.builders import write_dataset
from tests.forked import run_command

from lerobot_uca.data.edit_dataset import run
from lerobot_uca.features import OBS_POINT_CLOUD


@pytest.fixture
def root(tmp_path) -> Path:
    """Three episodes of 12, 13 and 14 frames."""
    write_dataset(tmp_path / "data")
    return tmp_path / "data"


def edit(monkeypatch, root: Path, operation: str, *options: str) -> None:
    arguments = ["--repo_id=test/random", f"--root={root}", f"--operation.type={operation}", *options]
    monkeypatch.setattr(sys, "argv", ["lerobot-uca-edit-dataset", *arguments])
    run()


def clouds(root: Path, episodes: list[int] | None = None) -> torch.Tensor:
    dataset = LeRobotDataset("test/random", root=root)
    rows = [dataset[index] for index in range(len(dataset))]
    return torch.stack(
        [row[OBS_POINT_CLOUD] for row in rows if episodes is None or int(row["episode_index"]) in episodes]
    )


def test_deleting_episodes(root, monkeypatch):
    new = root.with_name("new")
    options = ("--operation.episode_indices=[1]", "--new_repo_id=test/new", f"--new_root={new}")
    edit(monkeypatch, root, "delete_episodes", *options)
    assert torch.equal(clouds(new), clouds(root, [0, 2]))


def test_a_mistake_is_one_line(root):
    options = ("--repo_id=test/random", f"--root={root}", f"--new_root={root.with_name('new')}")
    operation = ("--operation.type=delete_episodes", "--operation.episode_indices=[7]")
    result = run_command("lerobot-uca-edit-dataset", *options, *operation)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr  # not of torchcodec without FFmpeg either
    said = "error: The dataset could not be edited: ValueError: Invalid episode indices: {7}"
    assert result.stderr.splitlines()[-1] == said


def test_splitting(root, monkeypatch):
    new = root.with_name("new")
    edit(monkeypatch, root, "split", '--operation.splits={"a": [0, 1], "b": [2]}', f"--new_root={new}")
    parts = sorted(path.parent.parent for path in new.parent.glob("**/meta/info.json") if path.parent.parent != root)
    assert sorted(map(len, map(clouds, parts))) == [14, 25]


def test_merging_and_editing_what_was_merged(root, monkeypatch):
    other, new = root.with_name("other"), root.with_name("new")
    write_dataset(other, n_episodes=1)
    options = ('--operation.repo_ids=["test/random", "test/random"]', f'--operation.roots=["{root}", "{other}"]')
    edit(monkeypatch, root, "merge", *options, "--new_repo_id=test/new", f"--new_root={new}")
    assert torch.equal(clouds(new), torch.cat([clouds(root), clouds(other)]))
    edit(monkeypatch, new, "recompute_stats", "--operation.overwrite=true")
    stats = LeRobotDataset("test/random", root=new).meta.stats[OBS_POINT_CLOUD]
    torch.testing.assert_close(torch.tensor(stats["min"]).float(), clouds(new).amin(dim=(0, 1)))


def test_other_tasks(root, monkeypatch):
    before = clouds(root)
    edit(monkeypatch, root, "modify_tasks", "--operation.new_task=close the drawer")
    dataset = LeRobotDataset("test/random", root=root)
    assert {dataset[index]["task"] for index in (0, 20, 38)} == {"close the drawer"}
    assert torch.equal(clouds(root), before)
