"""Pre- and postprocessing of MP1: LeRobot's own, under the name that LeRobot looks for."""

from lerobot.processor import make_default_pre_post_processors as make_mp1_pre_post_processors

__all__ = ["make_mp1_pre_post_processors"]
