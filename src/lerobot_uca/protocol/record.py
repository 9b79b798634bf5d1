"""The origin of a result: versions, commit, hardware."""

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

from lerobot_uca.processes import n_cores

PACKAGES = (
    *("lerobot", "lerobot_policy_uca_flow", "torch", "openvino", "onnxruntime"),
    *("numpy", "mujoco", "metaworld", "gymnasium-robotics"),
)
COLUMNS = ("command", "commit", "versions", "cpu")
"""The last columns of a measured row."""


def provenance(device: str = "cpu") -> dict[str, Any]:
    """Versions of packages, commit of this package and hardware, as plain values.

    Args:
        device: that computed; a GPU that did not has no part in the result.
    """
    import torch

    on_gpu = torch.device(device).type == "cuda" and torch.cuda.is_available()
    return {
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "commit": commit(),
        "hardware": {
            "cpu": _cpu(),
            "cores": n_cores(),
            "gpu": torch.cuda.get_device_name(device) if on_gpu else None,
            "threads": torch.get_num_threads(),
        },
    }


def columns(command: str, device: str = "cpu") -> dict[str, str]:
    """The same as a row's last columns, `COLUMNS`.

    Args:
        command: what was typed.
        device: that computed; a GPU's name follows the processor's.
    """
    made = provenance(device)
    hardware, versions = made["hardware"], made["versions"].items()
    return {
        "command": command,
        "commit": made["commit"] or "unknown",
        "versions": ", ".join(f"{name} {version}" for name, version in versions if version),
        "cpu": f"{hardware['cpu']}, {hardware['cores']} cores" + (f", {hardware['gpu']}" if hardware["gpu"] else ""),
    }


def commit() -> str | None:
    """The commit this package is at, with '-dirty' if files were changed; None if it is not a checkout."""
    try:
        _git("ls-files", "--error-unmatch", Path(__file__).name)  # it may be installed inside another's checkout
        return _git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    folder = Path(__file__).parent
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
