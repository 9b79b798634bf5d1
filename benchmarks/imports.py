"""Processor seconds that importing takes, each stage after those above it: `python benchmarks/imports.py`.

A fresh interpreter imports PyTorch, then what registering a policy, an environment and a robot needs of LeRobot, then
this package, as LeRobot's commands do. Processor time hardly depends on what else the machine does. Median of several.
"""

import argparse
import statistics
import subprocess
import sys

from common import print_provenance

STAGES = {
    "torch": "torch",
    "LeRobot's configurations": "lerobot.configs, lerobot.envs.configs, lerobot.robots, lerobot.cameras",
    "LeRobot's policies and data": "lerobot.policies, lerobot.datasets.factory, lerobot.processor",
    "lerobot_policy_uca_flow": "lerobot_policy_uca_flow",
}
CODE = "import time; begin = time.process_time()\nimport {}\nprint(time.process_time() - begin)"


def main() -> None:
    """Print the seconds of each stage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    print_provenance()
    code = "\n".join(CODE.format(modules) for modules in STAGES.values())
    runs = []
    for _ in range(args.repeats):
        result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
        runs.append([float(line) for line in result.stdout.split()])
    for name, seconds in zip(STAGES, zip(*runs, strict=True), strict=True):
        print(f"{name}: {statistics.median(seconds):.2f} s")


if __name__ == "__main__":
    main()
