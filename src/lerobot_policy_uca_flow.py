"""The module LeRobot imports by the distribution's name: it makes LeRobot know this package and does nothing else."""

import importlib
import logging

from lerobot_uca.lerobot_version import is_supported, warn_of_another

logger = logging.getLogger(__name__)
_missing: list[str] = []
"""Parts that cannot be imported."""


def _load(part: str) -> object | None:
    """Import a part. Whatever goes wrong in one part must never take another one down."""
    try:
        return importlib.import_module(f"lerobot_uca.{part}")
    except Exception as error:  # noqa: BLE001
        _missing.append(part)
        level = logging.WARNING if is_supported() else logging.DEBUG  # another LeRobot's line names all of them
        logger.log(level, "lerobot_uca.%s is not available: %s: %s", part, type(error).__name__, error)
        return None


for _part in (
    "policies.configuration_uca_flow",
    "policies.configuration_dp3",
    "policies.configuration_simple_dp3",
    "policies.configuration_flowpolicy",
    "policies.configuration_mp1",
    "policies.processor_base",
    "envs.configs",
    "robots.ur5e.config_ur5e_follower",
    "robots.ur5e.sim.config_simulated_camera",
    "robots.ur5e.sim.config_scripted_teleoperator",
):
    _load(_part)

_guard = _load("lerobot_patches.guard")
_patches = _load("lerobot_patches.install")
try:
    if _guard is not None:
        _guard.make_registered_steps_only()  # type: ignore[attr-defined]
    elif is_supported():
        raise ImportError("lerobot_policy_uca_flow: without its check of checkpoints one could run code.")
finally:
    if _patches is not None:
        _patches.install()  # type: ignore[attr-defined]
if not is_supported():
    warn_of_another(_missing)
