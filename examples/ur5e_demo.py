"""A UR5e's whole story without one: a simulated arm is recorded, policies trained, rolled out, an episode replayed.

The commands are those for a real arm (docs/real_robot.md), each printed so that it can be repeated while
`lerobot-uca-ur5e-sim` runs. Complete results are reused; remove outputs/ur5e_demo to start over. On two cores a task
takes about half an hour; --demonstrations=5 --steps=50 --trials=1 shows every command in five minutes.
"""

import argparse
import csv
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.sim.scene_service import SceneClient

FPS = 30
EPISODE = {"pick_place": 9, "drawer_close": 5}  # [s], a demonstration and the holding still after it
STEPS = {"pick_place": 1200, "drawer_close": 500}
SENTENCE = {"pick_place": "Put the cube into the box.", "drawer_close": "Close the drawer."}
METHODS = {
    "uca_flow": "",
    "adaln": "--policy.conditioning=adaln",
    "cross_attention": "--policy.conditioning=cross_attention",
}
RESET = 3  # [s]
CROP_LOW, CROP_HIGH, N_POINTS = "[-0.8, -0.45, 0.005]", "[-0.2, 0.35, 0.5]", 1024
SEED = 1000  # of training
FIRST_TRIAL = 1000  # seed: places that no demonstration has seen
MOVED = 0.02  # [rad]: a trial's time begins when the arm is so far from home
COLUMNS = ("task", "method", "seed", "steps", "demonstrations", "trial", "success", "seconds")


