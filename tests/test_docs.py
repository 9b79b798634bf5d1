"""The README and docs/: every command runs, in a tiny form, and every link leads somewhere.

The commands run in this process, in the order of the pages and in one folder, as a reader would type them: what one
command writes, a later one reads. A page's commands may be run alone with `-k`, if they need no other page's.
"""

import importlib.metadata
import re
import runpy
import shlex
import sys
from pathlib import Path

import matplotlib as mpl
import pytest

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.protocol import command as benchmark
from lerobot_uca.protocol import demonstrators
from lerobot_uca.protocol.setting import Setting
from tests.depth_builders import make_calibration, write_depth_dataset
from tests.robots.test_calibrate import render_boards, write_points

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

NOT_RUN = {
    "make quickstart": "the commands it prints are the README's, and benchmarks/results/ says what it reached",
    "make test": "is what runs this",
    "python3.12 -m venv": "installs",
    "pip install": "installs",
    "python benchmarks/kills.py": "starts a training twenty times; tests/trust/test_checkpoints.py resumes one",
    "python benchmarks/load.py": "takes a quarter of an hour, or trains in two processes",
    "accelerate launch": "tests/policies/test_distributed.py runs it, in two processes",
    "lerobot-train --policy.path=": "needs data under another name; tests/test_normalisation.py trains on some",
    "LEROBOT_UCA_CALIBRATION=calibration lerobot-rollout": "needs an arm; tests/robots rolls out on a simulated one",
    "lerobot-uca-edit-dataset": "needs several episodes; tests/data/test_edit_dataset.py edits a dataset of three",
    "lerobot-uca-view --camera.type=intelrealsense": "needs a camera; tests/robots shows the simulated one's",
    "lerobot-uca-benchmark run": "trains 37 tasks; tests/protocol/test_run.py runs a tiny one",
    "lerobot-uca-benchmark report": "needs that run's folder; tests/protocol/test_report.py makes one",
    "lerobot-uca-benchmark demonstrators": "runs 1850 episodes; tests/protocol/test_demonstrators.py runs two",
}
"""Beginnings of commands that cannot run here, and why."""

# Arguments that make a command tiny; they override its own.
TINY_CLOUD = ["--env.n_points=32"]
TINY_UCA_FLOW = ["--policy.dim=16", "--policy.n_layers=1", "--policy.n_heads=2", "--policy.n_points=16"]
TINY_SIMPLE_DP3 = ["--policy.unet_widths=[16,32]", "--policy.point_widths=[16,32]", "--policy.n_points=16"]
TINY = {
    "lerobot-uca-collect": ["--n_episodes=1", *TINY_CLOUD],
    "lerobot-train": ["--steps=2", "--batch_size=4", "--num_workers=0"],
    "lerobot-eval": ["--eval.n_episodes=1", "--eval.batch_size=1", "--eval.use_async_envs=false", *TINY_CLOUD],
    "lerobot-uca-calibrate": [],
    "lerobot-uca-convert": ["--n_points=32"],
    "lerobot-uca-view": ["--calibration=recorded_with", "--output=cloud.png"],
    "lerobot-uca-export": [],
    "benchmarks/baseline_step.py": ["--steps=1", "--batch_size=4", "--widths", "16", "32"],
    "benchmarks/control_loop.py": ["--steps=3", "--tasks", "dial-turn"],
    "benchmarks/fit.py": [],
    "benchmarks/inference.py": ["--calls=1", "--batch_sizes", "1", "--computed_by", "eager"],
    "benchmarks/latency.py": [
        *("--output=latency.csv", "--policies", "UCA-Flow", "--points", "32", "--threads", "1"),
        *("--rounds=1", "--warm_up=1"),
    ],
    "benchmarks/point_cloud.py": ["--steps=1"],
    "benchmarks/reading.py": ["--size=tiny", "--workers", "0"],
    "benchmarks/training_step.py": ["--steps=1", "--batch_size=4", "--dim=16", "--n_points=16"],
}


