"""UCA-Flow as a LeRobot policy."""

from torch import Tensor, nn

from lerobot_uca.meanflow import meanflow_losses, one_step_sample
from lerobot_uca.networks.conditioning import CONDITIONING
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_base import MethodLoss, PointCloudPolicy


class UCAFlowPolicy(PointCloudPolicy):
    """Unified condition-action modelling with dual-pass supervision: one network call makes a chunk of actions."""

    config_class = UCAFlowConfig
    name = "uca_flow"
    config: UCAFlowConfig

    def make_generator(self) -> nn.Module:
        """The Unified Condition-Action Transformer, or what an ablation puts in its place."""
        config = self.config
        return CONDITIONING[config.conditioning](
            horizon=config.horizon,
            n_actions=config.n_actions,
            n_obs_steps=config.n_obs_steps,
            n_obs_features=config.n_obs_features,
            dim=config.dim,
            n_layers=config.n_layers,
            n_heads=config.n_heads,
            n_timestep_tokens=config.n_timestep_tokens,
            n_interval_tokens=config.n_interval_tokens,
        )

    def compute_loss(self, generator: nn.Module, x: Tensor, o: Tensor, mask: Tensor) -> MethodLoss:
        """The dual-pass loss over u and v, or the u branch alone."""
        losses = meanflow_losses(
            generator,
            x,
            o,
            mask,
            gamma=self.config.gamma,
            c=self.config.c,
            interval_mean=self.config.interval_mean,
            interval_std=self.config.interval_std,
            supervise_v=self.config.dual_pass,
        )
        if losses.v is None:
            return MethodLoss(losses.u, {"loss_u": losses.u})
        return MethodLoss(losses.u + losses.v, {"loss_u": losses.u, "loss_v": losses.v})

    def generate(self, generator: nn.Module, noise: Tensor, o: Tensor) -> Tensor:
        """One step, one network call."""
        return one_step_sample(generator, noise, o)
