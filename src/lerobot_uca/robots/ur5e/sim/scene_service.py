"""The services of a simulated world beside its controller: depth frames, the things' poses, resets and faults.

Port 30010 of the controller's address. A request is a line of JSON, the reply too; after that of `frame` come the
images' bytes: depth (H, W) uint16 [mm], 0 where nothing was measured, then colour (H, W, 3) uint8 if it was asked for.
"""

import json
import math
import os
import signal
import socket
import threading
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.cameras import DepthCamera, PictureCamera
from lerobot_uca.point_clouds.depth import to_millimetres
from lerobot_uca.point_clouds.geometry import Camera, as_pose
from lerobot_uca.robots.ur5e.kinematics import Array
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.scene import Scene
from lerobot_uca.robots.ur5e.sim.servers import RTDE_PORT

PORT = 30010
POSITION, LOOKS_AT = np.array([-0.95, 0.0, 0.85]), np.array([-0.47, 0.0, 0.0])  # [m]
FIELD_OF_VIEW = math.radians(69)  # horizontal, a D435's colour camera
SERIAL = "simulated"
LATENCY, DROPPED = 0.05, 0.1  # [s], share of the packets: of the faults of these names
FAULTS = (
    *("protective_stop", "safeguard_stop", "emergency_stop", "silent_rtde", "gone", "latency", "dropped_packets"),
    *("killed_client", "stale_frames", "dead_camera", "none"),
)


def simulated_camera(width: int, height: int, name: str = "top") -> Camera:
    """The depth camera over the table: it stands opposite the arm and looks down at the things."""
    forward = (LOOKS_AT - POSITION) / np.linalg.norm(LOOKS_AT - POSITION)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = POSITION
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Camera(name, focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, as_pose(pose))


@dataclass(frozen=True)
class Noise:
    """Noise like a real depth camera's."""

    deviation: float = 0.0  # standard deviation at a distance of 1 m [m]; it grows with the square of the distance
    holes: float = 0.0  # share of the pixels without depth, besides those at edges

    def apply(self, depth: Array, rng: np.random.Generator) -> Array:
        """A noisy depth image [m], inf where nothing is measured."""
        finite = np.where(np.isfinite(depth), depth, 0)
        noisy = depth + self.deviation * finite**2 * rng.standard_normal(depth.shape)
        if self.holes:
            jump = np.zeros(depth.shape, dtype=bool)
            jump[:, 1:] = np.abs(np.diff(finite, axis=1)) > 0.02 * finite[:, 1:]  # a stereo pair sees no edges
            noisy[jump | (rng.random(depth.shape) < self.holes)] = np.inf
        return noisy


