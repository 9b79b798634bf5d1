"""Simple DP3 as a LeRobot policy (https://arxiv.org/abs/2403.03954)."""

from lerobot_uca.policies.configuration_simple_dp3 import SimpleDP3Config
from lerobot_uca.policies.modeling_dp3 import DP3Policy


class SimpleDP3Policy(DP3Policy):
    """DP3 with a smaller U-Net; only the configuration differs."""

    config_class = SimpleDP3Config
    name = "simple_dp3"
