"""MP1 as a LeRobot policy (https://arxiv.org/abs/2507.10543)."""

from torch import Tensor, nn

from lerobot_uca.networks.unet1d import IntervalUNet
from lerobot_uca.objectives.guided_meanflow import guided_meanflow_losses, one_step_sample
from lerobot_uca.policies.configuration_mp1 import MP1Config
from lerobot_uca.policies.modeling_base import MethodLoss, PointCloudPolicy


class MP1Policy(PointCloudPolicy):
    """MeanFlow with DP3's U-Net: one network call makes a chunk of actions."""

    config_class = MP1Config
    name = "mp1"
    config: MP1Config

    def make_generator(self) -> nn.Module:
        """The U-Net. MP1's also holds a network of 528 385 parameters that nothing calls; not here."""
        return IntervalUNet(**self.config.unet_sizes)

    def compute_loss(self, generator: nn.Module, x: Tensor, o: Tensor, mask: Tensor) -> MethodLoss:
        """The error of the average velocity and the dispersive loss."""
        config = self.config
        losses = guided_meanflow_losses(
            generator, x, o, mask, c=config.c, interval_mean=config.interval_mean, interval_std=config.interval_std
        )
        total = losses.u + config.dispersive_weight * losses.dispersive
        return MethodLoss(total, {"loss_u": losses.u, "loss_dispersive": losses.dispersive})

    def generate(self, generator: nn.Module, noise: Tensor, o: Tensor) -> Tensor:
        """One step, one network call."""
        return one_step_sample(generator, noise, o)
