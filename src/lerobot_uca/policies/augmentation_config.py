"""Options for changing training's data."""

from dataclasses import dataclass

from lerobot_uca.bounds import within
from lerobot_uca.errors import UserError


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


@dataclass
class SceneTurnConfig:
    """Training's scenes turned about the vertical through the hand: the cloud, the robot's state and its motion.

    An arm moves alike in all horizontal directions, so ten demonstrations show where to go from there, too. Off by
    default; needs policy.hand_position. What it did to success stands in docs/recipe.md.
    """

    # Largest turn [deg], to either side; each sample's is drawn.
    degrees: float = within(0.0, least=0, most=180)
    # The state's dimensions that are x and y of positions in the clouds' frame, pair by pair: [0, 1, 3, 4, 6, 7] in
    # Meta-World.
    states: tuple[int, ...] | None = None
    # The action's dimensions that are x and y of motions in that frame, in one unit: [0, 1] in Meta-World.
    actions: tuple[int, ...] | None = None

    def check(self, hand_position: tuple[int, ...] | None, n_states: int, n_actions: int) -> None:
        """Raise a `UserError` if scenes are to be turned and it is not said what turns.

        Args:
            hand_position: the policy's.
            n_states, n_actions: dimensions of state and action.
        """
        if not self.degrees:
            return
        if hand_position is None:
            raise UserError(
                f"policy.scene_turn.degrees={self.degrees:g} turns scenes about the hand: policy.hand_position must "
                "say where it is, got null."
            )
        for name, pairs, n in (("states", self.states, n_states), ("actions", self.actions, n_actions)):
            if not pairs or len(pairs) % 2 or len(pairs) != len(set(pairs)) or not set(pairs) <= set(range(n)):
                raise UserError(
                    f"policy.scene_turn.{name} must be pairs of different dimensions, 0 to {n - 1}, each x and y, "
                    f"got {pairs and list(pairs)}."
                )
        pairs = self.states or ()
        if tuple(hand_position[:2]) not in [tuple(pairs[first : first + 2]) for first in range(0, len(pairs), 2)]:
            raise UserError(
                f"policy.scene_turn.states must hold the hand's x and y, {list(hand_position[:2])} of "
                f"policy.hand_position, as a pair, got {list(pairs)}."
            )
