"""Pre- and postprocessing of MP1: all point-cloud policies' own, under the name that LeRobot looks for."""

from lerobot_uca.policies.processor_base import make_processors as make_mp1_pre_post_processors

__all__ = ["make_mp1_pre_post_processors"]