def commands_of(page: Path) -> list[str]:
    """The commands of a page's ```bash blocks, also those in lists, continued lines joined, without comments."""
    commands = []
    for block in re.findall(r"^ *```bash\n(.*?)^ *```", page.read_text(), re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            command = shlex.join(shlex.split(line, comments=True))
            commands += [command] if command else []
    return commands


COMMANDS = list(
    dict.fromkeys(command for page in PAGES if page.name != "real_robot.md" for command in commands_of(page))
)
"""Each command once, in the order of the pages. Those of real_robot.md need a running arm: tests/robots runs them."""


def plain(command: str) -> str:
    """A command without quotes."""
    return " ".join(shlex.split(command))


def reason_not_to_run(command: str) -> str | None:
    return next((reason for beginning, reason in NOT_RUN.items() if plain(command).startswith(beginning)), None)


def benchmark_commands() -> list[str]:
    """Those that are not run, each once."""
    every = [command for page in PAGES for command in commands_of(page)]
    return sorted({command for command in every if command.startswith("lerobot-uca-benchmark")})


def test_there_are_commands_of_each_kind():
    assert {command.split()[1] for command in benchmark_commands()} == {"run", "report", "demonstrators"}


@pytest.mark.parametrize("command", benchmark_commands())
def test_a_benchmarks_command_has_options_and_names_that_there_are(command, monkeypatch, capsys):
    """It is followed up to where its work would begin."""
    works = []

    def instead(result):
        return lambda *arguments, **_: works.append(arguments) or result

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(benchmark, "make_folder", lambda _, setting: Setting.load(setting))
    monkeypatch.setattr(benchmark, "run", instead(result=True))
    monkeypatch.setattr(benchmark, "report", instead(result=""))
    monkeypatch.setattr(demonstrators, "demonstrators", instead(result=[]))
    benchmark.main(shlex.split(command)[1:])
    assert len(works) == 1


def tiny(command: str) -> tuple[str, list[str]]:
    """The program or script, and its arguments with what makes it tiny."""
    program, *arguments = shlex.split(command)
    if program == "python":
        program, *arguments = arguments
    changes = list(TINY[program])
    if "data/recorded" in command and program == "lerobot-uca-convert":
        changes.append("--calibration=recorded_with")  # another camera's than the one that is calibrated above it
    if program == "lerobot-train":
        changes += TINY_SIMPLE_DP3 if "simple_dp3" in command else TINY_UCA_FLOW
    return program, [*arguments, *changes]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Path:
    """A folder with the repository's scripts, a user's recordings and, if they are there, Adroit's experts."""
    folder = tmp_path_factory.mktemp("docs")
    for name in ("benchmarks", "examples", "configs"):
        (folder / name).symlink_to(ROOT / name)
    experts = ROOT.parent / "shared" / "adroit_experts"
    if experts.is_dir():
        (folder / "experts").symlink_to(experts)
        (folder / "door.npz").symlink_to(experts / "door.npz")
    write_points(folder / "touched.csv", pixels=True)
    render_boards(folder / "board", on_arm=False)
    write_depth_dataset(folder / "data" / "recorded", video=False, n_episodes=1)
    make_calibration().write(folder / "recorded_with")
    return folder


def run(program: str) -> None:
    """Run a console command or a script in this process."""
    if program.endswith(".py"):
        runpy.run_path(program, run_name="__main__")
        return
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name=program)
    entry.load()()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs(command, workspace, monkeypatch):
    if reason := reason_not_to_run(command):
        pytest.skip(reason)
    program, arguments = tiny(command)
    if ("door" in command or "experts/" in command) and not (workspace / "experts").exists():
        pytest.skip("there are no Adroit experts")
    mpl.use("Agg")
    monkeypatch.chdir(workspace)
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setattr(sys, "argv", [program, *arguments])
    monkeypatch.setattr(MetaworldPointCloudEnv, "_max_episode_steps", 5)
    run(program)


def test_no_reason_is_left_over():
    for beginning in NOT_RUN:
        assert any(plain(command).startswith(beginning) for command in COMMANDS), beginning


def anchor(heading: str) -> str:
    """A heading's anchor, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("https://", "http://", "mailto:")):
            continue
        name, _, heading = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name}: {link}"
        assert target.is_relative_to(ROOT), f"{page.name}: {link} leads out of the repository"
        if heading:
            anchors = {anchor(line) for line in re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)}
            assert heading in anchors, f"{page.name}: {link}"


def test_every_page_is_listed():
    """docs/README.md lists each page once, and the README names it."""
    pages = sorted(page.name for page in PAGES if page.name != "README.md")
    listed = re.findall(r"^\| \[[^]]*\]\(([^)]+)\)", (ROOT / "docs" / "README.md").read_text(), re.MULTILINE)
    assert sorted(listed) == pages
    assert [name for name in pages if f"(docs/{name})" not in (ROOT / "README.md").read_text()] == []


def test_the_readme_is_short():
    """It says what this is and where to go on; details have pages of their own."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
