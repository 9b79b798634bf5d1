"""Options for changing training's clouds."""

from dataclasses import dataclass

from lerobot_uca.bounds import within


@dataclass
class AugmentationConfig:
    """Changes to training's clouds as a real camera would make them. All are off by default.

    What they did to success on one task stands in docs/own_data.md.
    """

    # Standard deviation of the noise on each coordinate of each point [m].
    jitter: float = within(0.0, least=0, most=0.1)
    # Largest share of a cloud's points that are left out; each cloud's share is drawn from 0 to it.
    drop: float = within(0.0, least=0, below=1)
    # Largest error of the camera's position [m], as if it were badly calibrated. The error is drawn for each sample.
    camera_shift: float = within(0.0, least=0, most=0.2)
    # Largest error of the camera's direction [deg], a rotation about the camera.
    camera_turn: float = within(0.0, least=0, most=30)

    @property
    def is_on(self) -> bool:
        """Whether anything is changed."""
        return any((self.jitter, self.drop, self.camera_shift, self.camera_turn))
