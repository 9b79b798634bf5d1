"""A real browser without a screen, for tests of pages."""

import base64
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.robots.conftest import wait_until

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="there is no browser: chromium, chromium-browser or google-chrome"
)


@contextmanager
def browser(url: str, folder: Path, window: tuple[int, int]) -> Iterator[Callable[[], np.ndarray]]:
    """A headless browser on a page, WebGL included; what it yields takes a picture of the page, (H, W, 3) uint8.

    Args:
        url: of the page.
        folder: for the browser's own files.
        window: width and height [pixels].
    """
    import websockets.sync.client  # viser needs it

    assert BROWSER is not None
    command = [
        *(BROWSER, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        *("--hide-scrollbars", "--no-first-run", "--disable-dev-shm-usage", f"--user-data-dir={folder}"),
        *(f"--window-size={window[0]},{window[1]}", "--remote-debugging-port=0", url),
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        file = folder / "DevToolsActivePort"
        wait_until(lambda: file.exists() and file.read_text().count("\n"), 120)
        with urllib.request.urlopen(f"http://127.0.0.1:{file.read_text().split()[0]}/json/list") as opened:
            (address,) = [each["webSocketDebuggerUrl"] for each in json.load(opened) if each["url"].startswith(url)]
        with websockets.sync.client.connect(address, max_size=None) as devtools:

            def picture() -> np.ndarray:
                devtools.send(json.dumps({"id": 1, "method": "Page.captureScreenshot"}))
                data = json.loads(devtools.recv(timeout=120))["result"]["data"]
                return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

            yield picture
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its helpers, too
        process.wait()
