"""A UR5e's whole story without one: a simulated arm is recorded, a policy trained, rolled out, an episode replayed.

The commands are those for a real arm (docs/real_robot.md), each printed so that it can be repeated while
`lerobot-uca-ur5e-sim` runs. Complete results are reused; remove outputs/ur5e_demo to start over.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_uca.robots.ur5e.sim.scene_service import SceneClient

ADDRESS = "127.0.0.1"
FPS = 30
SECONDS = {"pick_place": 9, "drawer_close": 5}  # of a demonstration
SENTENCE = {"pick_place": "Put the cube into the box.", "drawer_close": "Close the drawer."}
RESET_SECONDS = 3
CROP = "--policy.depth.crop_low='[-0.8, -0.45, 0.005]' --policy.depth.crop_high='[-0.2, 0.35, 0.5]'"
FIRST_TRIAL = 1000  # seed: places that no demonstration has seen


def main() -> None:
    """Run everything that is not there yet, then report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=tuple(SECONDS), default="drawer_close")
    parser.add_argument("--demonstrations", type=int, default=10)
    parser.add_argument("--steps", type=int, default=400, help="of training")
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("outputs/ur5e_demo"))
    options = parser.parse_args()
    task, output = options.task, options.output
    dataset, training, calibrations = output / task / "dataset", output / task / "training", output / "calibrations"
    robot = f"--robot.type=ur5e_follower --robot.ip={ADDRESS} --robot.control_rate={FPS}"
    camera = f"--robot.cameras='{{top: {{type: ur5e_sim, ip: {ADDRESS}, fps: {FPS}, width: 160, height: 120}}}}'"
    data = f"--dataset.repo_id=local/{task} --dataset.root={dataset}"
    checkpoint = training / "checkpoints" / "last" / "pretrained_model"
    os.environ["LEROBOT_UCA_CALIBRATION"] = str(calibrations)

    with simulated_arm(f"lerobot-uca-ur5e-sim --ip={ADDRESS} --task={task} --calibration={calibrations}") as scene:
        times = f"episode_time_s={SECONDS[task]}", f"reset_time_s={RESET_SECONDS}"
        record = (
            f"lerobot-record {robot} {camera} --teleop.type=ur5e_scripted --teleop.ip={ADDRESS} --teleop.task={task} "
            f"--teleop.fps={FPS} --teleop.{times[0]} --teleop.{times[1]} {data} --dataset.fps={FPS} "
            f"--dataset.single_task='{SENTENCE[task]}' --dataset.num_episodes={options.demonstrations} "
            f"--dataset.{times[0]} --dataset.{times[1]} --dataset.video=false --dataset.push_to_hub=false "
            "--play_sounds=false"
        )
        run(record, complete=dataset / "meta" / "info.json", unfinished=dataset)
        train = (
            f"lerobot-train --config_path=ur5e_small {data} --output_dir={training} --steps={options.steps} "
            "--batch_size=16 "  # LeRobot reads recordings row by row, tens of milliseconds each
            f"--policy.depth.calibration={calibrations} {CROP}"
        )
        run(train, complete=checkpoint / "model.safetensors", unfinished=training)
        n_successes = 0
        for trial in range(options.trials):
            scene.ask(request="reset", task=task, seed=FIRST_TRIAL + trial)
            run(
                f"lerobot-rollout --policy.path={checkpoint} {robot} {camera} --fps={FPS} "
                f"--duration={SECONDS[task] + 2} --task='{SENTENCE[task]}' --play_sounds=false"
            )
            n_successes += scene.ask(request="state")["success"]
        scene.ask(request="reset", task=task, seed=0)
        run(f"lerobot-replay {robot} {data} --dataset.episode=0 --play_sounds=false")
        replayed = scene.ask(request="state")["success"]
    print(f"\n     task  {task} (simulated)\n rollouts  {n_successes} of {options.trials} succeeded")
    print(f"   replay  {'succeeded' if replayed else 'failed'}\n  dataset  {dataset}\n   policy  {checkpoint}")


@contextmanager
def simulated_arm(command: str) -> Iterator[SceneClient]:
    """The simulated arm in a process of its own, and a line to its world."""
    print(f"$ {command} &", flush=True)
    program, *arguments = shlex.split(command)
    process = subprocess.Popen(
        [Path(sys.executable).with_name(program), *arguments],
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stderr is not None
        for line in process.stderr:
            print(f"  {line.rstrip()}", flush=True)
            if "serves" in line:
                break
        else:
            sys.exit("error: the simulated arm did not start")
        scene = SceneClient(ADDRESS)
        yield scene
        scene.close()
    finally:
        process.terminate()
        process.wait()


def run(command: str, complete: Path | None = None, unfinished: Path | None = None) -> None:
    """Run a command of this interpreter's environment, unless what it makes is there."""
    print(f"\n$ {command}", flush=True)
    if complete is not None and complete.exists():
        print(f"  (complete: {complete})")
        return
    if unfinished is not None:
        shutil.rmtree(unfinished, ignore_errors=True)
    program, *arguments = shlex.split(command)
    start = time.monotonic()
    result = subprocess.run([Path(sys.executable).with_name(program), *arguments], check=False)
    if result.returncode:
        sys.exit(f"error: the command above ended with exit code {result.returncode}")
    print(f"  (took {time.monotonic() - start:.0f} s)")


if __name__ == "__main__":
    main()
