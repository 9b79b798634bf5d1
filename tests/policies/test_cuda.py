"""What a GPU would show and this machine has not: no operation mixes devices (fake_cuda.py; kernels are not run)."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.processor import device_processor
from tests.builders import SMALL_POLICIES, make_batch, make_config, make_observation, make_settings, make_statistics
from tests.depth_builders import DEPTH_KEY, live_frame, make_recipe
from tests.fake_cuda import fake_cuda, move, moved

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.augmentation_config import AugmentationConfig, SceneTurnConfig
from lerobot_uca.policies.processor_base import make_processors
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep

pytestmark = pytest.mark.skipif(
    not hasattr(torch._C, "_ensureCUDADeviceGuardSet"), reason="this version of PyTorch asks the driver for its devices"
)

METHODS = [
    *((kind, {}) for kind in SMALL_POLICIES),
    *(("uca_flow", {"conditioning": name}) for name in ("cross_attention", "adaln")),
    ("uca_flow", {"dual_pass": False}),
]
HAND = {"hand_position": (0, 1, 2)}
TURN = {**HAND, "scene_turn": SceneTurnConfig(degrees=10.0, states=(0, 1), actions=(0, 1))}
AUGMENTED = {"augmentation": AugmentationConfig(jitter=0.01, drop=0.2, camera_shift=0.01)}


def on_gpu(batch):
    return {key: moved(value) for key, value in batch.items()}


@pytest.mark.parametrize(("kind", "options"), METHODS)
def test_losses_and_actions(kind, options):
    """The same numbers as the CPU's where noise is given, and no device mixed."""
    config = make_policy_config(kind, **make_settings(), **SMALL_POLICIES[kind], inference="eager", **options)
    policy = get_policy_class(kind)(config)
    batch, observations = make_batch(config), [make_observation(2) for _ in range(5)]
    noise = torch.randn(2, config.horizon, config.n_actions)
    policy.eval()
    expected = [policy.select_action(observation, noise=noise) for observation in observations]
    with fake_cuda():
        move(policy)
        loss, parts = policy.train().forward(on_gpu(batch))
        assert loss.device.type == "cuda"
        assert np.isfinite(list(parts.values())).all()
        assert policy.eval().forward(on_gpu(batch))[0].device.type == "cuda"
        policy.reset()
        for observation, action in zip(observations, expected, strict=True):
            made = policy.select_action(on_gpu(observation), noise=noise)
            assert made.device.type == "cuda"
            torch.testing.assert_close(made.cpu(), action)
        policy.train().update()


@pytest.fixture
def _devices(monkeypatch):
    """The device step takes the GPU for there."""
    monkeypatch.setattr(device_processor, "get_safe_torch_device", lambda device, log=False: torch.device(device))


@pytest.mark.usefixtures("_devices")
@pytest.mark.parametrize("options", [{}, {"n_points": 16}, HAND, TURN, AUGMENTED], ids=str)
def test_preprocessors(options):
    """In training and on the robot LeRobot moves everything before; an environment's observation is on the CPU."""
    config = make_config(**options)
    config.device = "cuda:0"
    batch = make_batch(config)
    with fake_cuda():
        preprocessor, postprocessor = make_processors(config, make_statistics())
        for observed in (on_gpu(batch), make_observation(2), on_gpu(make_observation(1))):
            processed = preprocessor(observed)
            assert processed[OBS_POINT_CLOUD].device.type == processed["observation.state"].device.type == "cuda"
        assert postprocessor(moved(torch.randn(2, config.n_actions))).device.type == "cpu"


@pytest.mark.usefixtures("_devices")
@pytest.mark.parametrize("options", [{}, HAND, TURN], ids=str)
def test_depth_images(options):
    config = make_config(**options)
    config.device = "cuda:0"
    images = torch.from_numpy(np.stack([np.moveaxis(live_frame(index), -1, 0) for index in range(2)]))[None]
    batch = {**make_batch(config, 1), DEPTH_KEY: images}
    del batch[OBS_POINT_CLOUD]
    with fake_cuda():
        preprocessor, _ = make_processors(config, make_statistics())
        (step,) = (each for each in preprocessor.steps if isinstance(each, DepthToCloudProcessorStep))
        step.recipe = make_recipe().as_dict()
        step.keep()
        assert preprocessor(on_gpu(batch))[OBS_POINT_CLOUD].device.type == "cuda"
