"""Pre- and postprocessing of DP3: LeRobot's own, under the name that LeRobot looks for."""

from lerobot.processor import make_default_pre_post_processors as make_dp3_pre_post_processors

__all__ = ["make_dp3_pre_post_processors"]
