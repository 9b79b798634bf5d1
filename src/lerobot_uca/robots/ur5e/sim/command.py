"""`lerobot-uca-ur5e-sim`: a simulated UR5e at a table, for the same driver and commands as a real one."""

import argparse
import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import Calibration
from lerobot_uca.robots.ur5e.real_time import prefer_this_thread
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.robot import Runtime
from lerobot_uca.robots.ur5e.sim.scene import TASKS, TOOL_LENGTH, Scene
from lerobot_uca.robots.ur5e.sim.scene_service import FAULTS, PORT, SERIAL, Noise, SceneService, simulated_camera
from lerobot_uca.robots.ur5e.sim.servers import Server

logger = logging.getLogger(__name__)


class SimulatedWorld:
    """Scene, controller and scene service together. A context manager."""

    def __init__(self, address: str = "127.0.0.1", noise: Noise | None = None) -> None:
        self.scene = Scene()
        self.controller = Controller(self.scene.arm, self.scene.fingers, tool_length=TOOL_LENGTH, address=address)
        self.service = SceneService(self.scene, self.controller, noise or Noise())
        try:
            self._server = Server(address, PORT, self.service.serve)
        except Exception:
            self.controller.close()
            raise

    def close(self) -> None:
        """Stop serving."""
        self._server.close()
        self.controller.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def write_calibration(folder: Path, name: str, width: int, height: int) -> Path:
    """The simulated camera's calibration, as lerobot-uca-calibrate would write it: exact."""
    camera = simulated_camera(width, height, name)
    return Calibration(camera, serial=SERIAL, method="the simulated scene's own", residual={"mm": 0.0}).write(folder)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="lerobot-uca-ur5e-sim", description=__doc__)
    parser.add_argument("--ip", default="127.0.0.1", help="loopback address to serve; one for each world [%(default)s]")
    parser.add_argument("--task", choices=TASKS, default="pick_place", help="which things are where [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="of the things' places [%(default)s]")
    parser.add_argument("--noise", type=float, default=0.0, help="of depth at a distance of 1 m [m] [%(default)s]")
    parser.add_argument("--holes", type=float, default=0.0, help="share of pixels without depth [%(default)s]")
    parser.add_argument("--fault", choices=FAULTS, default="none", help="what breaks [%(default)s]")
    parser.add_argument(
        "--after", type=float, default=5.0, help="seconds until it breaks, once a client steers the arm [%(default)s]"
    )
    parser.add_argument("--calibration", type=Path, help="folder to write the camera's calibration to")
    parser.add_argument("--camera", default="top", help="its name in the robot's configuration [%(default)s]")
    parser.add_argument("--width", type=int, default=160, help="of the calibrated image [pixels] [%(default)s]")
    parser.add_argument("--height", type=int, default=120, help="of the calibrated image [pixels] [%(default)s]")
    options = parser.parse_args(arguments)
    for name, least in (("seed", 0), ("width", 1), ("height", 1), ("noise", 0), ("holes", 0), ("after", 0)):
        if not getattr(options, name) >= least:
            parser.error(f"--{name} is at least {least}, got {getattr(options, name)}")
    return options


def main() -> None:
    """Serve until Ctrl-C."""
    options = parse()
    prefer_this_thread()  # the simulated world's time is the real one
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if options.calibration is not None:
        try:
            file = write_calibration(options.calibration, options.camera, options.width, options.height)
        except OSError as error:
            raise UserError(f"--calibration '{options.calibration}' cannot be written: {error}") from error
        logger.info("Calibration of camera '%s': %s", options.camera, file)
    with SimulatedWorld(options.ip, Noise(options.noise, options.holes)) as world:
        world.service.reset(options.task, options.seed, with_arm=True)
        logger.info(
            "A simulated UR5e serves %s: --robot.type=ur5e_follower --robot.ip=%s. Ctrl-C ends it.",
            options.ip,
            options.ip,
        )
        if options.fault != "none":
            while world.controller.robot.runtime != Runtime.PLAYING:
                time.sleep(0.05)
            time.sleep(options.after)
            world.service.fault(options.fault)
        threading.Event().wait()