class SceneService:
    """Serves a scene. `serve` is what a `Server` calls for each connection."""

    def __init__(self, scene: Scene, controller: Controller, noise: Noise) -> None:
        self._scene, self._controller, self._noise = scene, controller, noise
        self._lock = controller.robot.lock
        self._rng = np.random.default_rng(0)
        self._task = "pick_place"
        self._casting = threading.Lock()
        self._data = mujoco.MjData(scene.model)
        self._cameras: dict[tuple[int, int], tuple[DepthCamera, PictureCamera]] = {}
        self._camera_fault = ""
        self._frame(160, 120, colour=False)  # the first frame takes longest

    def serve(self, connection: socket.socket) -> None:
        """One client."""
        for line in connection.makefile("rb"):
            try:
                reply, images = self._reply(json.loads(line))
            except (UserError, ValueError, KeyError, TypeError) as error:
                reply, images = {"error": f"{type(error).__name__}: {error}"}, []
            connection.sendall(json.dumps(reply).encode() + b"\n" + b"".join(image.tobytes() for image in images))

    def _reply(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        match request["request"]:
            case "frame":
                return self._frame(int(request["width"]), int(request["height"]), colour=bool(request["colour"]))
            case "reset":
                self.reset(request["task"], int(request["seed"]), with_arm=bool(request.get("with_arm", False)))
                return self._state(), []
            case "state":
                return self._state(), []
            case "fault":
                self.fault(request["fault"])
                return {}, []
        raise UserError(f"A request is frame, reset, state or fault, got '{request['request']}'.")

    def reset(self, task: str, seed: int, *, with_arm: bool = False) -> None:
        """Put the things where an episode begins; `with_arm` only while no client moves it: arm and fingers, too."""
        with self._lock:
            self._scene.reset(task, seed, with_arm=with_arm)
            self._task = task
            if with_arm:
                self._controller.robot.arm_was_moved()
                if self._controller.gripper is not None:
                    self._controller.gripper.fingers_were_opened()

    def _state(self) -> dict[str, Any]:
        with self._lock:
            success, q = self._scene.is_success(self._task), self._scene.arm.q.tolist()
            return {"task": self._task, "success": success, "q": q, **self._scene.objects()}

    def _frame(self, width: int, height: int, *, colour: bool) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        if self._camera_fault == "dead_camera":
            raise UserError("the camera has been unplugged")
        with self._casting:
            if (width, height) not in self._cameras:
                camera = simulated_camera(width, height)
                self._cameras[width, height] = DepthCamera(camera), PictureCamera(camera)
            depth_camera, picture_camera = self._cameras[width, height]
            if self._camera_fault != "stale_frames":
                with self._lock:
                    mujoco.mj_copyData(self._data, self._scene.model, self._scene.data)
            depth = self._noise.apply(depth_camera.capture(self._scene.model, self._data), self._rng)
            images: list[NDArray[Any]] = [to_millimetres(depth)]
            if colour:
                images.append(picture_camera.capture(self._scene.model, self._data))
            return {"time": self._data.time, "serial": SERIAL}, images

    def fault(self, name: str) -> None:
        """Break something. The arm's faults last until the controller starts anew; `none` mends the camera."""
        if name not in FAULTS:
            raise UserError(f"A fault is one of {', '.join(FAULTS)}, got '{name}'.")
        network, robot = self._controller.network, self._controller.robot
        faults = {
            "protective_stop": lambda: robot.protective_stop("injected"),
            "safeguard_stop": robot.safeguard_stop,
            "emergency_stop": robot.emergency_stop,
            "silent_rtde": lambda: setattr(network, "is_silent", True),
            "gone": self._controller.vanish,
            "latency": lambda: setattr(network, "latency", LATENCY),
            "dropped_packets": lambda: setattr(network, "drop", DROPPED),
            "killed_client": lambda: kill_clients(self._controller.address),
            "stale_frames": lambda: setattr(self, "_camera_fault", name),
            "dead_camera": lambda: setattr(self, "_camera_fault", name),
            "none": lambda: setattr(self, "_camera_fault", ""),
        }
        with self._lock:
            faults[name]()


def kill_clients(ip: str) -> None:
    """Kill the processes that a controller's RTDE serves, which on a loopback address are this machine's."""
    try:
        import psutil
    except ImportError as error:
        raise UserError("This fault needs psutil: pip install 'lerobot_policy_uca_flow[ur5e-sim]'.") from error
    connections = psutil.net_connections("tcp4")
    clients = {each.pid for each in connections if each.raddr == (ip, RTDE_PORT)} - {None}  # two connections a client
    for client in clients:
        os.kill(client, signal.SIGKILL)


class SceneClient:
    """Asks a scene service."""

    def __init__(self, ip: str, timeout: float = 5.0) -> None:
        try:
            self._connection = socket.create_connection((ip, PORT), timeout=timeout)
        except OSError as error:
            raise UserError(
                f"No simulated world answers at {ip}:{PORT} ({error.strerror or error}). Start it: lerobot-uca-ur5e-sim"
            ) from None
        self._stream = self._connection.makefile("rb")

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request. Raises `ConnectionError` where the other side refuses it or is gone."""
        self._connection.sendall(json.dumps(request).encode() + b"\n")
        line = self._stream.readline()
        reply: dict[str, Any] = json.loads(line) if line else {"error": "the simulated world is gone"}
        if "error" in reply:
            raise ConnectionError(reply["error"])
        return reply

    def frame(
        self, width: int, height: int, *, colour: bool
    ) -> tuple[float, NDArray[np.uint16], NDArray[np.uint8] | None]:
        """Time [s], depth (H, W, 1) [mm] and colour (H, W, 3) of the newest frame, in memory that may be written."""
        reply = self.ask(request="frame", width=width, height=height, colour=colour)
        depth = np.frombuffer(self._stream.read(width * height * 2), dtype=np.uint16).reshape(height, width, 1).copy()
        if not colour:
            return reply["time"], depth, None
        picture = np.frombuffer(self._stream.read(width * height * 3), dtype=np.uint8).reshape(height, width, 3).copy()
        return reply["time"], depth, picture

    def close(self) -> None:
        """Hang up."""
        self._stream.close()
        self._connection.close()
