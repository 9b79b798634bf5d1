"""`lerobot-uca-export`: a trained policy as one ONNX file, from raw observations to actions in the robot's units.

Example:
    lerobot-uca-export outputs/train/checkpoints/last/pretrained_model --format=onnx --output=policy.onnx
"""

import argparse
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from huggingface_hub import snapshot_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_uca.deploy.onnx_runner import OUTPUTS, open_session
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.inference.traced import to_onnx
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.whole_file import whole_file

# These steps do the same for all observations, so that a trace of them holds. A file takes clouds: the step that
# makes them from depth images has nothing to do, nor have those that change training's.
TRACEABLE_STEPS = {
    *("rename_observations_processor", "depth_to_cloud_processor", "point_cloud_processor", "to_batch_processor"),
    *("cloud_augmentation_processor", "scene_turn_processor", "hand_frame_processor"),
    *("device_processor", "normalizer_processor", "unnormalizer_processor"),
}
FILES = ("config.json", "policy_preprocessor.json", "policy_postprocessor.json")
"""A checkpoint's files besides its weights."""

TOLERANCE = 1e-4
"""Largest difference of the file's actions from the policy's, as a share of the largest; float32 rounds far below."""


class RawPolicy:
    """A policy with its processors: from raw observations to actions in the robot's units.

    Args:
        checkpoint: a folder, or a repository on the Hugging Face Hub.

    Raises:
        UserError: if it holds no policy of this package, or no processors, or some that cannot be exported.
    """

    def __init__(self, checkpoint: str) -> None:
        folder = _folder(checkpoint)
        config = PreTrainedConfig.from_pretrained(folder)
        if not isinstance(config, PointCloudPolicyConfig):
            raise UserError(
                f"Only this package's point-cloud policies can be exported; '{checkpoint}' is of type '{config.type}'."
            )
        config.device, config.inference = "cpu", "eager"  # PyTorch itself is what a trace is made of
        self.policy: PointCloudPolicy = get_policy_class(config.type).from_pretrained(folder, config=config)
        config.depth.keep_calibrations()  # a file takes clouds, not the depth images of cameras here
        self._pre, self._post = make_pre_post_processors(
            config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": "cpu"}},
        )
        for step in (*self._pre.steps, *self._post.steps):
            name = getattr(step, "_registry_name", type(step).__name__)
            if name not in TRACEABLE_STEPS:
                raise UserError(
                    f"'{checkpoint}' cannot be exported with its processor step '{name}'; "
                    f"these can: {', '.join(sorted(TRACEABLE_STEPS))}."
                )

    @property
    def input_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of `act`'s inputs, by name."""
        config = self.policy.config
        assert config.input_features is not None
        n_steps = config.obs_span + 1
        n_points = config.n_points or config.input_features[OBS_POINT_CLOUD].shape[0]
        return {
            "point_cloud": (n_steps, n_points, config.n_channels),
            "state": (n_steps, config.n_states),
            "noise": (config.horizon, config.n_actions),
        }

    def act(self, policy: PointCloudPolicy, point_cloud: Tensor, state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (n_action_steps, A) from the latest steps and noise (T, A), and the largest normalised observation.

        Args:
            point_cloud, state: (K, N, 3), with colours (K, N, 6), and (K, S), oldest first; all K steps from the first
                observed one to the current one, so that a runner needs to know nothing of the observation stride.
        """
        stride = policy.config.obs_stride
        batch = self._pre({OBS_POINT_CLOUD: point_cloud[None, ::stride], OBS_STATE: state[None, ::stride]})
        largest = torch.maximum(batch[OBS_POINT_CLOUD].abs().amax(), batch[OBS_STATE].abs().amax())
        return self._post(policy.predict_action_chunk(batch, noise=noise[None]))[0], largest


def export(checkpoint: str, output: Path, *, overwrite: bool = False) -> dict[str, tuple[int, ...]]:
    """Write a checkpoint's policy and processors as an ONNX model; see `RawPolicy.act`. Returns its inputs' shapes.

    Args:
        checkpoint: a folder, or a repository on the Hugging Face Hub.
        output: the file, written whole or not at all.
        overwrite: replace it if it exists.

    Raises:
        UserError: as `RawPolicy`, and if the file exists or cannot be written.
    """
    if output.exists() and not overwrite:
        raise UserError(f"'{output}' exists. Choose another --output, or replace it with --overwrite.")
    raw_policy = RawPolicy(checkpoint)
    shapes = raw_policy.input_shapes
    model = to_onnx(raw_policy.act, raw_policy.policy, list(shapes.values()), list(shapes), OUTPUTS)
    _check_same_actions(model, raw_policy)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as unfinished:
            unfinished.write_bytes(model)
    except OSError as error:
        raise UserError(f"Cannot write '{output}': {error}") from error
    return shapes


def _folder(checkpoint: str) -> Path:
    folder = Path(checkpoint)
    if not folder.is_dir():
        try:
            # Without its checkpoints, which may have been uploaded, too, into folders of their own.
            patterns = ["*.json", "*.safetensors"]
            folder = Path(snapshot_download(checkpoint, allow_patterns=patterns, ignore_patterns=["*/*"]))
        except (HFValidationError, HfHubHTTPError, LocalEntryNotFoundError) as error:
            reason = " ".join(str(error).split())
            raise UserError(
                f"'{checkpoint}' is not a folder and could not be downloaded from the Hub: {reason}"
            ) from error
    for name in FILES:
        if not (folder / name).is_file():
            raise UserError(
                f"'{checkpoint}' has no {name}. A checkpoint is a folder like .../checkpoints/last/pretrained_model "
                "with policy and processors."
            )
    return folder


def _check_same_actions(model: bytes, raw_policy: RawPolicy) -> None:
    random = np.random.default_rng(0)
    inputs = {name: random.normal(size=shape).astype(np.float32) for name, shape in raw_policy.input_shapes.items()}
    exported, _ = open_session(model, "the exported policy").run(None, inputs)
    with torch.no_grad():
        expected = raw_policy.act(raw_policy.policy, *map(torch.from_numpy, inputs.values()))[0].numpy()
    difference = np.abs(exported - expected).max() / np.abs(expected).max()
    if not difference < TOLERANCE:
        raise UserError(
            f"ONNX Runtime {onnxruntime.__version__} computes other actions than the policy: they differ by "
            f"{difference:.1e} of the largest, at most {TOLERANCE:.0e} is allowed. Nothing was written."
        )


def run() -> None:
    """Export and say what was written."""
    parser = argparse.ArgumentParser(
        prog="lerobot-uca-export",
        description="Write a policy as one ONNX file, normalisation included. "
        "lerobot_uca/deploy/onnx_runner.py runs it with onnxruntime and numpy alone.",
    )
    parser.add_argument("checkpoint", help="folder .../pretrained_model, or a repository on the Hugging Face Hub")
    parser.add_argument("--format", choices=["onnx"], default="onnx", help="of the file (default: onnx)")
    parser.add_argument("--output", type=Path, default=Path("policy.onnx"), help="file to write (default: policy.onnx)")
    parser.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
    args = parser.parse_args()
    shapes = export(args.checkpoint, args.output, overwrite=args.overwrite)
    inputs = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB, inputs {inputs}")
