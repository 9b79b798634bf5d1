"""The preprocessor step that changes training's clouds as a real camera would.

Letters: B samples, O observation steps, N points, K cameras.
"""

from dataclasses import asdict, dataclass, field
from typing import override

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.distributed import independent_draws
from lerobot_uca.policies.processor_step import SameFeaturesStep, training_clouds


def augmentation_steps(config: PointCloudPolicyConfig) -> list[ProcessorStep]:
    """The step that a policy's configuration asks for, or none.

    Raises:
        UserError: if a camera is to be turned and its position is unknown.
    """
    options = config.augmentation
    if not options.is_on:
        return []
    sources = (config.depth.recipe or {}).get("sources", [])
    positions = [[row[3] for row in source["calibration"]["pose"][:3]] for source in sources]
    if options.camera_turn and not positions:
        raise UserError(
            f"policy.augmentation.camera_turn={options.camera_turn:g} turns clouds about their camera, which must be "
            "known: the dataset needs clouds made by lerobot-uca-convert from depth, or depth, got clouds of unknown "
            "origin. camera_shift, jitter and drop do without."
        )
    return [CloudAugmentationProcessorStep(**asdict(options), positions=positions)]


@dataclass
@ProcessorStepRegistry.register(name="cloud_augmentation_processor")
class CloudAugmentationProcessorStep(SameFeaturesStep):
    """Moves clouds rigidly, shakes their points and leaves some out, in training only.

    The clouds (B, O, N, 3) are in the robot's base frame [m]: the step stands before the normaliser. Draws come from
    PyTorch's generator, which `seed` sets and a checkpoint restores.

    Args:
        jitter, drop, camera_shift, camera_turn: see `AugmentationConfig`.
        positions: of the cameras in the base frame [m], (K, 3).
    """

    jitter: float = 0.0
    drop: float = 0.0
    camera_shift: float = 0.0
    camera_turn: float = 0.0
    positions: list[list[float]] = field(default_factory=list)

    @override
    def __call__(self, transition: EnvTransition) -> EnvTransition:
        cloud = training_clouds(transition)
        if cloud is None:
            return transition
        with independent_draws(cloud.device):
            changed = self.augmented(cloud)
        observation = {**transition[TransitionKey.OBSERVATION], OBS_POINT_CLOUD: changed}
        return {**transition, TransitionKey.OBSERVATION: observation}

    def augmented(self, cloud: Tensor) -> Tensor:
        """Changed clouds of (B, O, N, 3), or more channels, of which the first three are xyz [m, base frame]."""
        xyz, rest = cloud[..., :3], cloud[..., 3:]
        if self.camera_shift or self.camera_turn:
            R, t = self._motions(cloud)
            xyz = xyz @ R[:, None].mT + t[:, None, None]
        if self.jitter:
            xyz = xyz + self.jitter * torch.randn_like(xyz)
        changed = torch.cat([xyz, rest], dim=-1)
        return self._thinned(changed) if self.drop else changed

    def _motions(self, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (B, 3, 3) and translations (B, 3): p becomes R p + t.

        A camera that is not where its calibration says it is moves all its points as one rigid body. It stays where it
        is for an episode, so a sample's observation steps share the motion.
        """
        n = len(cloud)
        angle = torch.deg2rad(self.camera_turn * cloud.new_empty(n, 1).uniform_())
        R = _rotations(angle * _directions(cloud))
        t = self.camera_shift * cloud.new_empty(n, 1).uniform_() * _directions(cloud)
        if not self.positions:
            return R, t
        camera = cloud.new_tensor(self.positions)[torch.randint(len(self.positions), (n,), device=cloud.device)]
        return R, t + camera - (R @ camera[..., None])[..., 0]

    def _thinned(self, cloud: Tensor) -> Tensor:
        """Clouds (B, O, N, C) with other points of the same cloud in place of those that are left out.

        The encoder takes a maximum over the points, so a point that is there twice changes nothing.
        """
        share = self.drop * cloud.new_empty(*cloud.shape[:-2], 1).uniform_()
        is_kept = cloud.new_empty(cloud.shape[:-1]).uniform_() >= share
        kept_first = (~is_kept).to(torch.uint8).argsort(dim=-1, stable=True)
        n_kept = is_kept.sum(dim=-1, keepdim=True).clamp(min=1)
        order = torch.arange(cloud.shape[-2], device=cloud.device)
        chosen = torch.where(is_kept, order, kept_first.gather(-1, order % n_kept))
        return cloud.gather(-2, chosen[..., None].expand_as(cloud))


def _directions(cloud: Tensor) -> Tensor:
    """Unit vectors, evenly over the sphere, one a sample: (B, 3)."""
    return torch.nn.functional.normalize(cloud.new_empty(len(cloud), 3).normal_(), dim=-1)


def _rotations(vectors: Tensor) -> Tensor:
    """Rotations (B, 3, 3) of rotation vectors (B, 3) [rad]."""
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    angle = torch.linalg.vector_norm(vectors, dim=-1)[:, None, None]
    sines, cosines = torch.sinc(angle / torch.pi), torch.sinc(angle / (2 * torch.pi)).square() / 2  # Rodrigues' formula
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + sines * skew + cosines * (skew @ skew)
