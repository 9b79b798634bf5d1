"""A demonstrator of Meta-World's soccer."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

GAP = 0.045
"""Where the hand comes down: so far behind the ball's centre [m]."""
SIDE = 0.012
"""Greatest distance of a pushing hand from the line through ball and goal [m]. The ball rolls off a hand beside it."""
NEAR = 0.02
"""Within this of where it comes down the hand is lowered, and nearer to the ball's centre it no longer pushes [m]."""
HIGH, LOW = 0.1, 0.03
"""Heights of the hand on its way and behind the ball [m]."""


class SoccerPolicy:
    """Comes down behind the ball, as seen from the goal, and pushes it there. Called as Meta-World's policies are.

    Meta-World's goes down on its way and pushes along x or along y, by where the goal is: in 8 of 50 episodes it hits
    the ball, which nothing brakes, sideways, and cannot catch it again.
    """

    def get_action(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """The action (4,), not yet limited, for Meta-World's observation (39,) [m, world frame]."""
        hand, ball, goal = observation[:3], observation[4:7], observation[-3:]
        to_goal = goal[:2] - ball[:2]
        to_goal /= max(float(np.linalg.norm(to_goal)), 1e-6)
        from_hand = ball[:2] - hand[:2]
        behind, beside = from_hand @ to_goal, abs(from_hand[0] * to_goal[1] - from_hand[1] * to_goal[0])
        if hand[2] < 2 * LOW and behind > NEAR and beside < SIDE:
            motion = 10 * np.array([*from_hand, LOW - hand[2]])
        else:
            way = from_hand - GAP * to_goal
            height = LOW if np.linalg.norm(way) < NEAR else HIGH
            motion = 25 * np.array([*way, height - hand[2]])
        return np.array([*motion, 1.0])  # the gripper closed
