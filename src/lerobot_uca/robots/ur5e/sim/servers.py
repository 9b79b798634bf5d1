"""The simulated controller's network services: RTDE, dashboard, script upload and the gripper's."""

import contextlib
import random
import re
import socket
import socketserver
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.sim import protocol
from lerobot_uca.robots.ur5e.sim.gripper import SimulatedGripper
from lerobot_uca.robots.ur5e.sim.robot import Robot, Runtime, Safety

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, GRIPPER_PORT = 30004, 29999, 30003, 63352
SERIAL_NUMBER = "20195599999"


class Server(socketserver.ThreadingTCPServer):
    """One thread for each connection; closing ends them all."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, address: str, port: int, serve: Callable[[socket.socket], None]) -> None:
        self._connections: set[socket.socket] = set()
        self._serve = serve
        try:
            super().__init__((address, port), socketserver.BaseRequestHandler)
        except OSError as error:
            raise UserError(
                f"The simulated controller cannot listen on {address}:{port} ({error.strerror}). One controller has an "
                "address to itself: stop the other one or give another loopback address, such as 127.0.0.2."
            ) from None
        self._thread = threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def finish_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Serve one connection until it ends, from whichever side."""
        del client_address
        request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connections.add(request)
        try:
            with contextlib.suppress(OSError):
                self._serve(request)
        finally:
            self._connections.discard(request)

    def drop_connections(self) -> None:
        """Close what is open; new connections are accepted."""
        for connection in tuple(self._connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close as if the machine had been switched off."""
        self.shutdown()
        self.server_close()
        self.drop_connections()


@dataclass
class Network:
    """Faults of the way between the controller and a client."""

    latency: float = 0.0  # [s], of every packet from a client
    drop: float = 0.0  # share of data packets that get lost, either way
    is_silent: bool = False  # connections stay open and nothing is sent
    _random: random.Random = field(default_factory=lambda: random.Random(0))  # noqa: S311

    def loses(self) -> bool:
        """Whether the next packet is lost."""
        return self.is_silent or (self.drop > 0 and self._random.random() < self.drop)


class Rtde:
    """Data out in every cycle, registers in."""

    def __init__(self, robot: Robot, network: Network, firmware: tuple[int, ...]) -> None:
        self._robot, self._network, self._firmware = robot, network, firmware
        self._streams: dict[socket.socket, _Stream] = {}
        self._arriving: deque[tuple[float, dict[str, protocol.Value]]] = deque()

    def serve(self, connection: socket.socket) -> None:
        """One client."""
        stream = _Stream(connection)
        inputs: list[protocol.Recipe] = []
        try:
            for kind, payload in protocol.read_packets(connection):
                if kind == protocol.DATA:
                    self._receive(inputs, payload)
                else:
                    self._answer(kind, payload, stream, inputs)
        finally:
            self._streams.pop(connection, None)

    def _answer(self, kind: int, payload: bytes, stream: "_Stream", inputs: list[protocol.Recipe]) -> None:
        if kind == protocol.PROTOCOL_VERSION:
            reply = b"\x01"
        elif kind == protocol.CONTROLLER_VERSION:
            reply = struct.pack(">4I", *self._firmware)
        elif kind == protocol.OUTPUTS:
            (frequency,) = struct.unpack_from(">d", payload)
            stream.recipe = protocol.Recipe.parse(payload[8:], protocol.OUTPUT_TYPES)
            stream.every = max(1, round(500 / frequency))
            reply = stream.recipe.reply(1)
        elif kind == protocol.INPUTS:
            inputs.append(protocol.Recipe.parse(payload, protocol.INPUT_TYPES))
            reply = inputs[-1].reply(len(inputs))
        elif kind in {protocol.START, protocol.PAUSE}:
            reply = b"\x01"
        else:
            return
        stream.send(protocol.packet(kind, reply))
        if kind == protocol.START:
            self._streams[stream.connection] = stream
        elif kind == protocol.PAUSE:
            self._streams.pop(stream.connection, None)

    def _receive(self, inputs: list[protocol.Recipe], payload: bytes) -> None:
        if self._network.loses():
            return
        recipe_id = payload[0] if payload else 0
        if not 1 <= recipe_id <= len(inputs):
            return
        with contextlib.suppress(struct.error):  # a packet of the wrong length, which ur_rtde sends for short targets
            values = inputs[recipe_id - 1].unpack(payload[1:])
            self._arriving.append((time.monotonic() + self._network.latency, values))

    def deliver(self) -> None:
        """Deliver the clients' data that the network has carried. Called before each cycle, with the lock."""
        while self._arriving and self._arriving[0][0] <= time.monotonic():
            self._robot.receive(self._arriving.popleft()[1])

    def send_state(self) -> None:
        """Send to every client that has started its stream. Called after each cycle, with the lock."""
        streams = [each for each in tuple(self._streams.values()) if self._robot.n_cycles % each.every == 0]
        if not streams:
            return
        values = self._robot.variables()
        for stream in streams:
            if stream.recipe is not None and stream.recipe.is_known and not self._network.loses():
                stream.send(protocol.packet(protocol.DATA, b"\x01" + stream.recipe.pack(values)))


class _Stream:
    """One client's data: what, and how often. Answers and data come from different threads."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.recipe: protocol.Recipe | None = None
        self.every = 1  # cycles
        self._lock = threading.Lock()

    def send(self, data: bytes) -> None:
        with self._lock, contextlib.suppress(OSError):
            self.connection.sendall(data)


class ScriptUpload:
    """Takes URScript. A whole one starts the program."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def serve(self, connection: socket.socket) -> None:
        """One client. It is never sent anything."""
        for line in connection.makefile("rb"):
            if line.rstrip(b"\r\n") == b"end":  # inner ones are indented
                with self._robot.lock:
                    self._robot.start_program()


class Dashboard:
    """Lines of text, an answer each."""

    def __init__(self, robot: Robot, firmware: tuple[int, ...]) -> None:
        self._robot = robot
        self.is_remote = True
        self._fixed = {
            "PolyscopeVersion": f"URSoftware {'.'.join(map(str, firmware))} (Jan 01 2024)",
            "get serial number": SERIAL_NUMBER,
            "get robot model": "UR5",
            "robotmode": "Robotmode: RUNNING",
            "isProgramSaved": "true ",
            "get loaded program": "Loaded program: /programs/none.urp",
            "power on": "Powering on",
            "power off": "Powering off",
            "brake release": "Brake releasing",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "restart safety": "Restarting safety",
            "play": "Failed to execute: play",
            "pause": "Failed to execute: pause",
            "quit": "Disconnected",
        }
        self._of_state: dict[str, Callable[[], str]] = {
            "running": lambda: f"Program running: {str(self._is_playing).lower()}",
            "programState": lambda: f"{robot.runtime.name} rtde_control",
            "safetymode": lambda: f"Safetymode: {robot.safety.name}",
            "safetystatus": lambda: f"Safetystatus: {robot.safety.name}",
            "is in remote control": lambda: str(self.is_remote).lower(),
            "stop": self._stop,
            "unlock protective stop": self._unlock,
        }

    def serve(self, connection: socket.socket) -> None:
        """One client."""
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in connection.makefile("r", encoding="utf-8", errors="replace"):
            request = line.strip()
            connection.sendall(f"{self._reply(request)}\n".encode())
            if request == "quit":
                return

    def _reply(self, request: str) -> str:
        if request in self._fixed:
            return self._fixed[request]
        with self._robot.lock:
            if request in self._of_state:
                return self._of_state[request]()
        for start, answer in {"popup ": "showing popup", "addToLog ": "Added log message"}.items():
            if request.startswith(start):
                return answer
        return f"could not understand: '{request}'"

    @property
    def _is_playing(self) -> bool:
        return self._robot.runtime == Runtime.PLAYING

    def _stop(self) -> str:
        self._robot.stop_program()
        return "Stopped"

    def _unlock(self) -> str:
        if self._robot.unlock():
            return "Protective stop releasing"
        return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"


class GripperService:
    """The Robotiq URCap's socket."""

    def __init__(self, robot: Robot, gripper: SimulatedGripper) -> None:
        self._robot, self._gripper = robot, gripper

    def serve(self, connection: socket.socket) -> None:
        """One client."""
        for line in connection.makefile("r", encoding="ascii", errors="replace"):
            words = line.split()
            if words[:1] == ["SET"]:
                for name, value in zip(words[1::2], words[2::2], strict=False):
                    if re.fullmatch(r"\d+", value):
                        with self._robot.lock:
                            self._gripper.set(name, int(value))
                connection.sendall(b"ack")
            elif words[:1] == ["GET"] and len(words) == 2:
                is_stopped = self._robot.safety == Safety.ROBOT_EMERGENCY_STOP
                value = "?" if is_stopped else str(self._gripper.get(words[1]))
                connection.sendall(f"{words[1]} {value}\n".encode())
