"""The simulated world's depth camera as a LeRobot camera."""

import threading
import time
from typing import Any, NamedTuple

import numpy as np
from lerobot.cameras import Camera
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from lerobot_uca.point_clouds.depth import MILLIMETRE
from lerobot_uca.robots.depth_device import DepthDevice
from lerobot_uca.robots.ur5e.sim.config_simulated_camera import SimulatedCameraConfig
from lerobot_uca.robots.ur5e.sim.scene_service import SERIAL, SceneClient, simulated_camera

FIRST_FRAME = 10.0  # [s]


class Frame(NamedTuple):
    """A frame that the camera saw."""

    received: float  # [s], this machine's monotonic clock
    time: float  # [s], the simulated world's
    depth: NDArray[np.uint16]  # (H, W, 1) [mm]
    colour: NDArray[np.uint8] | None  # (H, W, 3)


class SimulatedCamera(Camera):
    """Fetches frames in a thread, as cameras' drivers do."""

    def __init__(self, config: SimulatedCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.use_rgb, self.use_depth = config.use_rgb, config.use_depth
        self.serial_number = SERIAL
        self._client: SceneClient | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._error: str | None = None
        self._read_time = -1.0

    @property
    def is_connected(self) -> bool:
        """Whether frames are fetched."""
        return self._client is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The simulated camera cannot be searched for: its address is given."""
        return []

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Start fetching; returns with the first frame."""
        del warmup
        self._client = SceneClient(self.config.ip)
        self._frame, self._error, self._read_time = None, None, -1.0
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, args=(self._client,), name="ur5e-sim-camera", daemon=True)
        self._thread.start()
        try:
            self._wait_newer(FIRST_FRAME)
        except Exception:
            self.disconnect()
            raise

    def _run(self, client: SceneClient) -> None:
        assert self.fps is not None
        assert self.width is not None
        assert self.height is not None
        due = time.monotonic()
        while not self._closing.is_set():
            try:
                frame = client.frame(self.width, self.height, colour=self.use_rgb)
            except (OSError, ValueError) as error:
                with self._changed:
                    self._error = str(error) or type(error).__name__
                    self._changed.notify_all()
                return
            with self._changed:
                if self._frame is None or frame[0] > self._frame.time:  # the same time again: a stale frame
                    self._frame = Frame(time.monotonic(), *frame)
                self._changed.notify_all()
            due = max(due + 1 / self.fps, time.monotonic() - 1 / self.fps)
            self._closing.wait(max(0.0, due - time.monotonic()))

    def _wait_newer(self, timeout: float) -> Frame:
        with self._changed:
            self._changed.wait_for(lambda: self._error or (self._frame and self._frame.time > self._read_time), timeout)
            if self._error is not None:
                raise ConnectionError(self._error)
            if self._frame is None or self._frame.time <= self._read_time:
                raise TimeoutError(f"no new frame within {timeout:.1f} s")
            self._read_time = self._frame.time
            return self._frame

    def _latest(self, max_age_ms: int) -> Frame:
        with self._changed:
            if self._error is not None:
                raise ConnectionError(self._error)
            assert self._frame is not None  # `connect` waits for one
            age = (time.monotonic() - self._frame.received) * 1000
            if age > max_age_ms:
                raise TimeoutError(f"the newest frame is {age:.0f} ms old, at most {max_age_ms} ms are allowed")
            return self._frame

    def depth_device(self) -> DepthDevice:
        """What a real camera's driver says of its depth stream."""
        assert self.width is not None
        assert self.height is not None
        camera = simulated_camera(self.width, self.height)
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return DepthDevice(SERIAL, *intrinsics, depth_unit=MILLIMETRE)

    def read(self) -> NDArray[Any]:
        """The next colour frame (H, W, 3), or depth from a camera without colour."""
        return self.async_read(1000)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """The next frame that has not been read."""
        frame = self._wait_newer(timeout_ms / 1000)
        return frame.depth if frame.colour is None else frame.colour

    @check_if_not_connected
    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """The newest colour frame (H, W, 3), or depth from a camera without colour."""
        frame = self._latest(max_age_ms)
        return frame.depth if frame.colour is None else frame.colour

    @check_if_not_connected
    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[np.uint16]:
        """The newest depth frame (H, W, 1) [mm]."""
        return self._latest(max_age_ms).depth

    def disconnect(self) -> None:
        """Stop fetching."""
        self._closing.set()
        if self._client is not None:
            if self._thread is not None:
                self._thread.join(2.0)
            self._client.close()
            self._client = None
