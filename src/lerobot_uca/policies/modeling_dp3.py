"""DP3 as a LeRobot policy (https://arxiv.org/abs/2403.03954)."""

from functools import cached_property

from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from torch import Tensor, nn

from lerobot_uca.networks.unet1d import TimeUNet
from lerobot_uca.objectives.diffusion import ddim_sample, diffusion_loss, make_scheduler
from lerobot_uca.policies.configuration_dp3 import DP3Config
from lerobot_uca.policies.modeling_base import MethodLoss, PointCloudPolicy


class DP3Policy(PointCloudPolicy):
    """3D Diffusion Policy: a U-Net that predicts clean actions, called once a DDIM step."""

    config_class = DP3Config
    name = "dp3"
    config: DP3Config

    @cached_property
    def scheduler(self) -> DDIMScheduler:
        """The noise schedule."""
        return make_scheduler(self.config.n_training_steps)

    def make_generator(self) -> nn.Module:
        """The U-Net, at its full or at Simple DP3's size."""
        return TimeUNet(**self.config.unet_sizes)

    def compute_loss(self, generator: nn.Module, x: Tensor, o: Tensor, mask: Tensor) -> MethodLoss:
        """The squared error of the predicted clean actions."""
        return MethodLoss(diffusion_loss(generator, self.scheduler, x, o, mask), {})

    def generate(self, generator: nn.Module, noise: Tensor, o: Tensor) -> Tensor:
        """DDIM, n_inference_steps network calls."""
        return ddim_sample(generator, self.scheduler, noise, o, n_steps=self.config.n_inference_steps)
