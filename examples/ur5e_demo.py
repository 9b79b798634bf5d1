"""A UR5e's whole story without one: a simulated arm is recorded, policies trained, rolled out, an episode replayed.

The commands are those for a real arm (docs/real_robot.md), each printed so that it can be repeated while
`lerobot-uca-ur5e-sim` runs. Complete results, trials too, are reused where the same commands made them, and others are
made anew; remove outputs/ur5e_demo to start over. Beside them lie a recording of the clouds for Rerun, the picture of
what decides (saliency) and a film of the first trial. On two cores a task takes about half an hour; --demonstrations=5
--steps=50 --trials=1 shows every command in five minutes.
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
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.protocol.record import columns
from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.sim.scene_service import SceneClient

FPS = 30


class Task(NamedTuple):
    """A task's settings."""

    sentence: str
    seconds: int  # of a demonstration, the holding still after it included
    crop: tuple[str, str]  # [m], corners in the base frame
    n_points: int  # of a cloud
    steps: int  # of training
    options: str = ""  # of training


TASKS = {
    # Little of the arm, whose joints are known: the wide crop below leaves 10 of 256 points to the cube.
    "pick_place": Task(
        "Put the cube into the box.",
        9,
        crop=("[-0.63, -0.3, 0.005]", "[-0.36, 0.3, 0.15]"),
        n_points=512,
        steps=6000,
        options="--policy.n_points=128",
    ),
    "drawer_close": Task(
        "Close the drawer.", 5, crop=("[-0.8, -0.45, 0.005]", "[-0.2, 0.35, 0.5]"), n_points=1024, steps=1500
    ),
}
METHODS = {
    "uca_flow": "",
    "adaln": "--policy.conditioning=adaln",
    "cross_attention": "--policy.conditioning=cross_attention",
}
RESET = 3  # [s]
SEED = 1000  # of training
FIRST_TRIAL = 1000  # seed: places that no demonstration has seen
MOVED = 0.02  # [rad]: a trial's time begins when the arm is so far from home
FILM_RATE, FILM_SIZE = 15, (320, 240)  # [Hz], [pixels]
COLUMNS = ("task", "method", "seed", "steps", "demonstrations", "points", "trial", "success", "seconds")


