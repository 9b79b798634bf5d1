"""Error of a policy's actions on its own demonstrations, by episode and by step of the episodes.

python benchmarks/fit.py outputs/door/training/checkpoints/last/pretrained_model outputs/door/dataset

Errors are root mean squares of normalised actions, in [-1, 1]. 'change' is how far the expert's own action moves from
one step to the next: what is high there and in the error is chatter that positions and clouds do not foretell.
'constant' is the error of one action for all episodes at each step, their mean: a policy that is no better there does
not use what it sees.
"""

import argparse
import logging
from itertools import pairwise
from pathlib import Path

import torch
from common import print_provenance
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.features import OBS_POINT_CLOUD

PHASES = (0, 8, 20, 40, 80)
"""First steps of the phases that episodes are looked at by."""


def main() -> None:
    """Print a row for each demonstration, one for all, and one for each phase."""
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
    with torch.no_grad():  # with gradients the preprocessor would change the clouds as in training
        batch = preprocess(raw)
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
    print(f"{'steps':>8}{'error':>9}{'constant':>9}")
    now = config.executed.start
    error, expert, step = error[:, 0], expert[:, now], raw["frame_index"]
    end = int(step.max()) + 1
    for first, after in pairwise([*(first for first in PHASES if first < end), end]):
        steps = [step == at for at in range(first, after)]
        spread = torch.cat([expert[of] - expert[of].mean(dim=0) for of in steps])
        own = torch.cat([error[of] for of in steps])
        print(f"{f'{first}-{after - 1}':>8}{rms(own):9.3f}{rms(spread):9.3f}")


def rms(values: Tensor) -> float:
    """Root mean square."""
    return values.square().mean().sqrt().item()


if __name__ == "__main__":
    main()
