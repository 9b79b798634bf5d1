"""Error of a policy's actions on its own demonstrations, by episode.

python benchmarks/fit.py outputs/door/training/checkpoints/last/pretrained_model outputs/door/dataset

Errors are root mean squares of normalised actions, in [-1, 1]. 'change' is how far the expert's own action moves from
one step to the next: what is high there and in the error is chatter that positions and clouds do not foretell.
"""

import argparse
import logging
from pathlib import Path

import torch
from common import print_provenance
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.features import OBS_POINT_CLOUD


def main() -> None:
    """Print a row for each demonstration, and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("dataset", type=Path)
    args = parser.parse_args()
    logging.disable(logging.INFO)
    config = PreTrainedConfig.from_pretrained(args.checkpoint)
    config.device = "cpu"
    policy = get_policy_class(config.type).from_pretrained(args.checkpoint, config=config).eval()
    dataset = BatchedDataset(f"local/{args.dataset.name}", root=args.dataset)
    windows = {
        **dict.fromkeys((OBS_POINT_CLOUD, "observation.state"), config.observation_delta_indices),
        "action": config.action_delta_indices,
    }
    seconds = {key: [step / dataset.fps for step in steps] for key, steps in windows.items()}
    dataset = BatchedDataset(f"local/{args.dataset.name}", root=args.dataset, delta_timestamps=seconds)
    preprocess, _ = make_pre_post_processors(config, pretrained_path=str(args.checkpoint))
    raw = default_collate(dataset.__getitems__(list(range(len(dataset)))))
    batch = preprocess(raw)
    with torch.no_grad():
        made = policy.predict_action_chunk({key: batch[key] for key in (OBS_POINT_CLOUD, "observation.state")})
    expert, padded = batch["action"], raw["action_is_pad"]
    error = made - expert[:, config.executed]
    change = expert[:, 1:] - expert[:, :-1]
    executed, moves = ~padded[:, config.executed], ~(padded[:, 1:] | padded[:, :-1])
    print_provenance()
    print(f"{'episode':>8}{'error':>9}{'median':>9}{'change':>9}{'action':>9}")
    for episode in [*raw["episode_index"].unique().tolist(), "all"]:
        of = torch.ones(len(error), dtype=torch.bool) if episode == "all" else raw["episode_index"] == episode
        own = error[of][executed[of]]
        row = (rms(own), own.abs().median().item(), rms(change[of][moves[of]]), rms(expert[of][~padded[of]]))
        print(f"{episode:>8}" + "".join(f"{value:9.3f}" for value in row))


def rms(values: Tensor) -> float:
    """Root mean square."""
    return values.square().mean().sqrt().item()


if __name__ == "__main__":
    main()
