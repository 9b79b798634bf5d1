"""A simulated UR5e controller on a loopback address, for ur_rtde's real client and this package's driver."""

import threading
import time
from types import TracebackType
from typing import Self

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.real_time import prefer_this_thread
from lerobot_uca.robots.ur5e.sim import servers
from lerobot_uca.robots.ur5e.sim.gripper import Fingers, SimulatedGripper
from lerobot_uca.robots.ur5e.sim.robot import CYCLE, Arm, IdealArm, Robot

FIRMWARE = (5, 12, 4, 1101)
MAX_CATCHING_UP = 25  # cycles, after which lost time is given up


class Controller:
    """Serves an arm until it is closed. A context manager.

    The ports are the real ones, since ur_rtde's client takes no others: each controller needs an address of its own.

    Args:
        arm: what moves.
        fingers: of the gripper; None: there is no gripper.
        tool_length: from the flange to the tool centre point [m].
        address: a loopback address, 127.x.y.z.
        firmware: what the controller says it is.
        has_dashboard: PolyScope X has no dashboard server.
    """

    def __init__(
        self,
        arm: Arm | None = None,
        fingers: Fingers | None = None,
        *,
        tool_length: float = 0.0,
        address: str = "127.0.0.1",
        firmware: tuple[int, int, int, int] = FIRMWARE,
        has_dashboard: bool = True,
    ) -> None:
        if not address.startswith("127."):
            raise UserError(f"A simulated controller serves loopback addresses (127.x.y.z) only, got '{address}'.")
        self.address = address
        self.robot = Robot(IdealArm() if arm is None else arm, tool_length)
        self.gripper = None if fingers is None else SimulatedGripper(fingers)
        self.network = servers.Network()
        self.dashboard = servers.Dashboard(self.robot, firmware)
        self._rtde = servers.Rtde(self.robot, self.network, firmware)
        services = {
            servers.RTDE_PORT: self._rtde.serve,
            servers.SCRIPT_PORT: servers.ScriptUpload(self.robot).serve,
        }
        if self.gripper is not None:
            services[servers.GRIPPER_PORT] = servers.GripperService(self.robot, self.gripper).serve
        if has_dashboard:
            services[servers.DASHBOARD_PORT] = self.dashboard.serve
        self._servers: list[servers.Server] = []
        try:
            for port, serve in services.items():
                self._servers.append(servers.Server(address, port, serve))
        except UserError:
            self.close()
            raise
        self._closing = threading.Event()
        self._clock = threading.Thread(target=self._run, name="ur5e-sim", daemon=True)
        self._clock.start()

    def _run(self) -> None:
        prefer_this_thread()
        due = time.monotonic()
        while not self._closing.is_set():
            with self.robot.lock:
                self._rtde.deliver()
                self.robot.cycle()
                if self.gripper is not None:
                    self.gripper.cycle(CYCLE)
                self._rtde.send_state()
            due = max(due + CYCLE, time.monotonic() - MAX_CATCHING_UP * CYCLE)
            time.sleep(max(0.0, due - time.monotonic()))

    def vanish(self) -> None:
        """All connections break and no new ones are accepted, while the arm goes on."""
        for server in self._servers:
            server.close()
        self._servers.clear()

    def close(self) -> None:
        """Stop serving, and the arm."""
        self.vanish()
        if hasattr(self, "_closing"):
            self._closing.set()
            self._clock.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