def main() -> None:
    """Run everything that is not there yet, then report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=tuple(TASKS), default=tuple(TASKS))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=["uca_flow"])
    parser.add_argument("--demonstrations", type=int, default=40)
    parser.add_argument("--steps", type=int, help="of training (default: the task's)")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--ip", default="127.0.0.1", help="loopback address of the simulated arm")
    parser.add_argument("--output", type=Path, default=Path("outputs/ur5e_demo"))
    options = parser.parse_args()
    os.environ["LEROBOT_UCA_CALIBRATION"] = str(options.output / "calibrations")
    summary = [line for name in options.tasks for line in run_task(name, TASKS[name], options)]
    print("\nSimulated:", *summary, f"trials: {options.output / 'trials.csv'}", sep="\n  ")


def run_task(name: str, task: Task, options: argparse.Namespace) -> list[str]:
    """Record, convert, train, roll out and replay; lines for the summary."""
    folder, ip, seconds = options.output / name, options.ip, task.seconds
    dataset, clouds, calibrations = folder / "dataset", folder / "clouds", options.output / "calibrations"
    robot = f"--robot.type=ur5e_follower --robot.ip={ip} --robot.control_rate={FPS}"
    camera = f"--robot.cameras='{{top: {{type: ur5e_sim, ip: {ip}, fps: {FPS}, width: 160, height: 120}}}}'"
    data = f"--dataset.repo_id=local/{name} --dataset.root={dataset}"
    steps = options.steps or task.steps
    lines = []
    world = f"lerobot-uca-ur5e-sim --ip={ip} --task={name} --noise=0.001 --holes=0.02 --calibration={calibrations}"
    with simulated_arm(world, ip) as scene:
        times = f"episode_time_s={seconds}", f"reset_time_s={RESET}"
        record = (
            f"lerobot-record {robot} {camera} --teleop.type=ur5e_scripted --teleop.ip={ip} --teleop.task={name} "
            f"--teleop.fps={FPS} --teleop.{times[0]} --teleop.{times[1]} {data} --dataset.fps={FPS} "
            f"--dataset.single_task='{task.sentence}' --dataset.num_episodes={options.demonstrations} "
            f"--dataset.{times[0]} --dataset.{times[1]} --dataset.video=false --dataset.push_to_hub=false "
            "--play_sounds=false"
        )
        recorded = make(record, dataset)
        convert = (
            f"lerobot-uca-convert --source={dataset} --repo_id=local/{name}_clouds --root={clouds} "
            f"--crop_low='{task.crop[0]}' --crop_high='{task.crop[1]}' --n_points={task.n_points}"
        )
        converted = make(convert, clouds, after=recorded)
        recording = folder / "demonstrations.rrd"
        make(f"lerobot-uca-view --source={clouds} --rrd={recording}", recording, after=converted)
        for method in options.methods:
            training = folder / method
            checkpoint = training / "checkpoints" / "last" / "pretrained_model"
            train = (
                f"lerobot-train --config_path=ur5e_small --dataset.repo_id=local/{name}_clouds --dataset.root={clouds} "
                f"--output_dir={training} --steps={steps} --seed={SEED} {task.options} {METHODS[method]}"
            )
            trained = make(train, training, after=converted)
            pictures = folder / f"{method}_saliency"
            draw = f"lerobot-uca-saliency {checkpoint} {clouds} --output={pictures} --rerun"
            make(draw, pictures, after=trained)
            rollout = (
                f"lerobot-rollout --policy.path={checkpoint} {robot} {camera} --fps={FPS} --duration={seconds + 2} "
                f"--task='{task.sentence}' --play_sounds=false"
            )
            setting = (name, method, SEED, steps, options.demonstrations, task.n_points)
            solved = earlier_trials(options.output / "trials.csv", setting)
            for trial in range(options.trials):
                if trial not in solved:
                    scene.ask(request="reset", task=name, seed=FIRST_TRIAL + trial, with_arm=True)
                    film = folder / f"{method}.mp4" if trial == 0 else None
                    solved[trial], lasted = attempt(rollout, scene, film)
                    add_row(options.output / "trials.csv", (*setting, trial, int(solved[trial]), lasted))
            n_successes = sum(solved[trial] for trial in range(options.trials))
            lines.append(f"{name} {method}: {n_successes} of {options.trials} trials succeeded")
        scene.ask(request="reset", task=name, seed=0, with_arm=True)
        run(f"lerobot-replay {robot} {data} --dataset.episode=0 --play_sounds=false")
        lines.append(f"{name} replay: {'succeeded' if scene.ask(request='state')['success'] else 'failed'}")
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


def attempt(command: str, scene: SceneClient, film: Path | None) -> tuple[bool, str]:
    """Run a rollout: was its task solved in the end, and in which time; the first one is filmed.

    The time is from the first motion until the task first was solved [s], empty where it was not.
    """
    print(f"\n$ {command}", flush=True)
    process = start(command)
    began, lasted, pictures = 0.0, "", list[NDArray[np.uint8]]()
    while process.poll() is None:
        state = scene.ask(request="state")
        if not began and np.abs(np.array(state["q"]) - HOME).max() > MOVED:
            began = time.monotonic()
        if state["success"] and not lasted:
            lasted = f"{time.monotonic() - began:.1f}"
        if film and began and (picture := scene.frame(*FILM_SIZE, colour=True)[2]) is not None:
            pictures.append(picture)
        time.sleep(1 / FILM_RATE)
    check(process.returncode)
    success = bool(scene.ask(request="state")["success"])
    print(f"  ({f'success after {lasted} s' if success else 'no success'})")
    if film:
        write_film(film, pictures)
    return success, lasted if success else ""


def write_film(file: Path, pictures: list[NDArray[np.uint8]]) -> None:
    """Ray-cast pictures (H, W, 3) as an MP4."""
    with av.open(str(file), "w") as container:
        stream: av.VideoStream = container.add_stream("mpeg4", rate=FILM_RATE)
        (stream.width, stream.height), stream.pix_fmt = FILM_SIZE, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def earlier_trials(file: Path, setting: tuple[object, ...]) -> dict[int, bool]:
    """Whether a trial of this setting succeeded, by its number."""
    if not file.exists():
        return {}
    with file.open(newline="", encoding="utf-8") as opened:
        rows = list(csv.DictReader(opened))
    texts = [str(value) for value in setting]
    return {int(row["trial"]): row["success"] == "1" for row in rows if list(row.values())[: len(texts)] == texts}


def add_row(file: Path, row: tuple[object, ...]) -> None:
    """Append a row to a CSV, with how it was made."""
    made = columns(shlex.join(["python", "examples/ur5e_demo.py", *sys.argv[1:]]))
    is_new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        if is_new:
            writer.writerow([*COLUMNS, *made])
        writer.writerow([*row, *made.values()])


def make(command: str, output: Path, after: str = "") -> str:
    """Run a command, unless what it makes is there, made by it after the same commands; return all of these.

    A file beside the output holds them. It is written when the output is complete, whose own files may be there before.
    """
    commands, made_by = f"{after}{command}\n", output.with_name(f".{output.name}.made_by")
    if output.exists() and made_by.is_file() and made_by.read_text(encoding="utf-8") == commands:
        print(f"\n$ {command}\n  (complete: {output})", flush=True)
        return commands
    made_by.unlink(missing_ok=True)
    if output.exists():
        print(f"\n{output} is not complete, or other commands made it: it is removed.")
        shutil.rmtree(output) if output.is_dir() else output.unlink()
    run(command)
    made_by.write_text(commands, encoding="utf-8")
    return commands


def run(command: str) -> None:
    """Run a command of this interpreter's environment."""
    print(f"\n$ {command}", flush=True)
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
        sys.exit(f"error: the command above ended with exit code {code}; run this again to go on from what is complete")


if __name__ == "__main__":
    main()
