"""Limits of what an arm is told to do. Pure functions of joint angles q [rad] and velocities qd [rad/s], (6,)."""

import math
from dataclasses import dataclass, replace

import numpy as np

from lerobot_uca.robots.ur5e.kinematics import Array


@dataclass(frozen=True)
class JointLimits:
    """The limits that hold for every caller."""

    lower: tuple[float, ...]  # (6,) [rad]
    upper: tuple[float, ...]  # (6,) [rad]
    velocity: float  # [rad/s], of each joint
    acceleration: float  # [rad/s^2], of each joint
    step: float  # [rad], from one target to the next, of each joint


def clip_target(target: Array, previous: Array, limits: JointLimits, elapsed: float) -> Array:
    """The nearest target that is allowed.

    Inside the joint range, and from the previous target no farther away than `step` nor than the velocity limit reaches
    in the time between the two. All joints are shortened alike: the direction stays.

    Args:
        target: wanted, (6,).
        previous: what was commanded before, (6,).
        limits: to hold.
        elapsed: time between the two [s].
    """
    inside = np.clip(target, limits.lower, limits.upper)
    way = inside - previous
    longest = np.abs(way).max()
    allowed = min(limits.step, limits.velocity * elapsed)
    return inside if longest <= allowed else previous + way * (allowed / longest)


def step_towards(q: Array, qd: Array, target: Array, limits: JointLimits, dt: float) -> tuple[Array, Array]:
    """The state a time dt later of joints that reach a target soonest and stop there, within the limits.

    Joints move independently of one another. They never pass a target that does not move.
    """
    a = limits.acceleration
    way, distance = target - q, np.abs(target - q)
    # The speed from which braking by `a dt` in every step ends at the target and not behind it; the last step arrives.
    braking = np.maximum(a * (np.sqrt(2 * distance / a) - dt / 2), np.minimum(distance / dt, a * dt))
    wanted = np.sign(way) * np.minimum(limits.velocity, braking)
    qd = np.clip(wanted, qd - a * dt, qd + a * dt)
    return q + qd * dt, qd


FOLLOWS_WITHIN = 0.1
"""[rad] An arm that follows is no farther behind its setpoint, besides what either's motion explains."""


def is_followed(setpoint: Array, velocity: Array, q: Array, qd: Array, delay: float) -> bool:
    """Whether an arm at q with qd follows a setpoint that moves with a velocity, all (6,).

    By servoj's nature a moving arm is behind by its velocity times a delay [s]; also of a setpoint that stands ahead of
    it after a gap.
    """
    fastest = max(np.abs(velocity).max(), np.abs(qd).max())
    return bool(np.abs(setpoint - q).max() <= FOLLOWS_WITHIN + fastest * delay)


class Interpolator:
    """Makes a smooth path of targets that come seldom: the servo loop's setpoints.

    A reference moves straight from where it is to the newest target in that target's duration; the setpoint follows the
    reference within the limits. It lags behind by about velocity / (2 acceleration), and never overshoots a target
    that stays.
    """

    def __init__(self, q: Array, limits: JointLimits) -> None:
        self._limits = self._now = limits
        self.reset(q)

    def reset(self, q: Array) -> None:
        """Stand still at q."""
        self.q: Array = np.array(q, dtype=np.float64)
        self.qd: Array = np.zeros(6)
        self._start = self._target = self.q
        self._elapsed, self._duration = 0.0, 1.0

    def go_on_from(self, q: Array, qd: Array, lookahead: float) -> None:
        """Go on to the target that was set, from where a servo is after a gap in which it got no setpoints.

        `servoj` compares its setpoint with q + lookahead qd: one that stands there neither brakes nor drives it, where
        one at q would be a jump backwards (at 1 rad/s, lookahead 0.1 s and gain 300, of 30 rad/s^2).
        """
        target = self._target
        self.reset(self._inside(q + lookahead * qd, q))
        self._target = target

    def set_target(self, target: Array, duration: float, velocity: float = math.inf) -> None:
        """Go there, in that time [s] and no faster than that velocity [rad/s], if the limits allow it.

        The joint range is held here, too.
        A joint that stands outside the range may come back to it as slowly as it is told, but go no farther out.
        """
        self._start = self._reference()
        self._now = replace(self._limits, velocity=min(velocity, self._limits.velocity))
        self._target = self._inside(target, self.q)
        self._elapsed, self._duration = 0.0, duration

    def _inside(self, target: Array, now: Array) -> Array:
        """The target, inside the joint range, or no farther outside it than the joints are now."""
        return np.clip(target, np.minimum(self._limits.lower, now), np.maximum(self._limits.upper, now))

    def _reference(self) -> Array:
        share = min(1.0, self._elapsed / self._duration)
        return self._start + share * (self._target - self._start)

    @property
    def has_arrived(self) -> bool:
        """Whether the setpoint is where the target is."""
        return bool(np.abs(self._target - self.q).max() < 1e-6)

    def step(self, dt: float) -> Array:
        """The setpoint (6,) a time dt later."""
        self._elapsed += dt
        self.q, self.qd = step_towards(self.q, self.qd, self._reference(), self._now, dt)
        return self.q
