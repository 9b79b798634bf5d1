"""Pre- and postprocessing of FlowPolicy: all point-cloud policies' own, under the name that LeRobot looks for."""

from lerobot_uca.policies.processor_base import (
    make_processors as make_flowpolicy_pre_post_processors,
)

__all__ = ["make_flowpolicy_pre_post_processors"]
