"""The channel between the driver and the process that talks to the arm: a line of JSON for each message."""

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.limits import JointLimits


class ArmStoppedError(UserError):
    """The arm stands still and takes no more commands. The message says why, and what to do."""


@dataclass(frozen=True)
class Settings:
    """The driver's first message."""

    ip: str
    parent: int  # process id
    limits: JointLimits
    servo_rate: float  # [Hz]
    lookahead: float  # [s]
    gain: float
    stop_after: float  # [s] without a target after the last one was reached


@dataclass(frozen=True)
class Target:
    """A message to the arm: where to go, and the least time for it."""

    q: tuple[float, ...]  # (6,) [rad]
    duration: float  # [s]
    velocity: float = math.inf  # [rad/s], no faster than that, and than the limits
    begins: bool = False  # a motion: an arm that stands still takes no other, which was sent before it was known to


@dataclass(frozen=True)
class Stop:
    """A message to the arm: brake, end the program and the process."""


@dataclass(frozen=True)
class State:
    """A message from the arm with every tick of the servo loop: the heartbeat."""

    made_at: float  # [s], of time.monotonic(), which processes share: it may be read much later
    timestamp: float  # [s], the controller's
    q: tuple[float, ...]  # (6,) [rad], measured
    qd: tuple[float, ...]  # (6,) [rad/s], measured
    tcp: tuple[float, ...]  # (6,) [m, rotation vector], measured, base frame
    setpoint: tuple[float, ...]  # (6,) [rad], of the servo loop
    is_servoing: bool  # False: standing still, the next target starts anew
    has_arrived: bool  # the setpoint is where the last target was


@dataclass(frozen=True)
class Note:
    """A message from the arm for the user."""

    text: str


@dataclass(frozen=True)
class Failure:
    """The last message from the arm: it stands still, and why."""

    text: str


Message = Settings | Target | Stop | State | Note | Failure
KINDS: dict[str, Any] = {kind.__name__: kind for kind in (Settings, Target, Stop, State, Note, Failure)}


def encode(message: Message) -> bytes:
    """One line."""
    return json.dumps({"kind": type(message).__name__, **asdict(message)}).encode() + b"\n"


def decode(line: bytes) -> Message:
    """The inverse of `encode`."""
    values = json.loads(line, object_hook=_with_tuples)
    kind = KINDS[values.pop("kind")]
    if kind is Settings:
        values["limits"] = JointLimits(**values["limits"])
    message: Message = kind(**values)
    return message


def _with_tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
