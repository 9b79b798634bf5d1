"""Simulated controllers, each on a loopback address of its own."""

import itertools
import os
import time
from collections.abc import Callable, Iterator

import pytest

from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.gripper import IdealFingers

_numbers = itertools.count(2)


def free_address() -> str:
    """A loopback address that no other process and no other test uses."""
    process = os.getpid()
    return f"127.{1 + process // 250 % 250}.{process % 250}.{next(_numbers) % 250}"


@pytest.fixture
def controller() -> Iterator[Controller]:
    """An ideal arm with a gripper."""
    with Controller(fingers=IdealFingers(), address=free_address()) as controller:
        yield controller


def wait_until(condition: Callable[[], object], seconds: float = 30.0) -> None:
    """Return as soon as a condition holds; fail if it never does."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not so after {seconds} s"
        time.sleep(0.002)
