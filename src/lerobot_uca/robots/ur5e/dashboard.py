"""Looks at a controller before anything moves: is it one, can it be used, and is it free?"""

import contextlib
import logging
import re
import socket

from lerobot_uca.errors import UserError

DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT = 29999, 30004, 30003
TIMEOUT = 3.0  # [s]
TESTED_FIRMWARE = ("5.12",)
"""PolyScope's releases tried with the simulated controller. The authors have tried no release on a real arm."""

logger = logging.getLogger(__name__)


class Dashboard:
    """The controller's dashboard server: one line for each line."""

    def __init__(self, ip: str) -> None:
        self._ip = ip
        self._connection = _connect(ip, DASHBOARD_PORT)
        self._lines = self._connection.makefile("r", encoding="utf-8", errors="replace")
        banner = self._read()
        if "Universal Robots Dashboard Server" not in banner:
            self.close()
            raise UserError(f"{ip}:{DASHBOARD_PORT} is not a dashboard server of Universal Robots: it said '{banner}'.")

    def ask(self, request: str) -> str:
        """The answer."""
        return self._read(f"{request}\n")

    def _read(self, request: str = "") -> str:
        try:
            self._connection.sendall(request.encode())
            return self._lines.readline().strip()
        except TimeoutError:
            raise UserError(f"The dashboard server of {self._ip} did not answer within {TIMEOUT:.0f} s.") from None
        except OSError as error:
            raise UserError(
                f"The dashboard server of {self._ip} hung up ({error.strerror or error}): is the controller starting?"
            ) from None

    def close(self) -> None:
        """Hang up."""
        self._lines.close()
        self._connection.close()


def _connect(ip: str, port: int) -> socket.socket:
    try:
        return socket.create_connection((ip, port), timeout=TIMEOUT)
    except socket.gaierror:
        raise UserError(f"robot.ip is an address such as 192.168.1.10, got '{ip}'.") from None
    except TimeoutError:
        raise UserError(
            f"Nothing answers at {ip}:{port} ({TIMEOUT:.0f} s): is the robot on, in this network?"
        ) from None
    except ConnectionRefusedError:
        if port == DASHBOARD_PORT and _accepts(ip, RTDE_PORT):
            raise UserError(
                f"{ip} speaks RTDE but has no dashboard server: PolyScope X. It is not supported, because the client "
                "(ur_rtde) starts its program by way of that server. Valid: an e-Series controller with PolyScope 5."
            ) from None
        raise UserError(
            f"{ip} refuses connections to port {port}: no UR controller, or one that is starting."
        ) from None
    except OSError as error:
        raise UserError(f"{ip}:{port} cannot be reached: {error.strerror or error}.") from None


def _accepts(ip: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((ip, port), timeout=TIMEOUT):
        return True
    return False


def check_controller(ip: str) -> None:
    """Raise a `UserError` that says what to do unless the controller is ready and nobody else uses it."""
    dashboard = Dashboard(ip)
    try:
        for port in (RTDE_PORT, SCRIPT_PORT):
            _connect(ip, port).close()
        _check_firmware(dashboard.ask("PolyscopeVersion"))
        safety = dashboard.ask("safetystatus").split(":")[-1].strip()
        if safety not in {"NORMAL", "REDUCED"}:
            raise UserError(f"The arm's safety status is {safety}: find the cause and clear it on the pendant first.")
        mode = dashboard.ask("robotmode").split(":")[-1].strip()
        if mode != "RUNNING":
            raise UserError(f"The arm is not ready (robot mode {mode}): power it on and release the brakes first.")
        if dashboard.ask("is in remote control") == "false":
            raise UserError("The controller is in local control: switch to remote control, top right on the pendant.")
        if (program := dashboard.ask("programState")).startswith(("PLAYING", "PAUSED")):
            raise UserError(
                f"A program runs on {ip} already ({program}): another client or the pendant holds the arm. Stop it "
                "there first; two would steer it at once."
            )
    finally:
        dashboard.close()


def _check_firmware(answer: str) -> None:
    found = re.search(r"(\d+)\.(\d+)\.\d+", answer)
    if found is None:
        raise UserError(f"The controller does not say its version ('{answer}'): it is not supported.")
    if int(found[1]) != 5:
        raise UserError(f"PolyScope {found[0]} is not supported. Valid: PolyScope 5, the e-Series'.")
    if f"{found[1]}.{found[2]}" not in TESTED_FIRMWARE:
        tested = ", ".join(TESTED_FIRMWARE)
        logger.warning("PolyScope %s has not been tried with this driver (tried: %s). Begin slowly.", found[0], tested)


def stop_program(ip: str) -> None:
    """End the program on a controller, also a paused one."""
    dashboard = Dashboard(ip)
    try:
        dashboard.ask("stop")
    finally:
        dashboard.close()
