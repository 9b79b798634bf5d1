"""The processor steps that a checkpoint may have. It comes from somewhere else, and must not choose code to run.

LeRobot imports whatever a step of `policy_preprocessor.json` names (`{"class": "os.system"}`) and calls it with the
step's settings. Some of its registered steps load models by name and run the Python code that lies beside them
(`trust_remote_code`). Both are refused here before anything is imported or made; policies of others may also name steps
of an installed plugin that has not registered them, whose module is then imported.
"""

import importlib
import sys
from typing import Any

from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from lerobot_uca.errors import UserError, reported

LEROBOT_STEPS = (
    *("rename_observations_processor", "device_processor", "normalizer_processor", "unnormalizer_processor"),
    *("to_batch_processor", "to_batch_processor_action", "to_batch_processor_observation"),
    *("to_batch_processor_complementary_data", "relative_actions_processor", "absolute_actions_processor"),
)
"""LeRobot's own steps that a point-cloud policy may load: they only compute."""

PLUGINS = ("lerobot_robot_", "lerobot_camera_", "lerobot_teleoperator_", "lerobot_policy_", "lerobot_env_")
"""How the modules begin that LeRobot imports by itself, where they are installed."""


def check_steps(config: Any, *, of_point_cloud_policy: bool) -> None:
    """Raise a `UserError` for a step that must not be made, by its name.

    Args:
        config: the content of a pipeline's JSON file.
        of_point_cloud_policy: then only `LEROBOT_STEPS` and what an installed plugin has registered are allowed. Other
            policies may have any registered step, and any whose class the program has imported by itself or an
            installed plugin holds.
    """
    for entry in config["steps"]:
        if not of_point_cloud_policy:
            _import_from_plugin(entry)
        name, step = _find(entry)
        if step is None:
            raise UserError(
                f"The checkpoint's processor step '{name}' is not registered by LeRobot or an installed plugin; "
                "it was not run."
            )
        is_lerobots = step.__module__.partition(".")[0] == "lerobot"
        if of_point_cloud_policy and (name not in LEROBOT_STEPS if is_lerobots else not _is_registered(step)):
            raise UserError(
                f"The checkpoint's processor step '{name}' must not be part of a point-cloud policy; "
                f"it was not run. Allowed are {', '.join(LEROBOT_STEPS)} and the steps of installed plugins."
            )
        file = entry.get("state_file", "")
        if not isinstance(file, str) or set(file) & set("/\\\0") or file == "..":
            raise UserError(f"The checkpoint's processor step '{name}' asks for a file outside its folder: '{file}'.")


def _import_from_plugin(entry: Any) -> None:
    """Import the module of an unregistered step, as LeRobot does, if it is part of a plugin that LeRobot has loaded."""
    if not isinstance(entry, dict) or "registry_name" in entry:
        return
    module = str(entry.get("class")).rpartition(".")[0]
    plugin, *inside = module.split(".")
    if plugin in sys.modules and plugin.startswith(PLUGINS) and "__main__" not in inside:  # which would run a program
        with reported(f"The checkpoint's processor step '{entry['class']}' cannot be imported from its plugin"):
            importlib.import_module(module)


def _find(entry: Any) -> tuple[str, type | None]:
    """A step's name and class, without importing anything."""
    if not isinstance(entry, dict):
        return str(entry), None
    if "registry_name" in entry:
        name = entry["registry_name"]
        known = isinstance(name, str) and name in ProcessorStepRegistry.list()
        return str(name), ProcessorStepRegistry.get(name) if known else None
    path = str(entry.get("class"))
    module, _, name = path.rpartition(".")
    step = vars(sys.modules.get(module, object)).get(name)  # not getattr: a lazy module would import something
    if not (isinstance(step, type) and issubclass(step, ProcessorStep)):
        return path, None
    return getattr(step, "_registry_name", path), step


def _is_registered(step: type) -> bool:
    name = getattr(step, "_registry_name", None)
    return name in ProcessorStepRegistry.list() and ProcessorStepRegistry.get(name) is step
