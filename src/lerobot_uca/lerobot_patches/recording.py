"""What `lerobot-eval` records."""

import sys
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from lerobot_uca.features import ENV_NAMES, OBS_POINT_CLOUD, POINT_CLOUD, observation_info
from lerobot_uca.lerobot_patches.replacing import replace

EVALUATION_MODULES = ("lerobot.scripts.lerobot_eval", "__main__")

evaluated_observation: ContextVar[str] = ContextVar("evaluated_observation", default=POINT_CLOUD)
"""That of the policy which this process evaluates."""


def record_what_can_be_trained() -> None:
    """`lerobot-eval --eval.recording=true` names features as policies do. LeRobot takes the environment's names.

    With those (point_cloud, agent_pos) nothing can be trained, and nothing renames them. Nor would the dataset say that
    its clouds are without the robot.
    """
    evaluation = next((sys.modules[name] for name in EVALUATION_MODULES if name in sys.modules), None)
    if evaluation is None or not hasattr(evaluation, "_build_raw_frame"):  # no evaluation in this process
        return

    def features(make: Callable[..., Any]) -> Callable[..., Any]:
        return lambda env_features: _labelled(_renamed(make(env_features)))

    def frame(build: Callable[..., Any]) -> Callable[..., Any]:
        return lambda raw_obs, *args, **kwargs: build(_renamed(raw_obs), *args, **kwargs)

    replace(evaluation._env_features_to_dataset_features, features)
    replace(evaluation._build_raw_frame, frame)


def _renamed(values: dict[str, Any]) -> dict[str, Any]:
    """Observations or features of this package's environments under the policies' names; others' as they are."""
    is_ours = values.keys() >= ENV_NAMES.keys()
    return {ENV_NAMES.get(key, key) if is_ours else key: value for key, value in values.items()}


def _labelled(features: dict[str, Any]) -> dict[str, Any]:
    if OBS_POINT_CLOUD in features:
        features[OBS_POINT_CLOUD]["info"] = observation_info(evaluated_observation.get())
    return features
