"""Engines that compute networks at inference: PyTorch, traced runtimes, torch.compile."""

import sys

# Imported with OpenVINO, it starts a process that reports the use to Google Analytics. OpenVINO does without it.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
