"""`lerobot-uca-benchmark`: its command line."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import PAPER_GROUPS, POLICIES, SUITES, grid, resolve_policies, resolve_tasks
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.launchers import Launcher, local, on_ray, on_slurm
from lerobot_uca.protocol.report import report
from lerobot_uca.protocol.run import make_folder, run

RUN_HELP = f"""\
Train and evaluate every policy on every task with every seed, and go on where an earlier run was.

  lerobot-uca-benchmark run --suite=paper --policies=uca_flow --seeds=0 --setting=small --output=runs/small \\
      --expert='experts/{{task}}.npz'

Each (task, policy, seed) is a cell with a folder of its own. Several processes, also on several machines that share
the disk, may work on one output folder: each takes the cells that nobody else works on. Stop with Ctrl-C; the same
command goes on. Every cell has one thread; as many run at once as there are cores, or GPUs if they compute there.

suites:   {", ".join(SUITES)}
groups:   {", ".join(PAPER_GROUPS)}
policies: {", ".join(POLICIES)}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(
        prog="lerobot-uca-benchmark", description="The papers' comparison: run it, report it."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    _add_run(commands)
    _add_report(commands)
    _add_demonstrators(commands)
    args = parser.parse_args(arguments)
    args.do(args)


def _add_run(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "run",
        help="train and evaluate what is missing",
        description=RUN_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--output", type=Path, required=True, help="folder of the run; made if it is not there")
    parser.add_argument("--suite", default="paper", help="set of tasks (default: paper)")
    parser.add_argument("--tasks", help="tasks or groups out of the suite, separated by commas (default: all)")
    parser.add_argument("--policies", default="uca_flow", help="separated by commas (default: uca_flow)")
    parser.add_argument("--seeds", default="0,1,2", help="of training; 100 and up are for tuning (default: 0,1,2)")
    parser.add_argument(
        "--setting", default="small", help="small, paper, a YAML file, or a run's setting.json (default: small)"
    )
    parser.add_argument("--expert", help="who demonstrates Adroit's tasks, as for lerobot-uca-collect")
    parser.add_argument(
        "--parallel", type=int, help="cells at once (default: one a core, or a GPU if used; or a cluster's)"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--ray", metavar="ADDRESS", help="run on a Ray cluster instead, at HOST:PORT or auto")
    where.add_argument(
        "--slurm",
        nargs="?",
        const="",
        metavar="OPTIONS",
        help="run as a Slurm array instead; sbatch's options as partition=gpu,gres=gpu:1,time=600",
    )
    parser.set_defaults(do=_run)


def _run(args: argparse.Namespace) -> None:
    if args.parallel is not None and args.parallel < 1:
        raise UserError(f"--parallel must be at least 1, got {args.parallel}.")
    cells = grid(args.suite, args.tasks, args.policies, args.seeds)
    folder = make_folder(args.output, args.setting)
    expert = args.expert
    if expert and not expert.startswith("minari:"):
        expert = str(Path(expert).absolute())  # a cell may run in another folder, on Ray for example
    if not run(folder, cells, _launcher(args, folder), expert):
        sys.exit(1)


def _launcher(args: argparse.Namespace, folder: RunFolder) -> Launcher:
    if args.ray is not None:
        return on_ray(args.ray, args.parallel)
    if args.slurm is not None:
        pairs = [option.partition("=") for option in args.slurm.split(",") if option]
        if not all(name and value for name, _, value in pairs):
            raise UserError(f"--slurm takes options as partition=gpu,gres=gpu:1,time=600, got '{args.slurm}'.")
        asks_for_gpu = any(name.startswith(("gres", "gpus")) for name, *_ in pairs)
        if folder.setting.policy.get("device") != "cpu" and not asks_for_gpu:
            folder.log(
                f"Setting '{folder.setting.name}' computes on a GPU, but --slurm asks for none: many clusters show a "
                "job none then, and it trains on the CPU. To ask: gres=gpu:1."
            )
        return on_slurm({name: value for name, _, value in pairs}, args.parallel)
    return local(args.parallel)


REPORT_HELP = """\
The paper's Tables 1 to 3 with the paper's numbers beside ours, as Markdown, CSV and LaTeX, and figures (PNG, SVG).

  lerobot-uca-benchmark report runs/small --output=report --html
  lerobot-uca-benchmark report runs/small --output=report --html --rollouts=door,drawer-close
  lerobot-uca-benchmark report runs/small --output=report --policies=uca_flow

Cells that are missing are shown as missing, so a report can be made while the run goes on. Several folders are taken
together if they were made with one setting. The report's folder holds all rows, and can itself be reported.
"""


def _add_report(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "report",
        help="tables and figures beside the paper's",
        description=REPORT_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="DIR", help="folder of a run or of a report")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write (default: report)")
    parser.add_argument("--policies", default=",".join(POLICIES), help="separated by commas (default: all)")
    parser.add_argument("--html", action="store_true", help="also one self-contained page, report.html")
    parser.add_argument(
        "--rollouts", metavar="TASKS", help="also strips of pictures, an episode of each policy on these tasks"
    )
    parser.set_defaults(do=_report)


def _report(args: argparse.Namespace) -> None:
    tasks = resolve_tasks("all", args.rollouts) if args.rollouts is not None else ()
    policies = resolve_policies(args.policies)
    print(report(args.runs, args.output, as_html=args.html, policies=policies, rollouts_of=tasks))
    print(f"Written to {args.output}.", file=sys.stderr)


DEMONSTRATORS_HELP = """\
How often each task's expert succeeds, and how much its actions change from step to step, as a CSV file.

  lerobot-uca-benchmark demonstrators --suite=paper --expert='experts/{task}.npz' --output=demonstrators.csv
  lerobot-uca-benchmark demonstrators --tasks=pen --expert='experts/{task}.npz' --smoothing=0.3 --output=smooth.csv
  lerobot-uca-benchmark demonstrators --tasks=very_hard --straight_paths=true --output=straight.csv
  lerobot-uca-benchmark demonstrators --tasks=very_hard --pushes=0.025 --output=pushed.csv
"""


def _add_demonstrators(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = commands.add_parser(
        "demonstrators",
        help="how well the experts do their tasks",
        description=DEMONSTRATORS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--output", type=Path, required=True, help="CSV file to write")
    parser.add_argument("--suite", default="paper", help="set of tasks (default: paper)")
    parser.add_argument("--tasks", help="tasks or groups out of the suite, separated by commas (default: all)")
    parser.add_argument("--expert", help="who demonstrates Adroit's tasks, as for lerobot-uca-collect")
    parser.add_argument(
        "--straight_paths",
        nargs="?",
        const="true",
        default="false",
        choices=("true", "false"),
        help="as for lerobot-uca-collect; Meta-World alone (default: false)",
    )
    parser.add_argument("--smoothing", type=float, default=1.0, help="as for lerobot-uca-collect (default: 1)")
    parser.add_argument("--pushes", type=float, default=0.0, help="as for lerobot-uca-collect (default: 0)")
    parser.add_argument("--episodes", type=int, default=50, help="of each task (default: 50)")
    parser.set_defaults(do=_demonstrators)


def _demonstrators(args: argparse.Namespace) -> None:
    from lerobot_uca.protocol.demonstrators import Demonstrating, demonstrators

    if args.episodes < 1:
        raise UserError(f"--episodes must be at least 1, got {args.episodes}.")
    tasks = resolve_tasks(args.suite, args.tasks)
    how = Demonstrating(
        expert=args.expert,
        straight_paths=args.straight_paths == "true",
        smoothing=args.smoothing,
        pushes=args.pushes,
    )
    for row in demonstrators(tasks, args.output, how, args.episodes):
        print(f"{row.task}: {row.demonstrations} of {row.episodes} (any success: {row.any_success})")
