"""The paper's comparison at a size for two cores: UCA-Flow, its ablations and Simple DP3, by benchmarks/learning.py.

python benchmarks/comparison.py --expert=door.npz            # trains what is missing: all of it takes three hours
python benchmarks/comparison.py --seeds 1 --tasks dial-turn  # a part of it
python benchmarks/comparison.py --tasks                      # only the table of what is there

Every method gets the same demonstrations, points, encoder, optimiser, schedule, batches, steps and evaluation episodes,
whose seeds nothing else uses. Rows are added to benchmarks/results/comparison.csv; the table is printed as Markdown.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from common import RESULTS as FOLDER
from common import read_rows

RESULTS = FOLDER / "comparison.csv"
FIRST_EVAL_SEED = 3_000_000
STEPS = {"dial-turn": 600, "shelf-place": 1200, "door": 1200}
ADROIT_TASKS = ("door",)
UCA_FLOW = ["configs/uca_flow_small.yaml", "--batch_size=128"]  # the paper's batch
METHODS = {
    "uca_flow": UCA_FLOW,
    "without_dual_pass": [*UCA_FLOW, "--policy.dual_pass=false"],
    "cross_attention": [*UCA_FLOW, "--policy.conditioning=cross_attention"],
    "adaln": [*UCA_FLOW, "--policy.conditioning=adaln"],
    "simple_dp3": ["configs/simple_dp3_small.yaml", "--batch_size=128"],
}
# Success rates [%]: UCA-Flow's and the ablations' from the paper's table of components, Simple DP3's from its table of
# 37 tasks, which has Meta-World's only by difficulty.
PAPER = {
    "uca_flow": {"dial-turn": "92.3", "shelf-place": "74.0", "door": "77.3"},
    "without_dual_pass": {"dial-turn": "91.3", "shelf-place": "64.0", "door": "74.3"},
    "cross_attention": {"dial-turn": "87.3", "shelf-place": "56.6", "door": "68.2"},
    "adaln": {"dial-turn": "78.6", "shelf-place": "32.3", "door": "56.5"},
    "simple_dp3": {"door": "40"},
}


def main() -> None:
    """Train and evaluate what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="*", choices=list(STEPS), default=list(STEPS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2], help="seeds of training")
    parser.add_argument("--expert", help="who demonstrates Adroit's door, as for lerobot-uca-collect")
    args = parser.parse_args()
    for seed in args.seeds:
        for task in args.tasks:
            for method in METHODS:
                learn(method, task, seed, args.expert)
    print_table()


def learn(method: str, task: str, seed: int, expert: str | None) -> None:
    """One training and its evaluation, if they are missing."""
    config, *changes = METHODS[method]
    options = [f"--task={task}", f"--steps={STEPS[task]}", f"--seeds={seed}", f"--first_eval_seed={FIRST_EVAL_SEED}"]
    if task in ADROIT_TASKS:
        options += ["--env=adroit_pointcloud", *([f"--expert={expert}"] if expert else [])]
    learning = [sys.executable, str(Path(__file__).with_name("learning.py")), str(RESULTS)]
    command = [*learning, f"--name={method}", f"--config={config}", *options, "--", *changes]
    if subprocess.run(command, check=False).returncode:
        sys.exit(f"error: stopped at {method}, {task}, seed {seed}; the rows before are in {RESULTS}")


def print_table() -> None:
    """Success rates [%] by training seed, and the paper's in brackets."""
    rows = read_rows(RESULTS)
    print("| | " + " | ".join(f"{task}, {steps} steps" for task, steps in STEPS.items()) + " |")
    print("|---" * (len(STEPS) + 1) + "|")
    for method, arguments in METHODS.items():
        cells = []
        for task, steps in STEPS.items():
            values = (method, task, str(steps), str(FIRST_EVAL_SEED), " ".join(arguments))
            same = dict(zip(("name", "task", "steps", "first_eval_seed", "arguments"), values, strict=True))
            found = [(int(row["training_seed"]), row["success_percent"]) for row in rows if same.items() <= row.items()]
            ours = " and ".join(success for _, success in sorted(found)) or "-"
            cells.append(f"{ours} ({PAPER[method].get(task, '-')})")
        print(f"| {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