def main() -> None:
    """Run everything that is not there yet, then report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=tuple(EPISODE), default=tuple(EPISODE))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=["uca_flow"])
    parser.add_argument("--demonstrations", type=int, default=40)
    parser.add_argument("--steps", type=int, help="of training (default: 1200 for pick_place, 500 for drawer_close)")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--ip", default="127.0.0.1", help="loopback address of the simulated arm")
    parser.add_argument("--output", type=Path, default=Path("outputs/ur5e_demo"))
    options = parser.parse_args()
    os.environ["LEROBOT_UCA_CALIBRATION"] = str(options.output / "calibrations")
    summary = [line for task in options.tasks for line in run_task(task, options)]
    print("\nSimulated:", *summary, f"trials: {options.output / 'trials.csv'}", sep="\n  ")


def run_task(task: str, options: argparse.Namespace) -> list[str]:
    """Record, convert, train, roll out and replay; lines for the summary."""
    folder, ip, seconds = options.output / task, options.ip, EPISODE[task]
    dataset, clouds, calibrations = folder / "dataset", folder / "clouds", options.output / "calibrations"
    robot = f"--robot.type=ur5e_follower --robot.ip={ip} --robot.control_rate={FPS}"
    camera = f"--robot.cameras='{{top: {{type: ur5e_sim, ip: {ip}, fps: {FPS}, width: 160, height: 120}}}}'"
    data = f"--dataset.repo_id=local/{task} --dataset.root={dataset}"
    steps = options.steps or STEPS[task]
    lines = []
    world = f"lerobot-uca-ur5e-sim --ip={ip} --task={task} --noise=0.001 --holes=0.02 --calibration={calibrations}"
    with simulated_arm(world, ip) as scene:
        times = f"episode_time_s={seconds}", f"reset_time_s={RESET}"
        record = (
            f"lerobot-record {robot} {camera} --teleop.type=ur5e_scripted --teleop.ip={ip} --teleop.task={task} "
            f"--teleop.fps={FPS} --teleop.{times[0]} --teleop.{times[1]} {data} --dataset.fps={FPS} "
            f"--dataset.single_task='{SENTENCE[task]}' --dataset.num_episodes={options.demonstrations} "
            f"--dataset.{times[0]} --dataset.{times[1]} --dataset.video=false --dataset.push_to_hub=false "
            "--play_sounds=false"
        )
        run(record, complete=dataset / "meta" / "info.json", unfinished=dataset)
        convert = (
            f"lerobot-uca-convert --source={dataset} --repo_id=local/{task}_clouds --root={clouds} "
            f"--crop_low='{CROP_LOW}' --crop_high='{CROP_HIGH}' --n_points={N_POINTS}"
        )
        run(convert, complete=clouds)
        for method in options.methods:
            training = folder / method
            checkpoint = training / "checkpoints" / "last" / "pretrained_model"
            train = (
                f"lerobot-train --config_path=ur5e_small --dataset.repo_id=local/{task}_clouds --dataset.root={clouds} "
                f"--output_dir={training} --steps={steps} --seed={SEED} {METHODS[method]}"
            )
            run(train, complete=checkpoint / "model.safetensors", unfinished=training)
            rollout = (
                f"lerobot-rollout --policy.path={checkpoint} {robot} {camera} --fps={FPS} --duration={seconds + 2} "
                f"--task='{SENTENCE[task]}' --play_sounds=false"
            )
            n_successes = 0
            for trial in range(options.trials):
                scene.ask(request="reset", task=task, seed=FIRST_TRIAL + trial, with_arm=True)
                success, lasted = attempt(rollout, scene)
                n_successes += success
                row = (task, method, SEED, steps, options.demonstrations, trial, int(success), lasted)
                add_row(options.output / "trials.csv", row)
            lines.append(f"{task} {method}: {n_successes} of {options.trials} trials succeeded")
        scene.ask(request="reset", task=task, seed=0, with_arm=True)
        run(f"lerobot-replay {robot} {data} --dataset.episode=0 --play_sounds=false")
        lines.append(f"{task} replay: {'succeeded' if scene.ask(request='state')['success'] else 'failed'}")
    return lines


@contextmanager
def simulated_arm(command: str, ip: str) -> Iterator[SceneClient]:
    """The simulated arm in a process of its own, and a line to its world."""
    print(f"$ {command} &", flush=True)
    process = start(command, stderr=subprocess.PIPE)
    try:
        assert process.stderr is not None
        for line in process.stderr:
            print(f"  {line.rstrip()}", flush=True)
            if "serves" in line:
                break
        else:
            sys.exit("error: the simulated arm did not start")
        scene = SceneClient(ip)
        yield scene
        scene.close()
    finally:
        process.terminate()
        process.wait()


def attempt(command: str, scene: SceneClient) -> tuple[bool, str]:
    """Run a rollout: whether its task was solved in the end, and the seconds from the first motion until it first was.

    The seconds are empty where it was not.
    """
    print(f"\n$ {command}", flush=True)
    process = start(command)
    began, lasted = 0.0, ""
    while process.poll() is None:
        state = scene.ask(request="state")
        if not began and np.abs(np.array(state["q"]) - HOME).max() > MOVED:
            began = time.monotonic()
        if state["success"] and not lasted:
            lasted = f"{time.monotonic() - began:.1f}"
        time.sleep(0.05)
    check(process.returncode)
    success = bool(scene.ask(request="state")["success"])
    print(f"  ({f'success after {lasted} s' if success else 'no success'})")
    return success, lasted if success else ""


def add_row(file: Path, row: tuple[object, ...]) -> None:
    """Append a row to a CSV."""
    is_new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerows([COLUMNS, row] if is_new else [row])


def run(command: str, complete: Path | None = None, unfinished: Path | None = None) -> None:
    """Run a command of this interpreter's environment, unless what it makes is there."""
    print(f"\n$ {command}", flush=True)
    if complete is not None and complete.exists():
        print(f"  (complete: {complete})")
        return
    if unfinished is not None:
        shutil.rmtree(unfinished, ignore_errors=True)
    began = time.monotonic()
    check(start(command).wait())
    print(f"  (took {time.monotonic() - began:.0f} s)")


def start(command: str, stderr: int | None = None) -> "subprocess.Popen[str]":
    """A command of this interpreter's environment."""
    program, *arguments = shlex.split(command)
    path = Path(sys.executable).with_name(program)
    return subprocess.Popen([path, *arguments], stderr=stderr, stdin=subprocess.DEVNULL, text=True)


def check(code: int) -> None:
    """End with a command that failed."""
    if code:
        sys.exit(f"error: the command above ended with exit code {code}")


if __name__ == "__main__":
    main()
