"""A graph ends with whoever started it, and says what broke."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from iwgnet_grasp.ros.session import Session, free_master_uri
from iwgnet_grasp.supervisor import CellError

STARTED = re.compile(r"process\[([\w/]+)-\d+\]: started with pid \[(\d+)\]")


def pids(log: Path, count: int, seconds: float = 60.0) -> dict[str, int]:
    """Processes that roslaunch started, by node, once there are `count`."""
    end = time.monotonic() + seconds
    found = {}
    while len(found) < count:
        assert time.monotonic() < end, f"only {found} started"
        time.sleep(0.1)
        found = {name: int(pid) for name, pid in STARTED.findall(log.read_text())}
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone(processes: dict[str, int], seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while any(map(alive, processes.values())) and time.monotonic() < end:
        time.sleep(0.1)
    return not any(map(alive, processes.values()))


@pytest.fixture
def own_master(monkeypatch):
    monkeypatch.setenv("ROS_MASTER_URI", free_master_uri())


def test_a_killed_node_is_named_and_nothing_is_left_behind(own_master, tmp_path):
    with Session("simulation.launch", [], tmp_path) as session:
        processes = pids(session.log, 3)  # rosout, simulator, robot_state_publisher
        session.check()
        os.kill(processes["robot_state_publisher"], signal.SIGKILL)
        with pytest.raises(CellError, match="robot_state_publisher died .killed by SIGKILL"):
            for _ in range(300):
                session.check()
                time.sleep(0.1)
    assert gone(processes, 1.0)


def test_a_node_that_cannot_start_says_why(own_master, tmp_path):
    with (
        pytest.raises(CellError, match="simulator died .*no_such_scene.*five_scattered"),
        Session("simulation.launch", ["scene:=no_such_scene"], tmp_path) as session,
    ):
        for _ in range(300):
            session.check()
            time.sleep(0.1)


def test_a_launch_that_fails_says_why(own_master, tmp_path):
    with (
        pytest.raises(CellError, match="roslaunch ended: .*no_such.launch"),
        Session("no_such.launch", [], tmp_path) as session,
    ):
        for _ in range(300):
            session.check()
            time.sleep(0.1)


def test_a_killed_parent_takes_its_graph_along(own_master, tmp_path):
    program = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from iwgnet_grasp.ros.session import Session\n"
        "with Session('simulation.launch', [], Path(sys.argv[1])):\n"
        "    time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)])
    log = tmp_path / "roslaunch.log"
    while not log.exists():
        assert parent.poll() is None
        time.sleep(0.1)
    processes = pids(log, 3)
    parent.kill()
    parent.wait()
    assert gone(processes)


def test_a_second_graph_on_one_master_is_refused(graph, tmp_path):
    with pytest.raises(CellError, match="runs already"), Session("grasping.launch", [], tmp_path):
        pass


def test_a_port_that_is_no_master_is_refused(monkeypatch, tmp_path):
    import socket

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{other.getsockname()[1]}")
        with pytest.raises(CellError, match="is taken"), Session("simulation.launch", [], tmp_path):
            pass
