"""Configuration of the teleoperator type `ur5e_scripted`."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig

from lerobot_uca.registry import register


@register(TeleoperatorConfig, "ur5e_scripted")
@dataclass(kw_only=True)
class ScriptedTeleoperatorConfig(TeleoperatorConfig):
    """Demonstrates a task of `lerobot-uca-ur5e-sim`, again and again, as a person with a leader arm would.

    Attributes:
        ip: the simulated controller's address.
        task: `pick_place` or `drawer_close`.
        fps: of the recording, --dataset.fps.
        episode_time_s, reset_time_s: of the recording, --dataset.episode_time_s and --dataset.reset_time_s.
        seed: of the things' places in the first episode; each further one takes the next.
    """

    ip: str = "127.0.0.1"
    task: str = "pick_place"
    fps: int = 30
    episode_time_s: float = 12.0
    reset_time_s: float = 6.0
    seed: int = 0
