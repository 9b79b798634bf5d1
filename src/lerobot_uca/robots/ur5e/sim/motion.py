"""Motions of a simulated arm: from a joint state to the one a control cycle later.

q, qd: joint angles [rad] and velocities [rad/s], (6,). dt: length of a cycle [s].
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_VELOCITY = np.pi  # [rad/s], every joint of a UR5e
MAX_ACCELERATION = 40.0  # [rad/s^2], the most that URScript's commands take
JOINT_RANGE = 2 * np.pi  # [rad], to either side, every joint of a UR5e


class Motion(Protocol):
    """A motion of the arm."""

    is_done: bool

    def step(self, q: Array, qd: Array, dt: float) -> tuple[Array, Array]:
        """The commanded state a cycle later."""
        ...


def _towards(qd: Array, wanted: Array, change: float) -> Array:
    """Velocities nearer to the wanted ones, all joints arriving together; `change`: of the fastest changing [rad/s]."""
    difference = wanted - qd
    largest = np.abs(difference).max()
    return wanted.copy() if largest <= change else qd + difference * (change / largest)


@dataclass
class Servo:
    """`servoj`: acceleration = gain (target - (q + lookahead qd)).

    So URScript's manual describes its two parameters: the gain is a position controller's proportional term, lookahead
    projects the position forward in time with its velocity. A target that moves at a constant velocity v is followed at
    a distance of lookahead times v.
    """

    target: Array
    lookahead: float
    gain: float
    is_done: bool = False

    def step(self, q: Array, qd: Array, dt: float) -> tuple[Array, Array]:
        """One cycle nearer to the target."""
        acceleration = self.gain * (self.target - q - self.lookahead * qd)
        qd = qd + np.clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION) * dt
        return q + qd * dt, qd


@dataclass
class Speed:
    """`speedj` and, with velocity zero, `stopj`: joint velocities reached with an acceleration."""

    velocity: Array
    acceleration: float
    is_done: bool = False

    def step(self, q: Array, qd: Array, dt: float) -> tuple[Array, Array]:
        """One cycle nearer to the velocity."""
        qd = _towards(qd, self.velocity, self.acceleration * dt)
        self.is_done = bool(np.array_equal(qd, self.velocity))
        return q + qd * dt, qd


@dataclass
class Move:
    """`movej`: straight in joint space; all joints start and stop together, the one with the longest way leads."""

    target: Array
    speed: float
    acceleration: float
    is_done: bool = False

    def step(self, q: Array, qd: Array, dt: float) -> tuple[Array, Array]:
        """One cycle nearer to the target."""
        way = self.target - q
        longest = np.abs(way).max()
        a = self.acceleration
        # The speed from which braking by a in each cycle still ends at the target.
        braking = a * (np.sqrt(dt**2 / 4 + 2 * longest / a) - dt / 2)
        speed = min(self.speed, braking, np.abs(qd).max() + a * dt)
        if longest <= speed * dt:
            self.is_done = True
            return self.target.copy(), way / dt
        qd = way * (speed / longest)
        return q + qd * dt, qd
