"""FlowPolicy as a LeRobot policy (https://arxiv.org/abs/2412.04987)."""

from torch import Tensor, nn

from lerobot_uca.networks.unet1d import TimeUNet
from lerobot_uca.objectives.consistency_flow import consistency_flow_loss, one_euler_step
from lerobot_uca.policies.configuration_flowpolicy import FlowConfig
from lerobot_uca.policies.modeling_base import MethodLoss, PointCloudPolicy


class FlowPolicy(PointCloudPolicy):
    """Consistency flow matching with DP3's U-Net: one network call makes a chunk of actions."""

    config_class = FlowConfig
    name = "flowpolicy"
    config: FlowConfig

    def make_generator(self) -> nn.Module:
        """The U-Net. FlowPolicy's also holds a network of 528 385 parameters that nothing calls; not here."""
        return TimeUNet(**self.config.unet_sizes)

    def compute_loss(self, generator: nn.Module, x: Tensor, o: Tensor, mask: Tensor) -> MethodLoss:
        """The consistency of two neighbouring times."""
        config = self.config
        loss = consistency_flow_loss(
            generator,
            x,
            o,
            mask,
            t_min=config.t_min,
            delta=config.delta,
            n_segments=config.n_segments,
            alpha=config.alpha,
        )
        return MethodLoss(loss, {})

    def generate(self, generator: nn.Module, noise: Tensor, o: Tensor) -> Tensor:
        """One Euler step, one network call."""
        return one_euler_step(generator, noise, o, t_min=self.config.t_min)
