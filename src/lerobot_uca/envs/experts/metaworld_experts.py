"""Demonstrators of tasks whose own scripted one, Meta-World's, does worse. They have its interface.

`get_action` maps Meta-World's observation (39,) [m, world frame] to an action (4,): the hand's motion, not yet limited,
and the gripper's effort, -1 to open it and 1 to close it.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

GAIN = 25
"""Of the hand's motion: an action of 1 moves it by up to 1 cm, so each step is a quarter of the way that is left."""


class Soccer:
    """Comes down behind the ball, as seen from the goal, and pushes it there.

    Meta-World's goes down on its way and pushes along x or along y, by where the goal is: in 8 of 50 episodes of
    straight paths, 7 of others, it hits the ball, which nothing brakes, sideways, and cannot catch it again.
    """

    GAP = 0.045
    """Where the hand comes down: so far behind the ball's centre [m]."""
    NEAR = 0.02
    """Horizontally within this of that place the hand is lowered [m]."""
    BEHIND, BESIDE = 0.02, 0.012
    """It pushes while it is at least so far behind the ball's centre, and at most so far beside its way [m].

    From farther aside the ball would roll off to the other side.
    """
    HIGH, LOW = 0.1, 0.03
    """Heights of the hand on its way and behind the ball [m]."""
    PUSH = 10
    """Instead of `GAIN` while it pushes: faster, it would lose the ball."""

    def get_action(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """The action in a state."""
        hand, ball, goal = observation[:3], observation[4:7], observation[-3:]
        to_goal = goal[:2] - ball[:2]
        to_goal /= max(float(np.linalg.norm(to_goal)), 1e-6)
        from_hand = ball[:2] - hand[:2]
        behind, beside = from_hand @ to_goal, abs(from_hand[0] * to_goal[1] - from_hand[1] * to_goal[0])
        if hand[2] < 2 * self.LOW and behind > self.BEHIND and beside < self.BESIDE:
            return np.array([*(self.PUSH * from_hand), self.PUSH * (self.LOW - hand[2]), 1.0])
        way = from_hand - self.GAP * to_goal
        height = self.LOW if np.linalg.norm(way) < self.NEAR else self.HIGH
        return np.array([*(GAIN * way), GAIN * (height - hand[2]), 1.0])


class PegInsertSide:
    """Grasps the peg, carries it in front of the hole, as high as the hole is, and in.

    Meta-World's asks whether the hand is within 2.5 cm above the peg, but it cannot come nearer than 2.6 to one that
    lies on the table: where the peg touches it again, in 6 of 50 episodes, the hand pushes down until time is over.
    And of the 3 cm by which it allows a carried peg to be off, height takes 2.5 to 3, since it compares the peg with
    where the hand should be; so it goes to and fro in front of the hole.
    """

    WIDE = 0.04
    """Horizontally within this of the peg's centre the open hand comes down [m]."""
    LOW, HIGH = 0.03, 0.12
    """Heights of the hand above the peg: at which it grasps, and on its way [m]."""
    CLOSED = 0.6
    """Opening of a gripper, 0 to 1, that has closed on the peg."""
    OFF = 0.015
    """How far off the hole's axis the peg may be when it is pushed in [m]."""
    BEYOND = 0.05
    """How far beyond the hole's mouth it is pushed [m]."""

    def get_action(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """The action in a state."""
        hand, opening, peg, hole = observation[:3], observation[3], observation[4:7], observation[-3:]
        above = hand[2] - peg[2]
        if np.linalg.norm(hand[:2] - peg[:2]) > self.WIDE:
            way, effort = peg + np.array([0, 0, self.HIGH]) - hand, -1.0
        elif above > self.LOW:
            way, effort = peg - hand, -1.0
        elif opening > self.CLOSED:
            way, effort = np.zeros(3), 1.0
        else:
            way, effort = hole - peg, 1.0
            way[0] = 0 if np.linalg.norm(way[1:]) > self.OFF else way[0] - self.BEYOND
        return np.array([*(GAIN * way), effort])


class DoorOpen:
    """Comes down behind the door's handle, hooks it, and pulls until the door is open.

    Meta-World's goes down within 12 cm of a place in front of the handle: where the door is on the left, the hand comes
    down there, in front, and stays. And it rises where a swinging door is so far ahead of the hand, so that the door
    swings on alone, and at times not far enough.
    """

    BEHIND = np.array([0.01, 0.02])
    """Where the hand comes down, from the handle [m]."""
    NEAR = 0.06
    """Horizontally within this of that place the hand is lowered [m]."""
    HIGH = 0.2
    """Height of the hand above the handle on its way [m]."""
    HOOKED = 0.04, 0.02, 0.16
    """It pulls where it is at most so high above the handle, so far in front, and horizontally so far from it [m]."""
    AHEAD = 0.05
    """How far in front of the handle the hand wants to be while it pulls [m]."""

    def get_action(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """The action in a state."""
        way = observation[4:7] - observation[:3]
        above, in_front, off = -way[2], way[0], float(np.linalg.norm(way[:2]))
        high, front, far = self.HOOKED
        if above < high and in_front < front and off < far:
            way[0] -= self.AHEAD
        else:
            way[:2] += self.BEHIND
            way[2] += self.HIGH if np.linalg.norm(way[:2]) > self.NEAR else 0
        return np.array([*(GAIN * way), 1.0])


class FingersToGoal:
    """Brings the fingers to the goal: Meta-World's expert, told a goal that is higher by as much as they are lower.

    As it is, it brings the hand there, and the fingers, which must come within 5 cm of the goal, stay 4.6 cm below it.
    So its demonstrations end at the edge of success, where a policy that is off by 2 cm to a side fails.

    Args:
        task: reach or reach-wall.
    """

    BELOW = 0.045
    """How far below the hand the fingers' tips are [m]."""

    def __init__(self, task: str) -> None:
        from metaworld.policies import ENV_POLICY_MAP  # slow to import, and not needed to read a configuration

        experts: Any = ENV_POLICY_MAP
        self._expert: Any = experts[f"{task}-v3"]()

    def get_action(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """The action in a state."""
        observation = observation.copy()
        observation[-1] += self.BELOW
        return self._expert.get_action(observation)


EXPERTS: Mapping[str, Callable[[], Any]] = {
    "soccer": Soccer,
    "peg-insert-side": PegInsertSide,
    "door-open": DoorOpen,
    **{task: partial(FingersToGoal, task) for task in ("reach", "reach-wall")},
}
"""By task."""
