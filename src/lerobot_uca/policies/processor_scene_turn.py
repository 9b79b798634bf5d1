"""The preprocessor step that turns training's scenes about the vertical through the hand.

Letters: B samples, O observation steps, N points, C channels, S state dimensions, T horizon, A action dimensions.
"""

from dataclasses import dataclass
from typing import override

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.distributed import independent_draws
from lerobot_uca.policies.processor_step import SameFeaturesStep, training_clouds


def scene_turn_steps(config: PointCloudPolicyConfig) -> list[ProcessorStep]:
    """The step that a policy's configuration asks for, or none."""
    turn, hand = config.scene_turn, config.hand_position
    if not turn.degrees:
        return []
    assert hand is not None  # the configuration's own check
    return [SceneTurnProcessorStep(turn.degrees, list(hand[:2]), list(turn.states or ()), list(turn.actions or ()))]


@dataclass
@ProcessorStepRegistry.register(name="scene_turn_processor")
class SceneTurnProcessorStep(SameFeaturesStep):
    """Turns a sample's clouds, states and actions as one, in training only.

    A robot in the turned scene, its hand at the same place, would move as the demonstration does, turned. What the
    environment has clipped of the expert's action is turned as it was clipped, and may lie outside [-1, 1]. The step
    stands before the normaliser, where lengths are metres. Draws come from PyTorch's generator, which `seed` sets and a
    checkpoint restores.

    Args:
        degrees: the largest turn to either side [deg].
        hand: the state's dimensions that are the hand's x and y.
        states: those that are x and y of positions, the hand's among them, pair by pair.
        actions: the action's that are x and y of motions, pair by pair.
    """

    degrees: float
    hand: list[int]
    states: list[int]
    actions: list[int]

    @override
    def __call__(self, transition: EnvTransition) -> EnvTransition:
        cloud = training_clouds(transition)
        if cloud is None or OBS_STATE not in transition[TransitionKey.OBSERVATION]:
            return transition
        observation, action = transition[TransitionKey.OBSERVATION], transition[TransitionKey.ACTION]
        with independent_draws(cloud.device):
            angle = torch.deg2rad(self.degrees * cloud.new_empty(len(cloud)).uniform_(-1, 1))
        cloud, state, action = self.turned(cloud, observation[OBS_STATE], action, angle)
        turned = {**observation, OBS_POINT_CLOUD: cloud, OBS_STATE: state}
        return {**transition, TransitionKey.OBSERVATION: turned, TransitionKey.ACTION: action}

    def turned(self, cloud: Tensor, state: Tensor, action: Tensor, angle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Clouds (B, O, N, C), states (B, O, S) and actions (B, T, A), turned by angles (B,) [rad] to the left."""
        cos, sin = angle.cos(), angle.sin()
        R = torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2))[:, None]  # (B, 1, 2, 2)
        hand = state[:, -1:, None, self.hand]  # the newest, (B, 1, 1, 2)
        xy = (cloud[..., :2] - hand) @ R.mT + hand
        positions = (state[..., self.states].unflatten(-1, (-1, 2)) - hand) @ R.mT + hand
        motions = action[..., self.actions].unflatten(-1, (-1, 2)) @ R.mT
        state, action = state.clone(), action.clone()
        state[..., self.states], action[..., self.actions] = positions.flatten(-2), motions.flatten(-2)
        return torch.cat([xy, cloud[..., 2:]], dim=-1), state, action
