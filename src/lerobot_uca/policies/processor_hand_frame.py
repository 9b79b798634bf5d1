"""The preprocessor step that shows clouds as the robot's hand sees them.

Letters: B samples, O observation steps, N points, C channels, S state dimensions.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, override

import numpy as np
import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.processor_step import SameFeaturesStep


def hand_frame_steps(config: PointCloudPolicyConfig, state_statistics: Mapping[str, Any]) -> list[ProcessorStep]:
    """The step that a policy's configuration asks for, or none.

    Args:
        config: of the policy, with its features.
        state_statistics: of the robot's state, each (S,).

    Raises:
        UserError: if the hand's mean position is not among them.
    """
    if config.hand_position is None:
        return []
    if "mean" not in state_statistics:
        raise UserError(
            f"policy.hand_position needs 'mean' of '{OBS_STATE}', which is not among the statistics "
            f"{', '.join(state_statistics) or '(none)'}. lerobot-uca-edit-dataset --operation.type=recompute_stats "
            "makes it."
        )
    dimensions = list(config.hand_position)
    values = np.asarray(state_statistics["mean"], dtype=np.float64)
    if values.shape != (config.n_states,) or not np.isfinite(values).all():
        raise UserError(
            f"policy.hand_position needs 'mean' of '{OBS_STATE}' as {config.n_states} finite numbers, got {values}."
        )
    mean = values[dimensions]
    return [HandFrameProcessorStep(dimensions, mean.tolist())]


@dataclass
@ProcessorStepRegistry.register(name="hand_frame_processor")
class HandFrameProcessorStep(SameFeaturesStep):
    """Moves each cloud (..., N, C) as if the hand were at its mean position; the state (..., S) stays as it is.

    What matters for the next motion is where things are from the hand. In the world's frame the encoder must learn that
    difference from as few object positions as there are demonstrations; seen from the hand every step shows another
    one. The mean keeps the points where the normaliser's statistics, of clouds in the world's frame, expect them.

    Args:
        dimensions: of the state that hold the hand's x, y and z in the clouds' frame [m].
        mean: of the hand's positions in the data [m].
    """

    dimensions: list[int]
    mean: list[float]

    @override
    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        if OBS_POINT_CLOUD not in observation or OBS_STATE not in observation:  # the policy says what is missing
            return transition
        moved = self.seen_from_hand(observation[OBS_POINT_CLOUD], observation[OBS_STATE])
        return {**transition, TransitionKey.OBSERVATION: {**observation, OBS_POINT_CLOUD: moved}}

    def seen_from_hand(self, cloud: Tensor, state: Tensor) -> Tensor:
        """Clouds (..., N, C), xyz first [m], of states (..., S), or of one state (S,), which gets its batch later."""
        if state.shape[-1] <= max(self.dimensions):  # the policy says which shape it needs
            return cloud
        motion = state.new_tensor(self.mean) - state[..., self.dimensions]
        xyz = cloud[..., :3] + motion.unsqueeze(-2)
        return xyz if cloud.shape[-1] == 3 else torch.cat([xyz, cloud[..., 3:]], dim=-1)
