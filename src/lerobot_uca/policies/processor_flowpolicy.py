"""Pre- and postprocessing of FlowPolicy: LeRobot's own, under the name that LeRobot looks for."""

from lerobot.processor import make_default_pre_post_processors as make_flowpolicy_pre_post_processors

__all__ = ["make_flowpolicy_pre_post_processors"]
