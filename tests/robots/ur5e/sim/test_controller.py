"""The simulated controller with ur_rtde's real client, which runs in a process of its own: it can segfault."""

import socket
import subprocess
import sys
import textwrap

import pytest
from tests.robots.conftest import free_address, wait_until

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.robot import Runtime, Safety

pytest.importorskip("rtde_control", reason="the extra ur5e is not installed")

PRELUDE = """
import sys, time
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from dashboard_client import DashboardClient
address = sys.argv[1]
def connect():
    return RTDEReceiveInterface(address, 500), RTDEControlInterface(address, 500)
def wait_until(condition, seconds=20):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)
def near(a, b, tolerance):
    return max(abs(x - y) for x, y in zip(a, b, strict=True)) < tolerance
"""


def start_client(controller: Controller, code: str) -> subprocess.Popen:
    program = [sys.executable, "-c", PRELUDE + textwrap.dedent(code), controller.address]
    return subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def run_client(controller: Controller, code: str) -> str:
    output, _ = (client := start_client(controller, code)).communicate(timeout=90)
    assert client.returncode == 0, output
    return output


def test_a_client_reads_servos_and_stops(controller):
    run_client(
        controller,
        """
        receive, control = connect()
        assert control.isProgramRunning() and receive.isConnected()
        q = receive.getActualQ()
        assert near(q, [0, -1.57, 1.57, -1.57, -1.57, 0], 1e-9)
        target = [angle + 0.1 for angle in q]
        for _ in range(500):
            start = control.initPeriod()
            assert control.servoJ(target, 0, 0, 0.002, 0.1, 300)
            control.waitPeriod(start)
        wait_until(lambda: near(receive.getActualQ(), target, 1e-3))
        assert control.servoStop(10)
        control.stopScript()
        assert not control.isProgramRunning()
        control.disconnect()
        """,
    )
    assert controller.robot.runtime == Runtime.STOPPED
    assert abs(controller.robot.target_qd).max() < 1e-9


def test_a_client_moves_stops_and_starts_anew(controller):
    run_client(
        controller,
        """
        receive, control = connect()
        q = receive.getActualQ()
        target = [angle + 0.2 for angle in q]
        assert control.moveJ(target, 2.0, 10.0)
        wait_until(lambda: near(receive.getActualQ(), target, 1e-6))
        assert control.moveJ(q, 0.02, 2.0, True) and control.getAsyncOperationProgress() >= 0
        control.stopJ(10.0)
        assert not near(receive.getActualQ(), q, 1e-2)
        assert control.getStepTime() == 0.002
        control.speedJ([0.3] + [0] * 5, 5.0)
        wait_until(lambda: near(receive.getActualQd(), [0.3] + [0] * 5, 1e-6))
        assert control.speedStop(10.0)
        wait_until(lambda: near(receive.getActualQd(), [0] * 6, 1e-6))
        control.stopScript()
        wait_until(lambda: not control.isProgramRunning())  # or the client stops the one that it has just uploaded
        assert control.reuploadScript()
        wait_until(control.isProgramRunning)
        """,
    )


def test_a_short_target_is_dropped_and_no_number_stops_the_arm(controller):
    run_client(
        controller,
        """
        receive, control = connect()
        before = receive.getActualQ()
        control.servoJ(before, 0, 0, 0.002, 0.1, 300)
        control.servoJ([9.0] * 5, 0, 0, 0.002, 0.1, 300)  # the client answers True
        time.sleep(0.05)
        assert near(receive.getActualQ(), before, 1e-6) and not receive.isProtectiveStopped()
        control.servoJ([float("nan")] * 6, 0, 0, 0.002, 0.1, 300)
        wait_until(receive.isProtectiveStopped)
        """,
    )
    assert controller.robot.stop_reason == "a joint target is not a number"


def test_the_dashboard_unlocks_a_protective_stop_after_five_seconds(controller):
    now = [0.0]
    controller.robot.clock = lambda: now[0]
    client = start_client(
        controller,
        """
        receive, control = connect()
        dashboard = DashboardClient(address)
        dashboard.connect()
        assert dashboard.running() and dashboard.robotmode() == "Robotmode: RUNNING"
        print("ready", flush=True)
        wait_until(receive.isProtectiveStopped)
        assert not receive.isEmergencyStopped() and not control.moveJ(receive.getActualQ())
        assert "PROTECTIVE_STOP" in dashboard.safetystatus()
        try:
            dashboard.unlockProtectiveStop()
        except Exception as error:
            assert "until 5s" in str(error), error
        else:
            raise AssertionError("unlocked too early")
        print("refused", flush=True)
        input()
        dashboard.unlockProtectiveStop()
        control.reuploadScript()
        wait_until(control.isProgramRunning)
        """,
    )
    assert client.stdout.readline() == "ready\n"
    with controller.robot.lock:
        controller.robot.protective_stop("a collision")
    lines = iter(client.stdout.readline, "")
    assert "refused\n" in lines
    now[0] = 5.1
    output, _ = client.communicate("\n", timeout=60)
    assert client.returncode == 0, output


def test_the_watchdog_stops_the_program_of_a_killed_client(controller):
    client = start_client(
        controller,
        """
        receive, control = connect()
        control.setWatchdog(2)
        target = receive.getActualQ()
        print("ready", flush=True)
        while True:
            control.servoJ(target, 0, 0, 0.002, 0.1, 300)
            time.sleep(0.002)
        """,
    )
    assert client.stdout.readline() == "ready\n"
    assert controller.robot.runtime == Runtime.PLAYING
    client.kill()
    client.communicate()
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED)


def test_an_emergency_stop_is_seen_as_one(controller):
    client = start_client(
        controller,
        """
        receive = RTDEReceiveInterface(address, 500)
        print("ready", flush=True)
        wait_until(receive.isEmergencyStopped)
        assert not receive.isProtectiveStopped() and receive.getSafetyMode() == 7
        """,
    )
    assert client.stdout.readline() == "ready\n"
    with controller.robot.lock:
        controller.robot.emergency_stop()
    output, _ = client.communicate(timeout=60)
    assert client.returncode == 0, output
    assert controller.robot.safety == Safety.ROBOT_EMERGENCY_STOP


def test_a_client_survives_latency_and_lost_packets(controller):
    controller.network.latency, controller.network.drop = 0.02, 0.3
    run_client(
        controller,
        """
        receive = RTDEReceiveInterface(address, 500)
        first = receive.getTimestamp()
        wait_until(lambda: receive.getTimestamp() > first + 0.1)
        """,
    )


def test_one_address_serves_one_controller():
    address = free_address()
    with Controller(address=address), pytest.raises(UserError, match=rf"{address}:\d+ .*such as 127.0.0.2"):
        Controller(address=address)
    with Controller(address=address):  # free again
        pass


def test_only_loopback_addresses_are_served():
    with pytest.raises(UserError, match="loopback"):
        Controller(address="0.0.0.0")


@pytest.mark.parametrize("data", [b"\x00\x00\x00", b"\x00\x02U", b"\xff\xffU", b"\x00\x04U\x09", b"\x00\x05U\x01\x02"])
def test_invalid_packets_do_no_harm(controller, data):
    with socket.create_connection((controller.address, 30004)) as connection:
        connection.sendall(data)
    before = controller.robot.n_cycles
    wait_until(lambda: controller.robot.n_cycles > before + 10)
