"""How well plain regression clones the pen's expert from the true state, without clouds: what ten demonstrations hold.

python benchmarks/pen_cloning.py ../shared/adroit_experts/pen.npz

The network has two hidden layers and sees where the hand's joints, the pen and the pen to be matched are and how they
have moved since the last action, as a policy sees it in two clouds and states; or all numbers that the expert sees, the
pen's velocities and the differences between both pens among them. A row for each set of demonstrations.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import write_rows
from torch import nn

from lerobot_uca.data.collect import FIRST_SEED
from lerobot_uca.envs.adroit import AdroitPointCloudEnv
from lerobot_uca.envs.experts.dapg import DAPGExpert, DAPGWeights
from lerobot_uca.envs.experts.expert import Expert, Smoothed

FIRST_EVALUATION_SEED = 4_001_000  # no table's episodes
SEEDS_BETWEEN_SETS = 100
WIDTH, BATCH_SIZE, STEPS = 256, 128, 3000
NOISE = 0.02
"""Standard deviation of what is added to inputs in training, which have a standard deviation of 1."""

JOINTS, PLACE, AXES = slice(0, 24), slice(24, 27), slice(33, 39)
"""In the simulator's observation: the hand's joints, the pen's place, the axes of the pen and of the one to match."""


class Episode(NamedTuple):
    """One episode of L actions."""

    inputs: np.ndarray  # (L, X)
    actions: np.ndarray  # (L, A)
    success: bool


class Visible:
    """What clouds and states tell: places, and how they have changed since the last action."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The inputs (2 * 33,)."""
        now = np.concatenate([observation[each] for each in (JOINTS, PLACE, AXES)])
        last, self._last = (now if self._last is None else self._last), now
        return np.concatenate([now, now - last])


class All:
    """What the expert sees."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The inputs (45,)."""
        return observation


INPUTS: dict[str, Callable[[], Visible | All]] = {"visible": Visible, "all of the expert's": All}


def main() -> None:
    """Print a row for each number of demonstrations, inputs and set of demonstrations."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("expert", type=Path, help="its weights")
    parser.add_argument("--smoothing", type=float, default=0.3, help="of the expert's actions (default: 0.3)")
    parser.add_argument("--demonstrations", type=int, nargs="+", default=[10, 30])
    parser.add_argument("--sets", type=int, default=4, help="sets of demonstrations, each with a training (default: 4)")
    parser.add_argument("--episodes", type=int, default=100, help="of evaluation (default: 100)")
    torch.set_num_threads(1)
    write_rows(rows(parser.parse_args()))


def rows(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rows, as they are measured."""
    env = AdroitPointCloudEnv("pen")
    weights = DAPGWeights.read(args.expert)
    for n_demonstrations in args.demonstrations:
        for name, make_inputs in INPUTS.items():
            for seed in range(args.sets):
                demonstrator = partial(Smoothed, partial(DAPGExpert, weights), args.smoothing)
                first_seed = FIRST_SEED + SEEDS_BETWEEN_SETS * seed
                tries = (run(env, each, demonstrator(), make_inputs()) for each in count(first_seed))
                clone = Clone(list(islice((each for each in tries if each.success), n_demonstrations)), seed)
                evaluated = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + args.episodes)
                successes = [run(env, each, clone, make_inputs()).success for each in evaluated]
                yield {
                    "task": "adroit/pen",
                    "smoothing": args.smoothing,
                    "demonstrations": n_demonstrations,
                    "inputs": name,
                    "training_seed": seed,
                    "first_demonstration_seed": first_seed,
                    "first_eval_seed": FIRST_EVALUATION_SEED,
                    "episodes": args.episodes,
                    "success_percent": f"{100 * np.mean(successes):g}",
                }


def run(env: AdroitPointCloudEnv, seed: int, actor: "Expert | Clone", inputs_of: Visible | All) -> Episode:
    """An episode of the expert or of its clone."""
    env.reset(seed=seed)
    inputs, actions, is_over = [], [], False
    while not is_over:
        inputs.append(inputs_of(env.expert_observation))
        actions.append(actor.act(inputs[-1]) if isinstance(actor, Clone) else actor(env))
        _, terminated, truncated, info = env.act(actions[-1])
        is_over = terminated or truncated
    return Episode(np.array(inputs), np.array(actions), info["is_success"])


class Clone:
    """A network trained to act as demonstrations do, by the mean square of the difference."""

    def __init__(self, demonstrations: list[Episode], seed: int) -> None:
        torch.manual_seed(seed)
        inputs = np.concatenate([each.inputs for each in demonstrations]).astype(np.float32)
        actions = torch.from_numpy(np.concatenate([each.actions for each in demonstrations]))
        self._mean, self._scale = inputs.mean(axis=0), inputs.std(axis=0) + 1e-3
        normalised = torch.from_numpy((inputs - self._mean) / self._scale)
        n_inputs, n_actions = normalised.shape[1], actions.shape[1]
        hidden = nn.Linear(n_inputs, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH), nn.GELU()
        self._network = nn.Sequential(*hidden, nn.Linear(WIDTH, n_actions))
        optimizer = torch.optim.AdamW(self._network.parameters(), lr=1e-3, weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
        for _ in range(STEPS):
            drawn = torch.randint(len(normalised), (BATCH_SIZE,))
            noisy = normalised[drawn] + NOISE * torch.randn(BATCH_SIZE, n_inputs)
            loss = (self._network(noisy) - actions[drawn]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()

    @torch.inference_mode()
    def act(self, inputs: np.ndarray) -> np.ndarray:
        """The action (A,) in [-1, 1]."""
        normalised = (inputs.astype(np.float32) - self._mean) / self._scale
        return self._network(torch.from_numpy(normalised)).clamp(-1, 1).numpy()


if __name__ == "__main__":
    main()
