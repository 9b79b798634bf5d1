"""Run the tests' core against the lowest and the highest versions that pyproject.toml declares: `make compat`.

Each set is installed into an environment of its own, .compat/lowest and .compat/highest, which has everything else from
the environment that runs this. The lowest needs 6 GB, most of them an older PyTorch's; remove the folder to free them.
"""

import subprocess
import sys
import tomllib
import venv
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
CORE = (
    *("test_meanflow.py", "test_lerobot_patches.py", "test_normalisation.py", "networks", "objectives", "inference"),
    *(
        "policies/test_every_policy.py",
        "policies/test_uca_flow.py",
        "deploy",
        "envs",
        "point_clouds/test_ray_casting.py",
    ),
    *("data/test_batched_dataset.py", "trust/test_checkpoints.py", "trust/test_hostile_checkpoints.py"),
    *("data/test_whole_folder.py", "protocol/test_intervals.py"),
)
"""What depends on LeRobot, PyTorch, MuJoCo, Gymnasium, the engines, filelock and SciPy, but for console commands."""


def declared() -> list[Requirement]:
    """Each dependency and OpenVINO, with the range of its versions."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [Requirement(each) for each in [*project["dependencies"], *project["optional-dependencies"]["openvino"]]]


def lowest(requirement: Requirement) -> str:
    """The requirement for the lowest version alone, as pip reads it."""
    (version,) = [each.version for each in requirement.specifier if each.operator in (">=", "==")]
    return f"{requirement.name}=={version}"


def highest(requirement: Requirement) -> str:
    """The requirement as it is: pip takes the highest."""
    return f"{requirement.name}{requirement.specifier}"


def run_core(name: str, requirements: list[str]) -> str:
    """Install the requirements, run the core, and say how it ended and with which versions."""
    folder = ROOT / ".compat" / name
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    (site,) = (folder / "lib").glob("python*/site-packages")
    shared = [path for path in sys.path if path.endswith("site-packages")]
    (site / "shared.pth").write_text("\n".join([*shared, str(ROOT / "src")]) + "\n")
    print(f"== {name}: {' '.join(requirements)}", flush=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--upgrade", *requirements], check=True)
    command = [python, "-m", "pytest", "-p", "no:cacheprovider", *(ROOT / "tests" / path for path in CORE)]
    returncode = subprocess.run(command, cwd=ROOT, check=False).returncode
    names = [Requirement(each).name for each in requirements]
    code = f"import importlib.metadata as m; print(', '.join(f'{{n}} {{m.version(n)}}' for n in {names}))"
    versions = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
    return f"{name}: {f'FAILED (exit code {returncode})' if returncode else 'passed'} with {versions}"


def main() -> None:
    """Run both; exit with 1 if a test fails."""
    requirements = declared()
    ends = [run_core(each.__name__, list(map(each, requirements))) for each in (lowest, highest)]
    print(*ends, sep="\n")
    sys.exit(any("FAILED" in end for end in ends))


if __name__ == "__main__":
    main()
