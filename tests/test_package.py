"""The package's parts, its wheel and its discovery by LeRobot."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "lerobot_uca"
DISTRIBUTION = "lerobot_policy_uca_flow"

# The modules or folders that each may import from this package. Imports run one way; unlisted ones are leaves.
ALLOWED = {
    "inference": {"errors"},
    "objectives": {"meanflow", "networks"},
    "bounds": {"errors"},
    "hub": {"errors"},
    "policies": {
        *("bounds", "meanflow", "objectives", "networks", "inference", "point_clouds"),
        *("errors", "features", "hub", "registry"),
    },
    "envs": {"bounds", "point_clouds", "errors", "features", "registry"},
    "data": {"bounds", "envs", "point_clouds", "errors", "features", "hub", "processes"},
    "robots": {"point_clouds", "errors", "features", "registry", "processes"},
    "visual": {"bounds", "policies", "data", "envs", "robots", "point_clouds", "errors", "features"},
    "deploy": {"policies", "inference", "errors", "features"},
    "protocol": {"policies", "data", "envs", "errors", "features", "processes"},
    "checkpoints": {"data", "errors"},
    "lerobot_patches": {"checkpoints", "configs", "data", "policies", "errors", "features", "hub", "processes"},
    "commands": {"data", "deploy", "protocol", "robots", "visual", "errors", "processes"},
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
    assert {script.name for script in scripts} == {
        "lerobot-uca-benchmark",
        "lerobot-uca-calibrate",
        "lerobot-uca-collect",
        "lerobot-uca-convert",
        "lerobot-uca-edit-dataset",
        "lerobot-uca-export",
        "lerobot-uca-saliency",
        "lerobot-uca-ur5e-sim",
        "lerobot-uca-view",
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, check=True, capture_output=True, cwd=SOURCE.parent.parent)
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_a_wheel_holds_the_package_and_nothing_else(wheel):
    names = [name for name in wheel.namelist() if ".dist-info/" not in name]
    assert {name.split("/")[0] for name in names} == {"lerobot_uca", "lerobot_policy_uca_flow.py"}
    assert len(names) == sum(len(list(SOURCE.rglob(kind))) for kind in ("*.py", "*.yaml")) + 1
    assert {"lerobot_uca/configs/uca_flow_small.yaml", "lerobot_uca/configs/uca_flow_paper.yaml"} <= set(names)


def test_the_wheels_readme_has_no_links_into_the_repository(wheel):
    (metadata,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    text = wheel.read(metadata).decode()
    assert "(https://arxiv.org/abs/2403.03954)" in text
    assert not re.findall(r"\]\((?!https?://)", text)
    assert "docs/README.md" not in text
    assert "meanflow.py" in text


def test_lerobot_discovers_everything_in_a_fresh_interpreter():
    code = """
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.datasets import factory
from lerobot.robots import RobotConfig
assert "ur5e_follower" in RobotConfig.get_known_choices()
assert {"uca_flow", "dp3", "simple_dp3", "flowpolicy", "mp1"} <= set(PreTrainedConfig.get_known_choices())
assert {"metaworld_pointcloud", "adroit_pointcloud"} <= set(EnvConfig.get_known_choices())
assert hasattr(factory.LeRobotDataset, "__getitems__")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def load(before: str, after: str) -> subprocess.CompletedProcess[str]:
    code = f"{before}\nimport lerobot_policy_uca_flow\n{after}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


BREAKS = {
    "a missing wheel": 'import sys; sys.modules["mujoco"] = None',
    "any exception": """
import builtins
original = builtins.__import__
def fail(name, *args, **kwargs):
    if name == "mujoco":
        raise RuntimeError("built for another NumPy")
    return original(name, *args, **kwargs)
builtins.__import__ = fail
""",
}


@pytest.mark.parametrize("before", BREAKS.values(), ids=BREAKS)
def test_a_broken_part_never_takes_another_one_down(before):
    """Without Meta-World's or MuJoCo's wheel the policy must still be there."""
    after = """
from lerobot.policies.factory import get_policy_class
assert get_policy_class("uca_flow").__name__ == "UCAFlowPolicy"
"""
    result = load(before, after)
    assert result.returncode == 0, result.stderr
    assert "lerobot_uca.envs.configs is not available" in result.stderr


@pytest.mark.parametrize("engine", ["openvino", "onnxruntime"])
def test_without_an_engine_every_policy_registers_and_pytorch_computes(engine):
    after = f"""
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
assert {{"uca_flow", "dp3", "simple_dp3", "flowpolicy", "mp1"}} <= set(PreTrainedConfig.get_known_choices())
state = lambda *shape: PolicyFeature(FeatureType.STATE, shape)
inputs = {{"observation.point_cloud": state(8, 3), "observation.state": state(2)}}
outputs = {{"action": PolicyFeature(FeatureType.ACTION, (2,))}}
for _ in range(2):
    config = UCAFlowConfig(
        device="cpu", input_features=inputs, output_features=outputs, dim=16, n_heads=2, inference="{engine}"
    )
    policy = UCAFlowPolicy(config).eval()
    observation = {{"observation.point_cloud": torch.rand(1, 8, 3), "observation.state": torch.rand(1, 2)}}
    action = policy.select_action(observation)
    assert action.isfinite().all()
"""
    result = load(f'import sys; sys.modules["{engine}"] = None', after)
    assert result.returncode == 0, result.stderr
    assert result.stderr.count(f"policy.inference={engine} needs the package {engine}") == 1


def test_a_type_that_another_plugin_has_registered_stays_theirs():
    before = """
from dataclasses import dataclass
from lerobot.configs import PreTrainedConfig
@PreTrainedConfig.register_subclass("dp3")
@dataclass
class ForeignConfig(PreTrainedConfig):
    pass
"""
    after = """
assert PreTrainedConfig.get_choice_class("dp3") is ForeignConfig
assert {"uca_flow", "simple_dp3", "flowpolicy", "mp1"} <= set(PreTrainedConfig.get_known_choices())
from lerobot.envs.configs import EnvConfig
assert {"metaworld_pointcloud", "adroit_pointcloud"} <= set(EnvConfig.get_known_choices())
"""
    result = load(before, after)
    assert result.returncode == 0, result.stderr
    assert "Type 'dp3' is registered by __main__ already; this package's DP3Config is left out." in result.stderr
