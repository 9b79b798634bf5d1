"""A real Ray cluster of two workers on this machine, of which one dies while both work."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from tests.builders import N_POINTS, make_config, make_statistics, write_dataset

from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.launchers import Ended, local, on_ray
from lerobot_uca.protocol.run_cell import Outcome
from lerobot_uca.protocol.setting import Setting

CELLS = [Cell("metaworld/drawer-close", "uca_flow", seed) for seed in (0, 1)]
SETTING = Setting.from_values(
    "tiny",
    {
        "description": "as small as can be",
        "batch_size": 4,
        "lengths": {"metaworld": {"steps": 2, "evaluations": 1}},
        "demonstrations": 1,
        "interim_episodes": 1,
        "final_episodes": 2,
        "policy": {"device": "cpu", "n_points": N_POINTS, "inference": "eager"},
    },
)


def make_trained(path) -> RunFolder:
    """A run whose cells have their last checkpoint: their evaluations are left."""
    folder = RunFolder.create(path, SETTING)
    with folder.demonstrations(CELLS[0]) as dataset:
        write_dataset(dataset)
    for cell in CELLS:
        torch.manual_seed(cell.seed)
        config = make_config(inference="eager")
        checkpoints = folder.cell(cell).training / "checkpoints"
        weights = checkpoints / "000002" / "pretrained_model"
        UCAFlowPolicy(config).save_pretrained(weights)
        for processor in make_pre_post_processors(config, dataset_stats=make_statistics()):
            processor.save_pretrained(weights)
        (checkpoints / "last").symlink_to("000002")
    return folder


def rows(folder: RunFolder) -> list:
    return [row._replace(ms=0) for row in folder.read()]


def test_a_worker_dies_and_the_rows_are_those_of_a_local_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)  # Ray replaces it
    cluster_utils = pytest.importorskip("ray.cluster_utils", reason="needs the extra ray")
    here, there = make_trained(tmp_path / "here"), make_trained(tmp_path / "there")
    finished = [Ended(cell, Outcome.FINISHED) for cell in CELLS]
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        _, worker = (cluster.add_node(num_cpus=1) for _ in range(2))
        cluster.wait_for_nodes()
        launch = on_ray(cluster.address)
        with ThreadPoolExecutor(1) as pool:
            run = pool.submit(lambda: sorted(launch(there.path, CELLS, None)))
            while not all((there.cell(cell).path / "lock").exists() for cell in CELLS):
                assert not run.done(), run.result()
                time.sleep(0.05)  # until both work
            cluster.remove_node(worker, allow_graceful=False)
            assert run.result() == finished
    finally:
        cluster.shutdown()
    assert sorted(local(2)(here.path, CELLS, None)) == finished
    assert len(rows(there)) == 6
    assert rows(there) == rows(here)
