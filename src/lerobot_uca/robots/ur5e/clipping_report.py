"""Says what the limits take away from an arm's targets."""

import logging
import math
import time

import numpy as np

from lerobot_uca.robots.ur5e.kinematics import JOINTS, Array

NOTICEABLE_SHARE = 0.02  # of the gripper's range
NOTICEABLE = 1e-3  # [rad]: what is clipped by less is not worth a line

logger = logging.getLogger(__name__)


class ClippingReport:
    """Says how much of the targets the limits have taken away, once a second: datasets hold the unclipped ones."""

    def __init__(self, every: float = 1.0) -> None:
        self._every = every
        self._due = self._gripper_due = -math.inf
        self._largest = np.zeros(6)
        self._n = 0

    def note(self, clipped: Array) -> None:
        """Note the part that was taken away from a target, (6,) [rad]."""
        if np.abs(clipped).max() > NOTICEABLE:
            self._n += 1
            self._largest = np.maximum(self._largest, np.abs(clipped))
        if time.monotonic() >= self._due:
            self.say()

    def say(self) -> None:
        """Say what has not been said yet."""
        if self._n:
            joint = int(self._largest.argmax())
            logger.warning(
                "%d targets were clipped, by up to %.3f rad (%s).", self._n, self._largest[joint], JOINTS[joint]
            )
            self._due, self._largest, self._n = time.monotonic() + self._every, np.zeros(6), 0

    def note_gripper(self, position: float) -> None:
        """A gripper's position, which may lie outside 0 to 1."""
        if not -NOTICEABLE_SHARE <= position <= 1 + NOTICEABLE_SHARE and time.monotonic() >= self._gripper_due:
            logger.warning("The gripper's position %.2f was clipped to 0 (open) to 1 (closed).", position)
            self._gripper_due = time.monotonic() + self._every

    def note_unreachable(self, pose: Array) -> None:
        """A pose that the arm cannot take."""
        if time.monotonic() >= self._due:
            logger.warning("The pose %s cannot be reached; the arm holds its position.", np.round(pose[:6], 3).tolist())
            self._due = time.monotonic() + self._every
