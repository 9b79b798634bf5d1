"""A policy's time for a chunk of actions: one sample, after the observation is there."""

import time
from contextlib import redirect_stdout
from pathlib import Path
from statistics import median
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import OBS_STATE

from lerobot_uca.features import OBS_POINT_CLOUD

N_WARM_UP, N_CALLS = 5, 50


@torch.inference_mode()
def measure(checkpoint: Path) -> dict[str, Any]:
    """Milliseconds from a normalised observation to a chunk, with the configuration's engine, and how it was measured.

    Taken while the other cells run, as the paper's are.
    """
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    policy_class: Any = get_policy_class(config.type)
    with redirect_stdout(None):  # LeRobot says that it loads
        policy = policy_class.from_pretrained(checkpoint, config=config).eval()
    cloud_shape = config.input_features[OBS_POINT_CLOUD].shape
    milliseconds = []
    for _ in range(N_WARM_UP + N_CALLS):
        observation = {
            OBS_POINT_CLOUD: 2 * torch.rand(1, *cloud_shape, device=config.device) - 1,
            OBS_STATE: 2 * torch.rand(1, config.n_states, device=config.device) - 1,
        }
        _synchronize(config.device)
        begin = time.perf_counter()
        policy.predict_action_chunk(observation)
        _synchronize(config.device)
        milliseconds.append(1e3 * (time.perf_counter() - begin))
    ordered = sorted(milliseconds[N_WARM_UP:])
    return {
        "median_ms": round(median(ordered), 3),
        "p90_ms": round(ordered[int(0.9 * len(ordered))], 3),
        "engine": config.engine,
        "device": str(config.device),
        "parameters": sum(parameter.numel() for parameter in policy.model.parameters()),
    }


def _synchronize(device: str) -> None:
    if str(device).startswith("cuda"):
        torch.cuda.synchronize()
