"""Long and parallel use: a day of control ticks, 64 environments, two threads, two trainings side by side.

python benchmarks/load.py ticks --minutes=15
python benchmarks/load.py environments
python benchmarks/load.py threads
python benchmarks/load.py trainings

Policies are untrained UCA-Flow policies in the small configuration.
"""

import argparse
import functools
import hashlib
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from common import CLOUD_POINTS, N_ACTIONS, SIZES, make_observation, make_policy, print_provenance
from control_loop import unit_statistics
from kills import FILES, command, write_dataset
from lerobot.envs import preprocess_observation
from lerobot.policies import make_pre_post_processors
from safetensors.torch import load_file

from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv

DAY = 24 * 3600 * 30
"""Ticks of a day at 30 Hz."""
EPISODE = 300
"""Ticks between two resets, and observations that come again in each episode."""
ENGINES = ("eager", "openvino", "onnxruntime")


def rss() -> float:
    """Memory of this process [MiB]."""
    return psutil.Process().memory_info().rss / 2**20


@functools.cache
def loop() -> tuple[Any, Callable[[Any], torch.Tensor]]:
    """A policy, and what a robot's control loop does in each tick: normalise, act, unnormalise."""
    policy = make_policy(**SIZES["small"])
    preprocess, postprocess = make_pre_post_processors(policy.config, dataset_stats=unit_statistics())
    return policy, lambda observation: postprocess(policy.select_action(preprocess(observation)))


def ticks(minutes: float, steps: int | None) -> None:
    """Episodes with the same observations and noise: actions must stay equal bit for bit, memory must not grow."""
    policy, act = loop()
    torch.manual_seed(0)
    observations = [{key: value[0] for key, value in make_observation().items()} for _ in range(EPISODE)]

    def episode() -> str:
        torch.manual_seed(1)
        policy.reset()
        actions = torch.stack([act(dict(observation)) for observation in observations[:steps]])
        return hashlib.sha256(actions.numpy().tobytes()).hexdigest()

    expected = episode()
    n_warm_up = 1 if steps else 20
    differing = sum(episode() != expected for _ in range(n_warm_up))
    begin, n_episodes, memory = time.monotonic(), 0, [rss()]
    while n_episodes == 0 or time.monotonic() - begin < minutes * 60:
        differing += episode() != expected
        n_episodes += 1
        memory.append(rss())
    n_ticks = n_episodes * (steps or EPISODE)
    milliseconds = 1e3 * (time.monotonic() - begin) / n_ticks
    slope = statistics.linear_regression(range(len(memory)), memory).slope / (n_ticks / n_episodes)
    print(f"{n_ticks} ticks ({100 * n_ticks / DAY:.1f} % of a day at 30 Hz), {milliseconds:.2f} ms each")
    print(f"episodes whose actions differ from the first one's: {differing} of {n_episodes + n_warm_up}")
    print(f"memory: {memory[0]:.1f} MiB after the warm-up, {memory[-1]:.1f} at the end, at most {max(memory):.1f}")
    print(f"its trend (least squares), if it went on for a day: {slope * DAY:+.1f} MiB")
    print(f"threads: {psutil.Process().num_threads()}")


def environments(n: int, steps: int) -> None:
    """Meta-World environments in one vector, a policy acting on all; some are repeated alone."""
    policy, act = loop()
    policy.reset()
    before = rss()
    env = MetaworldPointCloudConfig(task="dial-turn", n_points=CLOUD_POINTS).create_envs(n)["dial-turn"][0]
    observation, _ = env.reset(seed=list(range(n)))  # type: ignore[arg-type]  # (Gymnasium takes a list)
    print(f"{n} environments: {rss() - before:.0f} MiB")
    seen, actions = [observation], []
    begin = time.monotonic()
    for _ in range(steps):
        actions.append(act(preprocess_observation(observation)).numpy())
        observation, *_ = env.step(actions[-1])
        seen.append(observation)
    print(f"{steps} steps of all: {(time.monotonic() - begin) / steps:.2f} s each")
    assert actions[0].shape == (n, N_ACTIONS)
    equal = 0
    chosen = sorted({0, n // 2, n - 1})
    for index in chosen:
        alone = MetaworldPointCloudEnv("dial-turn", n_points=CLOUD_POINTS)
        got = [alone.reset(seed=index)[0], *(alone.step(action[index])[0] for action in actions)]
        pairs = zip(got, seen, strict=True)
        equal += all(np.array_equal(one[key], many[key][index]) for one, many in pairs for key in one)
    print(f"equal to the same environment alone, every observation: {equal} of {len(chosen)}")


def threads(steps: int) -> None:
    """Two policies, each in a thread of its own, and then one after the other."""
    for engine in ENGINES:
        policies = [make_policy(**SIZES["small"], inference=engine) for _ in range(2)]
        noise = torch.randn(steps, 1, policies[0].config.horizon, N_ACTIONS)
        observations = [make_observation() for _ in range(steps)]

        def run(policy: Any, noise: Any = noise, observations: Any = observations) -> torch.Tensor:
            policy.reset()
            pairs = zip(observations, noise, strict=True)
            return torch.cat([policy.select_action(observation, each) for observation, each in pairs])

        one_by_one = [run(policy) for policy in policies]
        with ThreadPoolExecutor(2) as pool:
            together = list(pool.map(run, policies))
        equal = [torch.equal(*pair) for pair in zip(one_by_one, together, strict=True)]
        assert not torch.equal(*one_by_one), "the policies are two"
        print(f"{engine}: {steps} actions each, equal to one policy after the other: {all(equal)}")


def trainings(steps: int) -> None:
    """One training alone, and then two at the same time from the same dataset, into two folders."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_dataset(folder / "data")
        runs = [folder / "alone", folder / "left", folder / "right"]
        alone, *others = ([*command(folder / "data", run, steps), "--policy.inference=eager"] for run in runs)
        subprocess.run(alone, check=True, capture_output=True)
        processes = [subprocess.Popen(each, stdout=-3, stderr=-3) for each in others]
        codes = [process.wait() for process in processes]
        print(f"exit codes of the two: {codes}")
        for file in FILES:
            one, *two = (load_file(run / "checkpoints" / "last" / file) for run in runs)
            equal = all(torch.equal(one[key], other[key]) for other in two for key in one)
            print(f"{file} of both, against the training alone: {'equal' if equal else 'DIFFERENT'}")
        shutil.rmtree(folder)


def main() -> None:
    """Print what was run and what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("ticks", "environments", "threads", "trainings"))
    parser.add_argument("--minutes", type=float, default=15, help="of ticks")
    parser.add_argument("--n", type=int, default=64, help="environments")
    parser.add_argument("--steps", type=int, help="of an episode, an environment, a thread or a training")
    args = parser.parse_args()
    print_provenance()
    match args.what:
        case "ticks":
            ticks(args.minutes, args.steps)
        case "environments":
            environments(args.n, args.steps or 100)
        case "threads":
            threads(args.steps or 10_000)
        case "trainings":
            trainings(args.steps or 100)


if __name__ == "__main__":
    main()
