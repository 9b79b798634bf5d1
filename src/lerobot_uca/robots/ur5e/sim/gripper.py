"""A simulated Robotiq 2F-85, as its registers show it."""

from typing import Protocol

OPEN_COUNT, CLOSED_COUNT = 3, 230  # where the fingers end, of 0 to 255
FASTEST, SLOWEST = 390.0, 52.0  # [counts/s]: 85 mm at 150 and at 20 mm/s


class Fingers(Protocol):
    """The fingers that close. Positions in counts: 0 open, 255 closed."""

    @property
    def count(self) -> float:
        """Measured."""
        ...

    def follow(self, count: float, dt: float) -> None:
        """Move for one cycle towards a position."""
        ...


class IdealFingers:
    """Fingers with nothing between them."""

    def __init__(self) -> None:
        self.count = float(OPEN_COUNT)

    def follow(self, count: float, dt: float) -> None:
        """Be there."""
        del dt
        self.count = count


class SimulatedGripper:
    """Registers in front of fingers."""

    def __init__(self, fingers: Fingers) -> None:
        self._fingers = fingers
        self._status = 0
        self._registers = {"ACT": 0, "GTO": 0, "ATR": 0, "ARD": 1, "SPE": 255, "FOR": 0, "FLT": 0, "PRE": 0}
        self._commanded = fingers.count
        self._blocked_for = 0.0  # [s]
        self._object = 3

    def set(self, name: str, value: int) -> None:
        """One of the registers, from a client."""
        if name == "POS":
            if value != self._registers["PRE"]:
                self._object = 0
            self._registers["PRE"] = min(max(value, 0), 255)
        elif name in self._registers:
            self._registers[name] = value

    def get(self, name: str) -> int:
        """The value of a register."""
        if name == "POS":
            return round(min(max(self._fingers.count, 0), 255))
        if name == "STA":
            return self._status
        return self._object if name == "OBJ" else self._registers.get(name, 0)

    def fingers_were_opened(self) -> None:
        """Somebody has opened simulated fingers: they stay so."""
        self._registers["PRE"], self._commanded = OPEN_COUNT, float(OPEN_COUNT)

    def cycle(self, dt: float) -> None:
        """Some time of the gripper."""
        self._status = 3 if self._registers["ACT"] else 0  # later than it is told, as the real one
        if self._registers["ACT"] and self._registers["GTO"]:
            wanted = min(max(self._registers["PRE"], OPEN_COUNT), CLOSED_COUNT)
            step = (SLOWEST + (FASTEST - SLOWEST) * self._registers["SPE"] / 255) * dt
            self._commanded += min(max(wanted - self._commanded, -step), step)
            self._notice(wanted, dt)
        self._fingers.follow(self._commanded, dt)

    def _notice(self, wanted: float, dt: float) -> None:
        if abs(self._fingers.count - wanted) < 2:
            self._object, self._blocked_for = 3, 0.0
        elif self._commanded == wanted:
            self._blocked_for += dt
            if self._blocked_for > 0.2:
                self._object = 2 if wanted > self._fingers.count else 1
        else:
            self._object, self._blocked_for = 0, 0.0
