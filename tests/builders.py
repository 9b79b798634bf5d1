"""Tiny configurations, batches and datasets that the tests are made of."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_base import PointCloudPolicy

N_POINTS, N_STATES, N_ACTIONS = 32, 9, 4
TINY_UNET = {"point_widths": (16, 32), "unet_widths": (16, 32), "unet_blocks": 1, "time_dim": 16}
SMALL_POLICIES: dict[str, dict] = {
    "uca_flow": {
        "point_widths": (16, 32),
        "dim": 32,
        "n_layers": 2,
        "n_heads": 2,
        "n_timestep_tokens": 2,
        "n_interval_tokens": 2,
    },
    **dict.fromkeys(("dp3", "simple_dp3", "flowpolicy", "mp1"), TINY_UNET),
}
"""Sizes small enough for a test, by policy type."""


def make_settings() -> dict:
    """Settings of every configuration besides its sizes."""
    return {
        "input_features": {
            OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (N_POINTS, 3)),
            "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))},
        "device": "cpu",
        "push_to_hub": False,
    }


def make_config(**changes: object) -> UCAFlowConfig:
    """A UCA-Flow configuration small enough for a test."""
    return UCAFlowConfig(**{**make_settings(), **SMALL_POLICIES["uca_flow"], **changes})


def make_statistics() -> dict[str, dict[str, np.ndarray]]:
    """A dataset's statistics with which normalisation changes nothing."""
    values = {"min": -1.0, "max": 1.0, "mean": 0.0, "std": 0.5}
    sizes = {OBS_POINT_CLOUD: 3, "observation.state": N_STATES, "action": N_ACTIONS}
    return {key: {name: np.full(n, value) for name, value in values.items()} for key, n in sizes.items()}


def make_batch(config: UCAFlowConfig, batch_size: int = 8) -> dict[str, torch.Tensor]:
    """A batch of training windows with values in [-1, 1]."""
    n_obs = config.n_obs_steps
    return {
        OBS_POINT_CLOUD: torch.rand(batch_size, n_obs, N_POINTS, 3) * 2 - 1,
        "observation.state": torch.rand(batch_size, n_obs, N_STATES) * 2 - 1,
        "action": torch.rand(batch_size, config.horizon, N_ACTIONS) * 2 - 1,
        "action_is_pad": torch.zeros(batch_size, config.horizon, dtype=torch.bool),
    }


def make_observation(batch_size: int = 1) -> dict[str, torch.Tensor]:
    """One step's observation."""
    return {
        OBS_POINT_CLOUD: torch.rand(batch_size, N_POINTS, 3),
        "observation.state": torch.rand(batch_size, N_STATES),
    }


def write_dataset(
    root: Path,
    *,
    n_episodes: int = 3,
    length: int = 12,
    features: dict | None = None,
    change: Callable[[dict, int, int], None] | None = None,
) -> LeRobotDataset:
    """A small LeRobot dataset of random numbers: point clouds, states and actions.

    Args:
        features: others than these.
        change: called with each frame, its episode and its index in it, to change it.
    """
    rng = np.random.default_rng(0)
    features = features or {
        OBS_POINT_CLOUD: {"dtype": "float32", "shape": (N_POINTS, 3), "names": ["point", "xyz"]},
        "observation.state": {"dtype": "float32", "shape": (N_STATES,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
    }
    dataset = LeRobotDataset.create("test/random", fps=80, features=features, root=root, use_videos=False)
    for episode in range(n_episodes):
        for index in range(length + episode):
            frame = {
                key: _random(rng, feature["dtype"], feature["shape"])
                for key, feature in features.items()
                if feature["dtype"] not in ("string", "image", "video")
            }
            if change is not None:
                change(frame, episode, index)
            dataset.add_frame({**frame, "task": f"task {episode % 2}"})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("test/random", root=root)


def _random(rng: np.random.Generator, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    is_float = np.issubdtype(np.dtype(dtype), np.floating)
    return (rng.normal(size=shape) if is_float else rng.integers(0, 6, size=shape)).astype(dtype)


def overfit(policy: PointCloudPolicy, n_steps: int) -> float:
    """Train on one small batch; the error of the actions made for it, as a share of what it was."""
    batch = make_batch(policy.config, batch_size=4)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3)

    def error() -> float:
        policy.eval()
        chunk = policy.predict_action_chunk(batch)
        policy.train()
        return (chunk - batch["action"][:, policy.config.executed]).abs().mean().item()

    before = error()
    repeated = {key: value.repeat(8, *[1] * (value.ndim - 1)) for key, value in batch.items()}
    for _ in range(n_steps):
        loss, _ = policy.forward(repeated)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        policy.update()
    return error() / before
