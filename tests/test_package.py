"""How the package is put together and found."""

import ast
import importlib.metadata
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "lerobot_uca"
DISTRIBUTION = "lerobot_policy_uca_flow"

# What a module or folder may import from this package. Imports run one way; what is not listed is a leaf.
ALLOWED = {
    "policies": {"meanflow", "objectives", "networks", "inference", "errors", "features"},
    "inference": {"traced", "errors"},
    "objectives": {"meanflow", "networks"},
    "envs": {"errors", "features"},
    "data": {"envs", "errors", "features"},
    "terminal": {"errors"},
    "training": {"data", "policies", "errors"},
    "export": {"policies", "traced", "errors", "features"},
    "commands": {"data", "export"},
}


def package_imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        modules = []
        if isinstance(node, ast.ImportFrom) and node.module:
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        names |= {module.split(".")[1] for module in modules if module.startswith("lerobot_uca.")}
    return names


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_one_way(path):
    part = path.relative_to(SOURCE).parts[0].removesuffix(".py")
    assert package_imports(path) <= ALLOWED.get(part, set()) | {part}


def test_the_method_needs_torch_alone():
    modules = {
        node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
        for node in ast.walk(ast.parse((SOURCE / "meanflow.py").read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert modules == {"collections.abc", "typing", "torch"}


def test_the_installed_name_keeps_its_underscores():
    """LeRobot imports a plugin by its distribution's raw name; hyphens would hide it silently."""
    assert importlib.metadata.metadata(DISTRIBUTION)["Name"] == DISTRIBUTION


def test_only_our_console_commands_are_installed():
    scripts = importlib.metadata.distribution(DISTRIBUTION).entry_points
    assert {script.name for script in scripts} == {"lerobot-uca-collect", "lerobot-uca-export"}


def test_a_wheel_holds_the_package_and_nothing_else(tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, check=True, capture_output=True, cwd=SOURCE.parent.parent)
    (wheel,) = tmp_path.glob("*.whl")
    names = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    assert {name.split("/")[0] for name in names} == {"lerobot_uca", "lerobot_policy_uca_flow.py"}
    assert len(names) == len(list(SOURCE.rglob("*.py"))) + 1


def test_lerobot_discovers_everything_in_a_fresh_interpreter():
    code = """
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
assert {"uca_flow", "dp3", "simple_dp3", "flow", "mp1"} <= set(PreTrainedConfig.get_known_choices())
assert {"metaworld_pointcloud", "adroit_pointcloud"} <= set(EnvConfig.get_known_choices())
assert hasattr(LeRobotDataset, "__getitems__")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_a_broken_part_never_takes_another_one_down():
    """Without Meta-World's or fpsample's wheel the policy must still be there."""
    code = """
import sys
sys.modules["fpsample"] = None
import lerobot_policy_uca_flow
from lerobot.policies.factory import get_policy_class
assert get_policy_class("uca_flow").__name__ == "UCAFlowPolicy"
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "lerobot_uca.envs.configs is not available" in result.stderr
