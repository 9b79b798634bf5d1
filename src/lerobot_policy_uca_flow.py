"""The module LeRobot imports by the distribution's name: it makes LeRobot know this package and does nothing else.

It registers policies and environments, gives datasets batched reading, and keeps the terminal readable.
"""

import importlib
import logging

from lerobot_uca.terminal import quiet_video_decoder, report_errors_in_one_line

report_errors_in_one_line()
quiet_video_decoder()

# A missing optional dependency of one part must never take another part down.
for part in (
    "policies.configuration_uca_flow",
    "policies.configuration_dp3",
    "policies.configuration_simple_dp3",
    "policies.configuration_flow",
    "policies.configuration_mp1",
    "envs.configs",
    "data.reading",
    "training",
):
    try:
        importlib.import_module(f"lerobot_uca.{part}")
    except ImportError as error:
        logging.getLogger(__name__).warning("lerobot_uca.%s is not available: %s", part, error)
