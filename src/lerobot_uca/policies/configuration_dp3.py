"""Configuration of DP3."""

from dataclasses import dataclass
from typing import override

from lerobot.configs import NormalizationMode, PreTrainedConfig

from lerobot_uca.bounds import within
from lerobot_uca.errors import UserError
from lerobot_uca.inference.backends import BACKENDS
from lerobot_uca.policies.configuration_unet import UNetPolicyConfig
from lerobot_uca.registry import register


@register(PreTrainedConfig, "dp3")
@dataclass
class DP3Config(UNetPolicyConfig):
    """Configuration of `DP3Policy`."""

    # Diffusion steps of training.
    n_training_steps: int = within(100, least=1, most=10_000)
    # Network calls of a prediction.
    n_inference_steps: int = within(10, least=1, most=10_000)

    @override
    def validate_sizes(self) -> None:
        super().validate_sizes()
        mode = self.normalization_mapping.get("ACTION", NormalizationMode.IDENTITY)
        if mode is not NormalizationMode.MIN_MAX:
            raise UserError(
                f"policy.normalization_mapping must have ACTION: MIN_MAX for '{self.type}', whose samples are clipped "
                f"to [-1, 1] as in the baselines' code, got {mode.value}: many actions would be out of reach."
            )
        # diffusers' steps are n_training_steps // n_inference_steps apart and end at 0. Where one number divides the
        # other they begin one such distance before pure noise; of 100, 51 would begin 49 of them before, and one alone
        # at 0, where the network takes pure noise for nearly clean actions.
        if self.n_training_steps % self.n_inference_steps or self.n_inference_steps < min(2, self.n_training_steps):
            raise UserError(
                f"policy.n_inference_steps must be at least 2 and divide n_training_steps = {self.n_training_steps}, "
                f"got {self.n_inference_steps}."
            )
        if self.inference == "compile":
            others = ", ".join(name for name in BACKENDS if name != "compile")
            raise UserError(
                "policy.inference=compile is for policies of one network call (uca_flow, flowpolicy, mp1): the steps "
                f"of '{self.type}' do not compile as one function. It must be one of {others}."
            )
