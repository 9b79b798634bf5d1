"""Pre- and postprocessing of UCA-Flow: all point-cloud policies' own, under the name that LeRobot looks for."""

from lerobot_uca.policies.processor_base import (
    make_processors as make_uca_flow_pre_post_processors,
)

__all__ = ["make_uca_flow_pre_post_processors"]
