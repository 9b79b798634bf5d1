"""What a checkpoint may hold. It stands alone, so that nothing that fails elsewhere takes it down."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from lerobot.policies import factory as policy_factory
from lerobot.processor import DataProcessorPipeline

from lerobot_uca.checkpoints.steps import check_steps
from lerobot_uca.errors import reported
from lerobot_uca.lerobot_patches.replacing import replace, replace_class_method
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.processor_base import load_processors

_of_point_cloud_policy: ContextVar[bool] = ContextVar("of_point_cloud_policy", default=False)


def make_registered_steps_only() -> None:
    """A checkpoint cannot name code to run; see `checkpoints/steps.py`. LeRobot imports and calls whatever it names."""

    def checked(build: Callable[..., Any]) -> Callable[..., Any]:
        def build_steps(cls: type, loaded_config: dict[str, Any], overrides: dict[str, Any]) -> Any:
            check_steps(loaded_config, of_point_cloud_policy=_of_point_cloud_policy.get())
            return build(cls, loaded_config, overrides)

        return build_steps

    def known(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_pre_post_processors(policy_cfg: Any, pretrained_path: Any = None, *args: Any, **kwargs: Any) -> Any:
            if pretrained_path is None or not isinstance(policy_cfg, PointCloudPolicyConfig):
                return make(policy_cfg, pretrained_path, *args, **kwargs)
            token = _of_point_cloud_policy.set(True)
            try:
                with reported(f"The processors of '{pretrained_path}' cannot be loaded"):
                    return load_processors(make, policy_cfg, pretrained_path, *args, **kwargs)
            finally:
                _of_point_cloud_policy.reset(token)

        return make_pre_post_processors

    replace_class_method(DataProcessorPipeline, "_build_steps_from_config", checked)
    replace(policy_factory.make_pre_post_processors, known)
