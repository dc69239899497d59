"""scripts/start_rviz: a picture of a running graph, and one line for each thing that is missing."""

import os
import shutil
import signal
import socket
import subprocess
import time
import xmlrpc.client
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "start_rviz"


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def start_rviz(*arguments, master):
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    environment["ROS_MASTER_URI"] = master
    return subprocess.run(
        [SCRIPT, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=150,
    )


@pytest.fixture(scope="module")
def master():
    if not shutil.which("rosmaster") or not shutil.which("Xvfb"):
        pytest.skip("no ROS or no Xvfb here: run scripts/setup")
    port = free_port()
    uri = f"http://127.0.0.1:{port}"
    environment = dict(os.environ, ROS_MASTER_URI=uri, ROS_IP="127.0.0.1")
    process = subprocess.Popen(
        ["rosmaster", "--core", "-p", str(port)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    proxy = xmlrpc.client.ServerProxy(uri)
    for _ in range(100):
        try:
            proxy.setParam("/test", "/run_id", "test")
            break
        except OSError:
            time.sleep(0.1)
    else:
        process.kill()
        pytest.fail("rosmaster did not start")
    yield uri
    process.send_signal(signal.SIGINT)
    process.wait(timeout=20)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--off-screen", "picture.jpg"], ".png"),
        (["--off-screen"], "lacks its value"),
        (["--off-screen", "a.png", "--after", "soon"], "seconds"),
        (["--after", "3"], "belongs to --off-screen"),
        (["--fast"], "unknown argument '--fast'"),
    ],
)
def test_bad_arguments_are_named(arguments, says):
    result = start_rviz(*arguments, master="http://127.0.0.1:9")
    assert result.returncode == 2
    assert says in result.stderr and len(result.stderr.splitlines()) == 1


def test_without_a_master_it_says_so(tmp_path):
    result = start_rviz("--off-screen", str(tmp_path / "a.png"), master="http://127.0.0.1:9")
    assert result.returncode == 1
    assert "no ROS master at http://127.0.0.1:9" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_without_a_screen_it_says_so(master):
    result = start_rviz(master=master)
    assert result.returncode == 1
    assert "no screen" in result.stderr


def test_a_picture_is_taken_and_nothing_stays_behind(master, tmp_path):
    skimage_io = pytest.importorskip("skimage.io")
    proxy = xmlrpc.client.ServerProxy(master)
    proxy.setParam("/test", "/robot_description", (ROOT / "urdf" / "cell.urdf").read_text())
    picture = tmp_path / "rviz.png"
    result = start_rviz("--off-screen", str(picture), "--after", "2", master=master)
    assert result.returncode == 0, result.stderr
    image = skimage_io.imread(picture)
    assert image.shape[:2] == (1000, 1600)
    # The 3-D view shows its background and the grid's lines on it.
    view = image[200:900, 400:1050, :3].reshape(-1, 3)
    background = (view == (38, 41, 46)).all(axis=1)
    assert 0.3 < background.mean() < 0.99
    publishers, subscribers, services = proxy.getSystemState("/test")[2]
    nodes = {
        name
        for table in (publishers, subscribers, services)
        for _, names in table
        for name in names
    }
    assert not [name for name in nodes if "rviz" in name]
    assert [path.name for path in tmp_path.iterdir()] == ["rviz.png"]
