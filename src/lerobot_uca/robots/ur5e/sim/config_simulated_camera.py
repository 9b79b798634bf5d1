"""Configuration of the camera type `ur5e_sim`."""

from dataclasses import dataclass

from lerobot.cameras import CameraConfig

from lerobot_uca.registry import register


@register(CameraConfig, "ur5e_sim")
@dataclass(kw_only=True)
class SimulatedCameraConfig(CameraConfig):
    """The depth camera of `lerobot-uca-ur5e-sim`.

    Attributes:
        ip: the simulated controller's address.
        use_rgb, use_depth: which pictures, as LeRobot's RealSense camera has them.
    """

    fps: int | None = 30
    width: int | None = 160
    height: int | None = 120
    ip: str = "127.0.0.1"
    use_rgb: bool = False
    use_depth: bool = True
